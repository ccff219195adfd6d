"""The command ``handfast report``: a run's figures, metrics and page again, from its recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from deploy.console.arguments import InputError
from deploy.console.exit import FAILED, PASSED
from deploy.drive.outcome import say_verdict


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast report`` takes."""
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    parser.set_defaults(command=_report)


def _report(options: argparse.Namespace) -> int:
    from deploy.recording.recorder import RecordingError
    from deploy.report.report import rebuild

    try:
        metrics = rebuild(Path(options.folder))
    except RecordingError as error:
        raise InputError(str(error)) from None
    say_verdict(metrics, Path(options.folder))
    return PASSED if metrics["verdict"]["passed"] else FAILED
