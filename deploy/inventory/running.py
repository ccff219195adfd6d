"""What commands for a fleet that is running have in common: how it is found, and how failures are said."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from handfast.agent.common.exit import BAD_INPUT, FAILED
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.console.arguments import InputError

if TYPE_CHECKING:
    from handfast.deploy.inventory.known_fleets import KnownFleet

MEANING = (
    "FLEET is the name of a fleet that runs on this machine or that was brought up on hosts from here "
    "(`handfast status`), the number of its process, the folder of its run, or a fleet file; the name of a "
    "bundled fleet means its file where no such fleet is known."
)

Command = Callable[[argparse.Namespace], int]


class NoAnswerError(Exception):
    """The fleet cannot be reached; the text is one clear message."""


def running_fleet(what: str) -> Fleet:
    """The fleet that is meant, as its processes read it, with the addresses of its hosts.

    Raises:
        handfast.deploy.inventory.known_fleets.NotRunningError, handfast.agent.fleet.model.FleetError: see
        `deploy.inventory.known_fleets.find`. InputError: nobody knows where a host is.
    """
    from handfast.deploy.inventory.known_fleets import find

    return as_running(find(what))


def as_running(known: KnownFleet) -> Fleet:
    """A known fleet as its processes read it, with the addresses of its hosts; raises as `running_fleet`."""
    from handfast.deploy.inventory.hosts import located

    return located(known.fleet) if known.on_hosts else known.fleet


def handled(command: Command) -> Command:
    """`command`, with what may go wrong with a running fleet said in one line."""

    def run(options: argparse.Namespace) -> int:
        # Here: opening the bus takes its time, and most commands do not.
        from handfast.agent.runtime.runtime_folder import NotPrivateError
        from handfast.agent.transport.bus import BusError
        from handfast.deploy.inventory.known_fleets import NotRunningError

        try:
            return command(options)
        except (FleetError, NotRunningError, NotPrivateError, InputError) as error:
            print(f"handfast: {error}", file=sys.stderr)
            return BAD_INPUT
        except (BusError, NoAnswerError) as error:
            print(f"handfast: {error}", file=sys.stderr)
            return FAILED

    return run
