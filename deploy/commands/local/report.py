"""The command ``handfast report``: a run's figures, metrics and page again, from its recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from deploy.drive.outcome import conclude


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast report`` takes."""
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    parser.set_defaults(command=_report)


def _report(options: argparse.Namespace) -> int:
    from deploy.report.run_folder import rebuild

    result = rebuild(Path(options.folder))
    return conclude(result, Path(options.folder))
