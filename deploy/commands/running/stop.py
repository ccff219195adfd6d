"""The command ``handfast stop``: every robot of a fleet that is running brakes, and stays."""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from shlex import quote
from typing import TYPE_CHECKING, Final

from handfast.agent.common.errors import FAILED, PASSED
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.console.arguments import InputError, describe
from handfast.deploy.inventory.known_fleets import MEANING, NoAnswerError, as_running, handled

if TYPE_CHECKING:
    from handfast.deploy.inventory.known_fleets import KnownFleet


CUT_SHORT: Final = (
    "handfast: interrupted: robots may drive on. Who heard the stop brakes, and tells the others; say it "
    "again, or look with `handfast status`"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast stop`` takes."""
    describe(
        parser,
        f". {MEANING} It uses every channel there is, side by side: links, a file on this machine, ssh "
        "to the robots' hosts. Robots that cannot be reached now stop as soon as another one relays it. Exit "
        "status: 0 all agents and plants brake; 1 not all; 2 bad input.",
    )
    parser.add_argument("fleet", metavar="FLEET", nargs="?", help="a fleet that is running")
    parser.add_argument(
        "--all",
        action="store_true",
        help="every fleet of that name, or without FLEET all that `handfast status` lists, side by side",
    )
    parser.add_argument(
        "--each",
        action="store_true",
        help="a line for each robot; without it those that brake are summed up",
    )
    parser.add_argument("--reason", default="", metavar="TEXT", help="why, for people")
    parser.set_defaults(command=handled(_stop))


def _stop(options: argparse.Namespace) -> int:
    try:
        return _stopped(options)
    except KeyboardInterrupt:
        print(CUT_SHORT, file=sys.stderr)
        raise


def _stopped(options: argparse.Namespace) -> int:
    from handfast.deploy.inventory.known_fleets import NONE, NotRunningError, SeveralError, find, known, meant

    if options.all:
        fleets = known() if options.fleet is None else meant(options.fleet)
        status = PASSED if options.fleet is not None else _say_unreadable()
        if not fleets and status == PASSED:
            raise NotRunningError(f"{NONE}, and none is up: nothing to stop")
        return max(_stop_all(fleets, options), status)
    if options.fleet is None:
        raise InputError("stop: which fleet? Give its name, or --all; `handfast status` shows all")
    try:
        one = find(options.fleet)
    except SeveralError as error:
        everyone = f"or stop them all: handfast stop {quote(options.fleet)} --all"
        raise NotRunningError(error.text("handfast stop", everyone)) from None
    try:
        lines, done = _outcome(as_running(one), options)
    finally:
        _say_unreadable()  # it may be what is meant
    for line in lines:
        print(line)
    return PASSED if done else FAILED


def _outcome(fleet: Fleet, options: argparse.Namespace) -> tuple[list[str], bool]:
    """What became of a stop, in words, and whether all brake; raises as `deploy.session.stop.stop`."""
    from handfast.deploy.commands.running.ways import ways
    from handfast.deploy.drive.preconditions import somebodys
    from handfast.deploy.session.stop import stop

    stopping, troubles = stop(fleet, somebodys(options.reason), ways(fleet))
    said = [] if stopping.done else [printable(trouble) for trouble in troubles]
    return [*stopping.outcomes(each=options.each or len(fleet.ids) == 1), *said], stopping.done


def _stop_all(fleets: list[KnownFleet], options: argparse.Namespace) -> int:
    """Stops them side by side, so that none waits for another, and says of each what came of it."""
    from handfast.agent.transport.bus import BusError
    from handfast.deploy.inventory.known_fleets import NotRunningError

    def one(fleet: KnownFleet) -> tuple[list[str], bool]:
        try:
            return _outcome(as_running(fleet), options)
        except (BusError, FleetError, InputError, NoAnswerError, NotRunningError) as error:
            return [f"NOT stopped: {error}"], False

    status = PASSED
    if fleets:
        with ThreadPoolExecutor(len(fleets), "stop") as pool:
            jobs = {pool.submit(one, fleet): fleet for fleet in fleets}
            for job in as_completed(jobs):
                lines, done = job.result()
                print(f"{jobs[job].name} ({jobs[job].about}):", *lines, sep="\n  ", flush=True)
                status = status if done else FAILED
    return status


def _say_unreadable() -> int:
    """Says what cannot be stopped, as it is not known what it is."""
    from handfast.deploy.inventory.known_fleets import unreadable

    lines = unreadable()
    for line in lines:
        print(f"handfast: {line}", file=sys.stderr)
    return FAILED if lines else PASSED
