"""The command ``handfast preflight``."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Final

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.arguments import InputError, describe, fleet_arguments, fleet_path, load
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.inventory.known_fleets import handled

if TYPE_CHECKING:
    from handfast.deploy.drive.preflight import Found


_CHANGES: Final = ("overrides", "law", "faults", "duration", "seed", "orders")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast preflight`` takes."""
    describe(
        parser,
        ". Bridges run for it, and end with it; those of a fleet with hosts run there since `handfast up`, "
        "and are asked. Nothing is armed, driven or changed. Parameters to change are written into "
        "FLEET-parameters/robot-N.param, for a ground station to load. Exit status: 0 nothing blocks; 1 "
        "something does; 2 bad input; 130 after Ctrl-C.",
    )
    fleet_arguments(parser)
    parser.add_argument("--json", action="store_true", help="as JSON, for other programs")
    parser.add_argument(
        "--each", action="store_true", help="all that was found of each vehicle, also of several"
    )
    parser.set_defaults(command=handled(_preflight))


def _preflight(options: argparse.Namespace) -> int:
    from handfast.deploy.drive.preflight import passed, show, to_json, write_parameters

    fleet = load(options)
    interrupt = Interrupt()
    with interrupt.caught():
        on_hosts = any(robot.host is not None for robot in fleet.robots)
        found = _on_hosts(options, fleet, interrupt) if on_hosts else _here(fleet, interrupt)
    if interrupt.count:
        return INTERRUPTED
    if options.json:
        print(to_json(fleet.fleet.name, found))
    else:
        show(found, sys.stdout, each=options.each)
    note = write_parameters(found, fleet.fleet.name)
    if note:
        print(note, file=sys.stderr if options.json else sys.stdout)
    return PASSED if passed(found) else FAILED


def _here(fleet: Fleet, interrupt: Interrupt) -> Found:
    """What bridges find that run on this machine for it.

    Raises:
        handfast.agent.transport.bus.BusError: they cannot be heard.
    """
    from handfast.deploy.drive.preflight import Preflight
    from handfast.deploy.processes.placement import place

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
    from handfast.deploy.hosts.preflight import HostsPreflight
    from handfast.deploy.inventory.hosts import located

    for name in _CHANGES:
        if getattr(options, name):
            option = "--set" if name == "overrides" else f"--{name}"
            raise InputError(
                f"preflight: {option} changes the fleet file, which the bridges on its hosts have read "
                f"already: change the file and run `handfast up {options.fleet}`"
            )
    return HostsPreflight(located(fleet), str(fleet_path(options.fleet)), interrupt).run()
