"""The command ``handfast check``: what a fleet will do, and all that is wrong with it."""

from __future__ import annotations

import argparse

from agent.common.exit import BAD_INPUT, PASSED
from deploy.console.arguments import fleet_arguments, load_unresolved


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast check`` takes."""
    fleet_arguments(parser)
    parser.set_defaults(command=_check)


def _check(options: argparse.Namespace) -> int:
    from deploy.check.check import check
    from deploy.check.description import describe

    fleet = load_unresolved(options)
    print(describe(fleet))
    findings = check(fleet)
    for finding in findings:
        print(finding)
    return BAD_INPUT if any(finding.level == "error" for finding in findings) else PASSED
