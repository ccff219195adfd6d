"""The command ``handfast drive``: drives a fleet that is up, on its hosts or on this machine."""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import suppress
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.arguments import (
    InputError,
    describe,
    fleet_path,
    place_for,
    report_arguments,
    view_argument,
)
from handfast.deploy.drive.outcome import finish, refuse_errors, run_folder
from handfast.deploy.inventory.known_fleets import handled

if TYPE_CHECKING:
    from pathlib import Path

    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.inventory.registry import Registration
    from handfast.deploy.report.run_folder import RunFolder
    from handfast.deploy.view.beside import PageBeside

ROBOTS_FILE: Final = "robots.toml"
"""The fleet as its robots read it, for commands such as `handfast stop`. The folder's ``fleet.toml`` is what
is driven: that may have another duration, and more orders."""
_FIXED: Final = ("--set", "--law", "--seed", "--faults")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast drive`` takes."""
    describe(
        parser,
        ". FLEET is the fleet file that the robots read, or a "
        "bundled fleet: `handfast up` has brought it up on its hosts, or somebody has started its agents and "
        "plants. What `run` does besides starting and ending processes: gives the mission and the file's "
        "orders, shows and records, and stops every robot at the end or at Ctrl-C. A process that "
        "disappears is reported, and the others drive on. Exit status: 0 fine; 1 the verdict failed, or the "
        "fleet does not answer; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file, or name of a bundled fleet")
    parser.add_argument("--duration", metavar="TIME", help="how long, instead of what the file says")
    parser.add_argument("--orders", metavar="FILE", help="add the [[order]] tables of a file")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="lift a stop that somebody has ordered; without it only that of a drive's regular end is",
    )
    parser.add_argument(
        "--detach",
        action="store_true",
        help="give the mission and end: nobody records, robots drive alone to its end",
    )
    parser.add_argument(
        "--out",
        type=place_for,
        metavar="DIR",
        help="the drive's folder (default: runs/FLEET-TIME); must be empty or new",
    )
    report_arguments(parser)
    parser.add_argument(
        "--no-check", dest="check", action="store_false", help="drive even where `check` finds errors"
    )
    parser.add_argument("--quiet", action="store_true", help="say only what went wrong and the verdict")
    view_argument(parser)
    for option in _FIXED:
        parser.add_argument(option, dest="fixed", action=_Fixed, help=argparse.SUPPRESS)
    parser.set_defaults(command=handled(_drive))


class _Fixed(argparse.Action):
    """An option of `run` that would change what robots have read already."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        raise InputError(
            f"drive: {option_string} changes the fleet file, which the robots have read already: bring them "
            f"up with it (`handfast up FLEET {option_string} ...`), or drive it here with `handfast run`"
        )


def _drive(options: argparse.Namespace) -> int:
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.drive.attached import refused

    options.given_ns = time.time_ns()
    fleet, driven = _fleets(options)
    interrupt = Interrupt()
    with interrupt.caught():
        _refuse_what_cannot_be(options, driven)
        refuse_errors(options, driven)
        _warn_of_certificates(options, fleet)
        why = refused(fleet, interrupt, resume=options.resume, given_ns=options.given_ns)
        if interrupt.count:
            return INTERRUPTED
        if why:
            raise InputError(f"not started: {why}")
        if options.detach:
            return _detach(options, fleet, driven, interrupt)
        folder = run_folder(options, driven, "run")
        from handfast.deploy.view.beside import PageBeside

        with PageBeside(folder.path, interrupt, wanted=options.view) as page:
            return _attend(options, fleet, driven, folder, interrupt, page)


def _warn_of_certificates(options: argparse.Namespace, fleet: Fleet) -> None:
    """Says which certificates end soon, as far as this machine knows."""
    from handfast.deploy.inventory.expiry import operators, robots_by_index, warnings

    now_s = time.time()
    for text in warnings((*operators(fleet, options.fleet), *robots_by_index(fleet, options.fleet)), now_s):
        print(f"warning: {text}", file=sys.stderr)


def _fleets(options: argparse.Namespace) -> tuple[Fleet, Fleet]:
    """The fleet as its robots read it, and as it is to be driven.

    Raises:
        InputError, handfast.agent.fleet.model.FleetError: it cannot be.
    """
    from handfast.agent.formation.geometry import resolved

    path = fleet_path(options.fleet)
    changes = [] if options.duration is None else [f"fleet.duration_s={options.duration}"]
    fleet = resolved(load_fleet(path))
    driven = resolved(load_fleet(path, changes, orders=options.orders))
    if any(robot.host is not None for robot in fleet.robots):
        from handfast.deploy.inventory.hosts import located

        fleet = located(fleet)
    return fleet, driven


