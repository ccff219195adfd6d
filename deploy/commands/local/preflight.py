"""The command ``handfast preflight``."""

from __future__ import annotations

import argparse
import sys

from agent.common.exit import FAILED, INTERRUPTED, PASSED
from deploy.console.arguments import describe, fleet_arguments, load
from deploy.console.interrupt import Interrupt


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast preflight`` takes."""
    describe(
        parser,
        ". Bridges run for it, and end with it; nothing is armed or "
        "driven. Exit status: 0 nothing blocks; 1 something does; 2 bad input; 130 after Ctrl-C.",
    )
    fleet_arguments(parser)
    parser.add_argument("--json", action="store_true", help="as JSON, for other programs")
    parser.add_argument(
        "--each", action="store_true", help="all that was found of each vehicle, also of several"
    )
    parser.set_defaults(command=_preflight)


def _preflight(options: argparse.Namespace) -> int:
    from agent.transport.bus import BusError
    from deploy.drive.preflight import Preflight, passed, show, to_json
    from deploy.processes.placement import place

    interrupt = Interrupt()
    with interrupt.caught():
        fleet = load(options)
        placed, ports, vehicles = place(fleet)
        try:
            found = Preflight(placed, vehicles, interrupt).run()
        except BusError as error:
            print(f"handfast: {error}", file=sys.stderr)
            return FAILED
        finally:
            ports.close()
    if interrupt.count:
        return INTERRUPTED
    if options.json:
        print(to_json(fleet.fleet.name, found))
    else:
        show(found, sys.stdout, each=options.each)
    return PASSED if passed(found) else FAILED
