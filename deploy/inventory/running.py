"""What commands for a fleet that is running have in common: how it is found, and how failures are said."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from agent.common.exit import BAD_INPUT, FAILED
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet, FleetError
from deploy.console.arguments import InputError

MEANING = (
    "FLEET is the name of a fleet that runs on this machine, the folder of its run, or a fleet file; the "
    "name of a bundled fleet means its file where no such fleet runs here."
)

Command = Callable[[argparse.Namespace], int]


class NoAnswerError(Exception):
    """The fleet cannot be reached; the text is one clear message."""


def running_fleet(what: str) -> Fleet:
    """The fleet that is meant, as its processes read it, with the addresses of its hosts.

    Raises:
        deploy.inventory.registry.NotRunningError, agent.fleet.model.FleetError: see
        `deploy.inventory.registry.find`. InputError: nobody knows where a host is.
    """
    from deploy.inventory.registry import find

    fleet = load_fleet(find(what))
    if any(robot.host is not None for robot in fleet.robots):
        from deploy.inventory.hosts import located

        return located(fleet)
    return fleet


def handled(command: Command) -> Command:
    """`command`, with what may go wrong with a running fleet said in one line."""

    def run(options: argparse.Namespace) -> int:
        # Here: opening the bus takes its time, and most commands do not.
        from agent.runtime.bus import BusError
        from agent.runtime.runtime_folder import NotPrivateError
        from deploy.inventory.registry import NotRunningError

        try:
            return command(options)
        except (FleetError, NotRunningError, NotPrivateError, InputError) as error:
            print(f"handfast: {error}", file=sys.stderr)
            return BAD_INPUT
        except (BusError, NoAnswerError) as error:
            print(f"handfast: {error}", file=sys.stderr)
            return FAILED

    return run
