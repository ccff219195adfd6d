"""The command ``handfast report``: a run's figures, metrics and page again, from its recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from deploy.console.arguments import InputError
from deploy.drive.outcome import conclude


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast report`` takes."""
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    parser.set_defaults(command=_report)


def _report(options: argparse.Namespace) -> int:
    from deploy.recording.recorder import RecordingError
    from deploy.report.run_folder import rebuild

    try:
        result = rebuild(Path(options.folder))
    except RecordingError as error:
        raise InputError(str(error)) from None
    return conclude(result, Path(options.folder))
