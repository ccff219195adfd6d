"""A simulated rover as a process: its ports are sockets, its time is the machine's.

handfast rover-simulator --listen tcp:127.0.0.1:5760 --hand-over
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Final

from handfast.agent.common.errors import BAD_INPUT, FAILED, PASSED
from handfast.agent.common.time import NS_PER_S, Clock
from handfast.agent.runtime.loop import RealClock
from handfast.agent.runtime.service import PARENT_PERIOD_NS, Shutdown, add_parent_argument
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.rover import Rover
from handfast.bridges.mavlink.simulator.settings import (
    DEFAULT_HOME,
    Settings,
    SettingsError,
    parse_home,
    parse_parameter,
)
from handfast.bridges.mavlink.simulator.sockets import Endpoint, Line, open_lines, parse_endpoint, readable

DEFAULT_ENDPOINTS: Final = tuple(Endpoint("tcp", "127.0.0.1", port, True) for port in (5760, 5762, 5763))
"""Ports as ArduPilot's own simulator has them, of this machine only."""
HELD_UP_NS: Final = NS_PER_S
"""A process that was held up for longer has lost that time, instead of making up for it all at once."""
TYPES: Final = {
    "rover": (constants.TYPE_GROUND_ROVER, constants.AUTOPILOT_ARDUPILOT),
    "boat": (constants.TYPE_SURFACE_BOAT, constants.AUTOPILOT_ARDUPILOT),
    "copter": (constants.TYPE_QUADROTOR, constants.AUTOPILOT_ARDUPILOT),
    "plane": (constants.TYPE_FIXED_WING, constants.AUTOPILOT_ARDUPILOT),
    "sub": (constants.TYPE_SUBMARINE, constants.AUTOPILOT_ARDUPILOT),
    "px4": (constants.TYPE_GROUND_ROVER, constants.AUTOPILOT_PX4),
}
Log = Callable[[str], None]


def serve(rover: Rover, lines: Sequence[Line], clock: Clock, shutdown: Shutdown, log: Log) -> int:
    """Drives `rover` by `clock` until the process is asked to end or the rover's would: its exit status.

    It wakes once a loop, as an autopilot without interrupts does: what arrives waits for that.
    """
    lost_ns = 0
    parent_due_ns = 0
    boots = rover.boots
    while not shutdown.asked:
        clock.sleep_until(rover.next_ns + lost_ns)
        now_ns = clock.now_ns() - lost_ns
        late_ns = now_ns - rover.next_ns
        if late_ns > HELD_UP_NS:
            log(f"was held up for {late_ns / NS_PER_S:.1f} s")
            lost_ns += late_ns
            now_ns -= late_ns
        for number, line in readable(lines):
            data = line.receive(now_ns)
            rover.set_open(number, line.is_open)
            if data:
                rover.receive(number, data, now_ns)
        out: dict[int, list[bytes]] = {}
        for number, message in rover.advance(now_ns):
            out.setdefault(number, []).append(message)
        for number, messages in out.items():
            lines[number].send(messages)
        for text in rover.take_log():
            log(text)
        if rover.crashed:
            return FAILED
        if rover.boots != boots:
            boots = rover.boots
            for number, line in enumerate(lines):
                line.restart()
                rover.set_open(number, line.is_open)
        if now_ns >= parent_due_ns:
            parent_due_ns = now_ns + PARENT_PERIOD_NS
            shutdown.look_for_parent()
    log(f"ending ({shutdown.why})")
    return PASSED


class _Append(argparse.Action):
    """--listen and --connect in the order in which they were given: that is the order of the ports."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        before = getattr(namespace, self.dest) or []
        setattr(namespace, self.dest, [*before, (option_string == "--listen", values)])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="handfast rover-simulator",
        description="A MAVLink vehicle that behaves as ArduPilot Rover was measured to.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--listen",
        dest="endpoints",
        action=_Append,
        metavar="tcp:HOST:PORT|udp:HOST:PORT",
        help="a port (repeatable); the first of --listen and --connect is the first serial port "
        "(default: tcp:127.0.0.1:5760, 5762 and 5763)",
    )
    parser.add_argument(
        "--connect",
        dest="endpoints",
        action=_Append,
        metavar="udp:HOST:PORT",
        help="a port that sends there, as a radio or MAVProxy does (repeatable)",
    )
    parser.add_argument("--system", type=int, default=1, metavar="ID", help="MAVLink system id (default: 1)")
    parser.add_argument(
        "--home",
        metavar="LAT,LON,ALT,YAW",
        help="where it stands and points, in degrees and m; "
        f"default: {DEFAULT_HOME.latitude_deg},{DEFAULT_HOME.longitude_deg},{DEFAULT_HOME.altitude_m:g},0",
    )
    parser.add_argument("--warm", action="store_true", help="it has been on for a while, and is ready")
    parser.add_argument(
        "--boot",
        type=float,
        default=40.0,
        metavar="SECONDS",
        help="from switching on to EKF and GPS being ready (default: 40, as measured)",
    )
    parser.add_argument(
        "--hand-over",
        action="store_true",
        help="the simulated operator sets GUIDED and arms as soon as the pre-arm checks are good",
    )
    parser.add_argument(
        "--param", action="append", default=[], metavar="NAME=VALUE", help="a parameter (repeatable)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of its errors and jitter (default: 0)")
    parser.add_argument("--type", choices=sorted(TYPES), default="rover", help="what it says it is")
    add_parent_argument(parser)
    return parser


def _settings(options: argparse.Namespace, ports: int) -> Settings:
    home, yaw = (DEFAULT_HOME, 0.0) if options.home is None else parse_home(options.home)
    vehicle_type, autopilot = TYPES[options.type]
    return Settings(
        system=options.system,
        home=home,
        yaw=yaw,
        boot="warm" if options.warm else "cold",
        boot_s=options.boot,
        hand_over=options.hand_over,
        parameters=dict(parse_parameter(text) for text in options.param),
        seed=options.seed,
        vehicle_type=vehicle_type,
        autopilot=autopilot,
        ports=ports,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the simulator. Returns the exit status: 0 when it was asked to end, 1 when the vehicle
    crashed, 2 for bad input."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if "--home" in arguments[:-1]:
        # A latitude south of the equator looks like an option.
        at = arguments.index("--home")
        arguments[at : at + 2] = [f"--home={arguments[at + 1]}"]
    options = _parser().parse_args(arguments)

    def log(text: str) -> None:
        print(f"rover {options.system}: {text}", file=sys.stderr, flush=True)

    try:
        endpoints = [
            parse_endpoint(text, listens=listens) for listens, text in options.endpoints or ()
        ] or list(DEFAULT_ENDPOINTS)
        settings = _settings(options, len(endpoints))
        lines = open_lines(endpoints)
    except SettingsError as error:
        log(str(error))
        return BAD_INPUT
    shutdown = Shutdown(with_parent=options.exit_with_parent)
    try:
        clock = RealClock()
        rover = Rover(settings, clock.now_ns())
        for number, line in enumerate(lines):
            rover.set_open(number, line.is_open)
            log(f"{'listens on' if line.endpoint.listens else 'sends to'} {line.endpoint}")
        return serve(rover, lines, clock, shutdown, log)
    finally:
        for line in lines:
            line.close()


if __name__ == "__main__":
    sys.exit(main())
