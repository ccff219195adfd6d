"""The command ``handfast stop``: every robot of a fleet that is running brakes, and stays."""

from __future__ import annotations

import argparse
from typing import Any

from deploy.inventory.running import DONE, FAILED, MEANING, handled, running_fleet


def add_parser(commands: Any) -> None:
    """Adds the command to those of ``handfast``."""
    text = "stop every robot, until `handfast resume`"
    parser = commands.add_parser(
        "stop",
        help=text,
        description=f"{text[0].upper()}{text[1:]}. {MEANING} Robots that cannot be reached now stop as "
        "soon as another one tells them. Exit status: 0 all agents and plants brake; 1 not all; 2 bad input.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
    parser.add_argument("--reason", default="", metavar="TEXT", help="why, for people")
    parser.set_defaults(command=handled(_stop))


def _stop(options: argparse.Namespace) -> int:
    from deploy.session.stop import stop

    fleet = running_fleet(options.fleet)
    stopping = stop(fleet, options.reason)
    for robot in fleet.ids:
        print(stopping.outcome(robot))
    return DONE if stopping.done else FAILED
