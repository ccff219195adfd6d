"""The command ``handfast check``: what a fleet will do, and all that is wrong with it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import TYPE_CHECKING

from handfast.agent.common.errors import BAD_INPUT, PASSED
from handfast.deploy.console.arguments import fleet_arguments, load_unresolved

if TYPE_CHECKING:
    from handfast.agent.fleet.model import Fleet
    from handfast.deploy.check.finding import Finding


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast check`` takes."""
    fleet_arguments(parser)
    parser.set_defaults(command=_check)


def _check(options: argparse.Namespace) -> int:
    from handfast.deploy.check.check import check
    from handfast.deploy.check.description import describe

    fleet = load_unresolved(options)
    print(describe(fleet))
    findings = [*check(fleet), *_of_this_machine(fleet)]
    for finding in findings:
        print(finding)
    return BAD_INPUT if any(finding.level == "error" for finding in findings) else PASSED


def _of_this_machine(fleet: Fleet) -> Iterable[Finding]:
    """Whether this machine carries a fleet that `handfast run` would have on it, and has the cores for it."""
    from handfast.deploy.check.capacity import check_capacity, is_looked_at

    if any(robot.host for robot in fleet.robots):
        return ()
    if not is_looked_at(fleet):
        return ()
    from handfast.deploy.processes.machine import measured_for

    return check_capacity(fleet, measured_for(fleet))
