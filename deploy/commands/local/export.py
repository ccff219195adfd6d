"""The command ``handfast export``: a run's data as tables or as a bag of ROS 2."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from agent.common.exit import PASSED
from deploy.console.arguments import place_for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast export`` takes."""
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    parser.add_argument(
        "--format", default="csv", metavar="FORMAT", help="csv (default), parquet, json or rosbag2"
    )
    parser.add_argument("--out", type=place_for, metavar="DIR", help="where to (default: RUN/export)")
    parser.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> int:
    from deploy.console.interrupt import Interrupt
    from deploy.report.export import export

    out = Path(options.out) if options.out else None
    with Interrupt().caught() as interrupt, interrupt.answered("it ends here", raises=True):
        written = export(Path(options.folder), options.format, out, warn=_warn)
    for path in written:
        print(path)
    return PASSED


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)
