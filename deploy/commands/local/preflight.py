"""The command ``handfast preflight``."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from agent.common.exit import FAILED, INTERRUPTED, PASSED
from agent.fleet.model import Fleet
from deploy.console.arguments import InputError, describe, fleet_arguments, fleet_path, load
from deploy.console.interrupt import Interrupt
from deploy.inventory.running import handled

if TYPE_CHECKING:
    from deploy.drive.preflight import Found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast preflight`` takes."""
    describe(
        parser,
        ". Bridges run for it, and end with it; those of a fleet with hosts run there since `handfast up`, "
        "and are asked. Nothing is armed or driven. Exit status: 0 nothing blocks (or all are set); 1 "
        "something does; 2 bad input; 130 after Ctrl-C.",
    )
    fleet_arguments(parser)
    parser.add_argument("--json", action="store_true", help="as JSON, for other programs")
    parser.add_argument(
        "--each", action="store_true", help="all that was found of each vehicle, also of several"
    )
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "--set-parameters",
        action="store_true",
        help="set the failsafes of disarmed vehicles that have one right value, after showing them and "
        "asking; what was there before is kept",
    )
    either.add_argument(
        "--restore-parameters",
        action="store_true",
        help="set back what --set-parameters has changed, likewise",
    )
    parser.add_argument("--yes", action="store_true", help="with either: do not ask, for scripts")
    parser.set_defaults(command=handled(_preflight))


def _preflight(options: argparse.Namespace) -> int:
    from deploy.commands.local.preflight_parameters import kept, set_parameters
    from deploy.drive.preflight import passed, show, to_json

    sets = options.set_parameters or options.restore_parameters
    if options.yes and not sets:
        raise InputError("preflight: --yes goes with --set-parameters or --restore-parameters")
    fleet = None if sets else load(options)
    interrupt = Interrupt()
    with interrupt.caught():
        if fleet is None:
            if options.json or options.each:
                raise InputError(
                    "preflight: --json and --each go with a look alone: say them in one of its own"
                )
            return set_parameters(options, interrupt)
        on_hosts = any(robot.host is not None for robot in fleet.robots)
        found = _on_hosts(options, fleet, interrupt) if on_hosts else _here(fleet, interrupt)
    if interrupt.count:
        return INTERRUPTED
    for note in kept(fleet):
        print(note, file=sys.stderr if options.json else sys.stdout)
    if options.json:
        print(to_json(fleet.fleet.name, found))
    else:
        show(found, sys.stdout, each=options.each)
    return PASSED if passed(found) else FAILED


def _here(fleet: Fleet, interrupt: Interrupt) -> Found:
    """What bridges find that run on this machine for it.

    Raises:
        agent.transport.bus.BusError: they cannot be heard.
    """
    from deploy.drive.preflight import Preflight
    from deploy.processes.placement import place

    placed, ports, vehicles = place(fleet)
    try:
        return Preflight(placed, vehicles, interrupt).run()
    finally:
        ports.close()


def _on_hosts(options: argparse.Namespace, fleet: Fleet, interrupt: Interrupt) -> Found:
    """What the bridges find that run on the fleet's hosts.

    Raises:
        InputError: the fleet is to be another one than those have read; nobody knows where a host is, or this
            operator may not hear them.
    """
    from deploy.commands.local.preflight_parameters import refuse_changes
    from deploy.hosts.preflight import HostsPreflight
    from deploy.inventory.hosts import located

    refuse_changes(options)
    return HostsPreflight(located(fleet), str(fleet_path(options.fleet)), interrupt).run()
