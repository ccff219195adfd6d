"""The command ``handfast resume``: robots of a running fleet may drive again."""

from __future__ import annotations

import argparse
import time

from handfast.agent.common.errors import FAILED, PASSED
from handfast.deploy.console.arguments import describe, robots_argument, robots_named
from handfast.deploy.console.wording import robots as some_robots
from handfast.deploy.inventory.known_fleets import MEANING, handled, running_fleet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast resume`` takes."""
    describe(
        parser,
        f". {MEANING} An operator gives a robot back by GUIDED mode, "
        "armed. Exit status: 0 all that are meant drive; 1 some do not; 2 bad input.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
    robots_argument(parser)
    parser.set_defaults(command=handled(_resume))


def _resume(options: argparse.Namespace) -> int:
    from handfast.deploy.drive.preconditions import under_way
    from handfast.deploy.session.order import resume

    given_ns = time.time_ns()
    fleet = running_fleet(options.fleet)
    resuming, known = resume(fleet, robots_named(fleet, options), given_ns)
    for line in resuming.outcomes:
        print(line)
    if resuming.others:
        them = "it has" if len(resuming.others) == 1 else "they have"
        print(f"{some_robots(resuming.others)} will go on as well: {them} waited for others since the start")
    if goes_on := under_way(known, time.time_ns()):
        print(f"what goes on: {goes_on}")
    return PASSED if resuming.done else FAILED