def _refuse_what_cannot_be(options: argparse.Namespace, driven: Fleet) -> None:
    """`InputError` for what only `run` can do, and for what nobody would do after `--detach`."""
    from handfast.agent.links.fault_plan import FaultPlan
    from handfast.deploy.faults.process_actions import actions

    plan = actions(FaultPlan(driven).file_rules(), driven.ids, driven.fleet.duration_s)
    if plan:
        rules = ", ".join(sorted({repr(action.rule) for action in plan}))
        raise InputError(
            f"{options.fleet}: the fault rules {rules} kill, pause or restart processes, which only "
            "`handfast run` and `simulate` do"
        )
    if not options.detach:
        return
    if options.out is not None:
        raise InputError("--out: there is no folder with --detach: nobody records")
    if options.view:
        raise InputError("--view: this ends at once with --detach; `handfast view` shows the fleet then")
    if driven.supervision.deadman_s is not None:
        raise InputError(
            f"--detach: {driven.fleet.name} has a dead-man's switch (supervision.deadman_s = "
            f"{driven.supervision.deadman_s:g}): its robots hold without an operator's heartbeat"
        )
    if driven.orders:
        at = ", ".join(f"{order.at:g} s ({order.kind})" for order in driven.orders)
        raise InputError(f"--detach: nobody would give the orders at {at}")


def _attend(
    options: argparse.Namespace,
    fleet: Fleet,
    driven: Fleet,
    folder: RunFolder,
    interrupt: Interrupt,
    page: PageBeside,
) -> int:
    """Drives it to the end, and reports."""
    from handfast.agent.transport.bus import BusError
    from handfast.deploy.commands.running.ways import by_ssh
    from handfast.deploy.drive.attached import Attached
    from handfast.deploy.drive.display.live_view import make_view
    from handfast.deploy.drive.drive import Drive
    from handfast.deploy.drive.preconditions import BROKEN_OFF
    from handfast.deploy.recording.run_files import RecordingError
    from handfast.deploy.session.operator_bus import operator_bus

    view, processes = make_view(quiet=options.quiet), Attached(fleet)
    try:
        with view, _registered(fleet, folder.path), operator_bus(fleet) as bus:
            drive = Drive(
                *(fleet, processes, bus, folder.record, view, interrupt),
                duration_s=driven.fleet.duration_s,
                orders=driven.orders,
                resume=options.resume,
                given_ns=options.given_ns,
                ways=lambda: by_ssh(fleet),
            )
            drive.run()
    except BaseException as error:
        # Whatever it is: what was recorded until then can be read.
        with suppress(RecordingError):
            folder.close([str(error) or BROKEN_OFF])
        if not isinstance(error, BusError | RecordingError):
            raise
        print(f"handfast: {error}", file=sys.stderr)
        return FAILED
    page.over()
    status = finish(
        options, folder, drive.reasons, interrupt, warnings=[*drive.warnings, *processes.warnings]
    )
    page.recorded()
    return status


def _registered(fleet: Fleet, folder: Path) -> Registration:
    """Makes the drive known, with the fleet as its robots read it.

    Raises:
        InputError: a file cannot be written.
        handfast.agent.runtime.order_store.NotPrivateError: see there.
    """
    import tomli_w

    from handfast.agent.fleet.loading import to_dict
    from handfast.agent.runtime.order_store import NotPrivateError
    from handfast.deploy.inventory.registry import Registration

    path = folder / ROBOTS_FILE
    try:
        path.write_text(tomli_w.dumps(to_dict(fleet)), encoding="utf-8")
        return Registration(fleet.fleet.name, folder, path, attached=True)
    except NotPrivateError:
        raise
    except OSError as error:
        where, what = error.filename or path, error.strerror or error
        raise InputError(f"not started: cannot write {where}: {what}") from None


def _detach(options: argparse.Namespace, fleet: Fleet, driven: Fleet, interrupt: Interrupt) -> int:
    """Gives the mission and ends, while the robots drive on."""
    from handfast.deploy.commands.running.ways import by_ssh
    from handfast.deploy.drive.attached import Attached
    from handfast.deploy.drive.display.live_view import make_view
    from handfast.deploy.drive.drive import Drive
    from handfast.deploy.drive.preconditions import clock
    from handfast.deploy.session.operator_bus import operator_bus
    from handfast.deploy.session.session import valid

    view = make_view(quiet=options.quiet)
    with view, operator_bus(fleet) as bus:
        drive = Drive(
            *(fleet, Attached(fleet), bus, lambda _, __, payload: valid(payload), view, interrupt),
            duration_s=driven.fleet.duration_s,
            orders=(),
            resume=options.resume,
            given_ns=options.given_ns,
            ways=lambda: by_ssh(fleet),
        )
        drive.run(detach=True)
    if drive.is_left and not drive.reasons:
        until = clock(drive.end_ns, time.time_ns())
        print(f"{fleet.fleet.name} drives until {until}; `handfast stop {quote(options.fleet)}` stops it")
    if interrupt.count:
        return INTERRUPTED
    return FAILED if drive.reasons else PASSED
