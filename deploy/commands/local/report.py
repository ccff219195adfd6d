"""The command ``handfast report``: a run's figures, metrics and page again, from its recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from handfast.agent.common.errors import INTERRUPTED
from handfast.deploy.console.arguments import InputError, figures_argument
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.drive.outcome import conclude, say_left_out


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast report`` takes."""
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    figures_argument(parser)
    parser.set_defaults(command=_report)


def _report(options: argparse.Namespace) -> int:
    from handfast.deploy.inventory.known_fleets import is_driven
    from handfast.deploy.report.run_folder import rebuild

    folder, interrupt = Path(options.folder), Interrupt()
    if is_driven(folder):
        raise InputError(f"{folder}: this run is still being driven; its report is made at its end")
    result = rebuild(folder, options.figures, interrupt=interrupt)
    status = conclude(result, folder)
    say_left_out(folder)
    return INTERRUPTED if interrupt.count else status
