"""The command ``handfast stop``: every robot of a fleet that is running brakes, and stays."""

from __future__ import annotations

import argparse
import sys

from agent.common.exit import FAILED, PASSED
from agent.common.wording import printable
from deploy.console.arguments import describe
from deploy.inventory.running import MEANING, handled, running_fleet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast stop`` takes."""
    describe(
        parser,
        f". {MEANING} It goes by every way there is, side by side: over new links, over those of a drive or "
        "heartbeat on this machine, and over ssh to the robots' hosts. Robots that cannot be reached now "
        "stop as soon as another one relays it. Exit status: 0 all agents and plants brake; 1 not all; 2 bad "
        "input.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
    parser.add_argument("--reason", default="", metavar="TEXT", help="why, for people")
    parser.set_defaults(command=handled(_stop))


def _stop(options: argparse.Namespace) -> int:
    from deploy.commands.running.ways import ways
    from deploy.session.stop import stop

    fleet = running_fleet(options.fleet)
    stopping, troubles = stop(fleet, options.reason, ways(fleet))
    for robot in fleet.ids:
        print(stopping.outcome(robot))
    for trouble in troubles if not stopping.done else ():
        print(printable(trouble), file=sys.stderr)
    return PASSED if stopping.done else FAILED
