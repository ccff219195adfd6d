"""``handfast keys --signing``: gives vehicles the MAVLink 2 keys that the fleet file names."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.fleet.sections import Robot
from handfast.deploy.console.arguments import (
    InputError,
    load_unresolved,
    robots_named,
)
from handfast.deploy.console.interrupt import Interrupt

IN_CLEAR: Final = (
    "The keys cross the links in clear: give them by USB, or over a link that nobody else can listen to. "
    "Ground stations need them too from then on, but on a vehicle's first serial port."
)
NOT_DONE: Final = "NOT DONE: "
NO_KEY: Final = "no mavlink.signing_key in the fleet file: left alone"
SIMULATED: Final = (
    "`run` and `preflight` start its simulated rover, and always without a key: leave signing_key out, or "
    "start one by `handfast rover-simulator` and name its place as the connection"
)


def give_signing_keys(options: argparse.Namespace) -> int:
    """Give vehicles their keys; return the exit status."""
    interrupt = Interrupt()
    with interrupt.caught():
        fleet = load_unresolved(options)
        named = robots_named(fleet, options)
        robots = [robot for robot in fleet.robots if not named or robot.id in named]
        signing = [robot for robot in robots if has_key(robot)]
        if not signing:
            raise InputError(
                f"{options.fleet}: no robot that is meant has mavlink.signing_key: name a file there, and "
                "--make-keys makes it"
            )
        reached = [robot for robot in signing if not robot.is_simulated]
        prepare_keys(reached, make=options.make_keys)
        for robot in robots:
            if robot not in reached:
                print(f"robot {robot.id}: {NOT_DONE + SIMULATED if robot in signing else NO_KEY}", flush=True)
        done = _give(fleet, reached, interrupt) if reached else 0
    if interrupt.count:
        return INTERRUPTED
    return PASSED if done == len(signing) else FAILED


def _give(fleet: Fleet, robots: Sequence[Robot], interrupt: Interrupt) -> int:
    """Gives these robots their keys, and says of each what became of it; how many sign."""
    from handfast.agent.runtime.loop import RealClock
    from handfast.bridges.mavlink.bridge.signing_setup import Outcome, SigningSetup, give_keys, open_setup
    from handfast.bridges.mavlink.session.identity import SigningError

    def ended(robot: int, outcome: Outcome) -> None:
        print(f"robot {robot}: {'' if outcome.done else NOT_DONE}{outcome.text}", flush=True)

    clock = RealClock()
    setups: dict[int, SigningSetup] = {}
    try:
        for robot in robots:
            try:
                setups[robot.id] = open_setup(fleet, robot.id, clock)
            except (SigningError, ValueError) as error:
                raise InputError(f"robot {robot.id}: {error}") from None
        print(IN_CLEAR, file=sys.stderr)
        give_keys(setups, clock, lambda: interrupt.count > 0, ended)
    finally:
        for setup in setups.values():
            setup.close()
    outcomes = {robot: setup.outcome for robot, setup in setups.items()}
    for number, outcome in outcomes.items():
        if outcome is None:
            print(f"robot {number}: {NOT_DONE}interrupted, it may have the key or not: do this again")
    return sum(outcome is not None and outcome.done for outcome in outcomes.values())


def has_key(robot: Robot) -> bool:
    """Whether a robot is a vehicle that is to sign its messages."""
    link = robot.section(MavlinkSection)
    return link is not None and link.signing_key is not None


def prepare_keys(robots: Sequence[Robot], *, make: bool) -> None:
    """Sees that each of these robots (`has_key`) has a key that can be used, before any vehicle is spoken to.

    Args:
        make: whether to make files that are not there, with their folders, for this user only.

    Raises:
        InputError: a key is missing, or cannot be used or made.
    """
    from handfast.bridges.mavlink.session.identity import SigningError, load_key, make_key

    for robot in robots:
        link = robot.section(MavlinkSection)
        assert link is not None
        assert link.signing_key is not None
        path = Path(link.signing_key).expanduser()
        missing = not os.path.lexists(path)
        if missing and not make:
            raise InputError(f"robot {robot.id}: there is no signing key {path}: --make-keys makes one")
        try:
            if missing:
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                make_key(path)
                print(f"robot {robot.id}: made {path}: keep a copy, its ground station needs it too")
            load_key(path)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise InputError(f"robot {robot.id}: cannot make the folder {path.parent}: {reason}") from None
        except SigningError as error:
            raise InputError(f"robot {robot.id}: {error}") from None
