"""The command ``handfast heartbeat``: the dead-man's switch of a fleet that is running."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from deploy.console.arguments import InputError
from deploy.inventory.running import DONE, MEANING, handled, running_fleet


def add_parser(commands: Any) -> None:
    """Adds the command to those of ``handfast``."""
    text = "hold a fleet's dead-man's switch: it drives while this command runs"
    parser = commands.add_parser(
        "heartbeat",
        help=text,
        description=f"{text[0].upper()}{text[1:]}. {MEANING} Where the fleet file sets "
        "supervision.deadman_s, robots hold when no heartbeat has come for so long. `handfast run` sends "
        "heartbeats too. Ends with Ctrl-C. Exit status: 0 ended so; 1 the fleet does not answer; 2 bad "
        "input.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
    parser.set_defaults(command=handled(_heartbeat))


def _heartbeat(options: argparse.Namespace) -> int:
    from deploy.console.interrupt import Interrupt
    from deploy.session.heartbeat import beat

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
    return DONE
