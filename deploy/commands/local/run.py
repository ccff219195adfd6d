"""The command ``handfast run``: drives a fleet with processes on this machine, and reports."""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress

from handfast.agent.common.errors import FAILED
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import SHARED_LINKS, MavlinkSection
from handfast.deploy.console.arguments import (
    InputError,
    drive_arguments,
    fleet_arguments,
    fleet_path,
    load,
    view_argument,
)
from handfast.deploy.console.interrupt import NOT_STARTED, Interrupt
from handfast.deploy.drive.outcome import finish, refuse_errors, run_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast run`` takes."""
    fleet_arguments(parser)
    drive_arguments(parser)
    view_argument(parser)
    parser.set_defaults(command=_run)


def _run(options: argparse.Namespace) -> int:
    from handfast.agent.transport.bus import BusError
    from handfast.deploy.drive.display.live_view import make_view
    from handfast.deploy.drive.local import LocalRun
    from handfast.deploy.processes.placement import place
    from handfast.deploy.recording.run_files import RecordingError
    from handfast.deploy.view.beside import PageBeside

    interrupt = Interrupt()
    with interrupt.caught():
        with interrupt.answered(NOT_STARTED, raises=True):
            fleet = load(options)
            _refuse_links(options, fleet)
            refuse_errors(options, fleet)
            _refuse_overload(options, fleet)
        fleet, ports, vehicles = place(fleet)
        folder = run_folder(options, fleet, "run")
        view = make_view(quiet=options.quiet)
        run = LocalRun(fleet, folder, view, interrupt, vehicles, fleet_path(options.fleet))
        with PageBeside(folder.path, interrupt, wanted=options.view) as page:
            try:
                with view:
                    run.run()
            except (BusError, RecordingError, OSError) as error:
                print(f"handfast: {error}", file=sys.stderr)
                with suppress(RecordingError):
                    folder.close([str(error)])
                return FAILED
            finally:
                ports.close()
            page.over()
            status = finish(options, folder, run.reasons, interrupt, warnings=run.warnings)
            page.recorded()
            return status


def _refuse_links(options: argparse.Namespace, fleet: Fleet) -> None:
    """Raises `InputError` where robots on several hosts have the same link there, as each has its own serial
    port: this machine has it once."""
    first: dict[str, int] = {}
    for robot in fleet.robots:
        link = robot.section(MavlinkSection)
        if robot.host is None or robot.is_simulated or link is None or link.connection is None:
            continue
        if link.connection.startswith(SHARED_LINKS):
            continue
        other = first.setdefault(link.connection, robot.id)
        if other != robot.id:
            raise InputError(
                f"{options.fleet}: not started: robots {other} and {robot.id} both have {link.connection}, "
                "each on its own host: `handfast up` brings it up there; with simulated rovers here: --set "
                "robot_defaults.mavlink.connection=simulator"
            )


def _refuse_overload(options: argparse.Namespace, fleet: Fleet) -> None:
    """Says how many robots like those of a large fleet this machine carries.

    Raises:
        InputError: these are more, and the options do not say to drive all the same.
    """
    from handfast.deploy.check.capacity import describe_capacity, is_looked_at, overload

    if not is_looked_at(fleet):
        return
    from handfast.deploy.processes.machine import measured, measured_for

    machine = measured_for(fleet) if options.check else measured()
    text = overload(fleet, machine)
    if text and options.check:
        raise InputError(f"{options.fleet}: not started: {text} (--no-check drives all the same)")
    if not options.quiet:
        print(f"warning: {text}" if text else describe_capacity(fleet, machine), file=sys.stderr)
