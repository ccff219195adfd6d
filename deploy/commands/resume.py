"""The command ``handfast resume``: leave to drive again for robots of a fleet that is running."""

from __future__ import annotations

import argparse
from typing import Any

from deploy.console.arguments import robots_argument, robots_named
from deploy.inventory.running import DONE, FAILED, MEANING, handled, running_fleet


def add_parser(commands: Any) -> None:
    """Adds the command to those of ``handfast``."""
    text = "let robots drive again after a stop, or after their operators took them over and gave them back"
    parser = commands.add_parser(
        "resume",
        help=text,
        description=f"{text[0].upper()}{text[1:]}. {MEANING} An operator gives a robot back by GUIDED mode, "
        "armed. Exit status: 0 all that are meant drive; 1 some do not; 2 bad input.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
    robots_argument(parser)
    parser.set_defaults(command=handled(_resume))


def _resume(options: argparse.Namespace) -> int:
    from deploy.session.resume import resume

    fleet = running_fleet(options.fleet)
    resuming = resume(fleet, robots_named(fleet, options))
    for robot in resuming.robots:
        print(resuming.outcome(robot))
    return DONE if resuming.done else FAILED
