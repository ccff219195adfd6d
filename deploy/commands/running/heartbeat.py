"""The command ``handfast heartbeat``: the dead-man's switch of a fleet that is running."""

from __future__ import annotations

import argparse
import sys

from handfast.agent.common.errors import PASSED
from handfast.deploy.console.arguments import InputError, describe
from handfast.deploy.inventory.known_fleets import MEANING, handled, running_fleet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast heartbeat`` takes."""
    describe(
        parser,
        f". {MEANING} Where the fleet file sets "
        "supervision.deadman_s, robots hold when no heartbeat has come for so long. `handfast run` sends "
        "heartbeats too. Ends with Ctrl-C. Exit status: 0 ended so; 1 the fleet does not answer; 2 bad "
        "input.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
    parser.set_defaults(command=handled(_heartbeat))


def _heartbeat(options: argparse.Namespace) -> int:
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.session.heartbeat import beat

    fleet = running_fleet(options.fleet)
    deadman_s = fleet.supervision.deadman_s
    if deadman_s is None:
        raise InputError(
            f"{fleet.fleet.name} has no dead-man's switch: its fleet file would have to set "
            "supervision.deadman_s, such as deadman_s = 1.0"
        )
    interrupt = Interrupt()
    with interrupt.caught():
        print(
            f"{fleet.fleet.name} holds {deadman_s:g} s after the last heartbeat; Ctrl-C ends them", flush=True
        )
        beat(fleet, interrupt, sys.stderr)
    return PASSED
