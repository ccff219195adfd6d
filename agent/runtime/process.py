"""How every process of a robot starts and ends; what it does in between is its loop."""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from handfast.agent.common.errors import BAD_INPUT, FAILED, PASSED, Error
from handfast.agent.common.time import Clock
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.ticks import Deadlines
from handfast.agent.messages import key_expressions
from handfast.agent.node import Node
from handfast.agent.runtime.loop import A_ROUTER, Log, OrderKeeper, RealClock, loop
from handfast.agent.runtime.order_store import OrderStore
from handfast.agent.runtime.preloaded import fleet_of, started
from handfast.agent.runtime.service import Shutdown, SystemdNotifier, add_parent_argument, wait_until_valid
from handfast.agent.security.credentials import CredentialsError, NotValidNowError
from handfast.agent.security.identity import of_robot
from handfast.agent.security.private_files import KeyFileError
from handfast.agent.transport.bus import Bus, BusError, is_opening
from handfast.agent.transport.sealed_bus import bus_for

GARBAGE: Final = 5_000
"""The collector looks each time that so many more objects are there than were: a loop makes hardly any that
count on each other."""


class StartError(RuntimeError):
    """A process's part cannot be made; the text is one clear message."""


class Start(NamedTuple):
    """What a process serves: the endpoints to listen on and to connect to; `close` is called at its end.

    Attributes:
        ticks_from: when the node ticks from a time on, ns (`agent.runtime.loop.loop`).
        beside: robots whose process it is as well.
    """

    node: Node
    listen: Sequence[str]
    connect: Sequence[str]
    ticks_from: Callable[[int], Deadlines]
    close: Callable[[], None] = lambda: None
    beside: Sequence[int] = ()


def names_of(fleet: Fleet, robot: int) -> dict[str, str]:
    """Who is at which endpoint, as texts of a process of `robot` have it."""
    routers = zip(fleet.router_endpoints, fleet.routers, strict=True)
    names = {endpoint: f"{A_ROUTER}{router.where}" for endpoint, router in routers}
    for other in fleet.ids:
        names[fleet.agent_endpoint(other)] = f"robot {other}"
        names[fleet.plant_endpoint(other)] = f"robot {other}'s plant"
    names[fleet.agent_near(robot)] = "its agent"
    names[fleet.plant_near(robot)] = "its plant"
    return names


def appear(node: Node, bus: Bus, clock: Clock, keeper: OrderKeeper | None) -> None:
    """Puts `node` on the bus, with what it was ordered before it started."""
    for key in node.publications:
        bus.declare(key)
    bus.listen(node.subscriptions)
    if keeper is not None:
        keeper.recall(clock.now_ns())
    for key in node.alive_keys:
        bus.announce(key)  # from here on others may count on being heard
    # What was made so far lives as long as the process: the collector need not look at it again.
    gc.collect()
    gc.freeze()
    gc.set_threshold(GARBAGE)


def _say_rejected(node: Node, log: Log) -> None:
    if node.rejected:
        reasons = sorted(((count, name) for name, count in node.rejected.items()), reverse=True)
        shown = ", ".join(f"{count} {name}" for count, name in reasons)
        log(f"ignored {sum(node.rejected.values())} messages that were not valid: {shown}")


def robot_arguments(
    program: str, description: str, own: Sequence[argparse.ArgumentParser] = ()
) -> argparse.ArgumentParser:
    """Parser of what the command line of every process of a robot has; `own` have what it has besides."""
    parser = argparse.ArgumentParser(prog=program, description=description, parents=own)
    parser.add_argument("--fleet", required=True, metavar="FILE", help="the fleet file (TOML)")
    parser.add_argument("--robot", required=True, type=int, metavar="ID", help="id of the robot in that file")
    parser.add_argument("--keys", metavar="DIR", help="folder of the robot's key and certificates")
    add_parent_argument(parser)
    return parser


def log_name(robot: int, role: str) -> str:
    """The name of the log of a robot's process."""
    return f"robot-{robot}-{role}.log"


def logger(whose: str, role: str, path: Path | None = None) -> Log:
    """Writes lines of a process's log. Others' words may be in them: these move no terminal's cursor.

    Args:
        path: the file that they are added to; None, or where that cannot be written: standard error.
    """

    def log(text: str) -> None:
        lines = "\n".join(map(printable, text.split("\n")))
        with suppress(OSError), nullcontext(sys.stderr) if path is None else open(path, "a") as file:
            print(f"{whose} {role}: {lines}", file=file, flush=True)
            return
        print(f"{whose} {role}: {lines}", file=sys.stderr, flush=True)

    return log


def open_bus(fleet: Fleet, robot: int, folder: str | None, log: Log, **bus: Any) -> Bus:
    """The bus of one of a robot's processes: see `agent.transport.sealed_bus.bus_for`.

    Raises:
        handfast.agent.transport.bus.BusError: it cannot be opened now; nor can it with a certificate that is
        not valid
            now (`agent.runtime.service`).
        StartError: the fleet is secured and the robot's certificate cannot be used.
    """
    if not fleet.is_secured:
        return bus_for(fleet, None, None, log, **bus)
    if folder is None:
        raise StartError(
            "this fleet is secured: give the folder of the robot's key and certificates, --keys DIR, or set "
            'network.security = "off"'
        )
    try:
        return bus_for(fleet, of_robot(fleet.fleet.name, robot), Path(folder), log, **bus)
    except NotValidNowError as error:
        raise BusError(str(error)) from None
    except CredentialsError as error:
        raise StartError(str(error)) from None


def _store(options: argparse.Namespace, role: str, log: Log) -> AbstractContextManager[OrderStore | None]:
    """Where the process keeps operators' orders, if it was told to.

    Raises:
        StartError: that cannot be used.
    """
    if options.orders is None:
        return nullcontext()
    try:
        return OrderStore(Path(options.orders), options.robot, role, log)
    except KeyFileError as error:
        raise StartError(f"cannot keep operators' orders: {error}") from None


def _run(
    options: argparse.Namespace,
    role: str,
    start: Callable[[Fleet, int, Clock, Log], Start],
    shutdown: Shutdown,
    service: SystemdNotifier,
    log: Log,
) -> bool:
    """Serves until the process is asked to end; whether links are left to the kernel to close. Raises as
    `open_bus` and `start` do."""
    waits = False

    def waiting() -> bool:
        nonlocal waits
        if not waits:
            log("no router answers yet: waiting for one")
            service.waits("waiting for a router")
        waits = True
        service.lives(time.monotonic_ns())
        return not asked()

    def asked() -> bool:
        shutdown.look_for_parent()
        return shutdown.asked

    fleet = fleet_of(options.fleet, options.overrides, options.law)
    # Before the wall clock is read for good: it may be set meanwhile.
    identity = of_robot(fleet.fleet.name, options.robot) if fleet.is_secured else None
    wait_until_valid(identity, options.keys, asked, service, log)
    if shutdown.asked:
        return False
    clock = RealClock(*FaultPlan(fleet).clock(options.robot))
    node, listen, connect, ticks_from, close, beside = start(fleet, options.robot, clock, log)
    robots = options.robot, *beside
    node.runs_by(clock.machine)
    try:
        with (
            open_bus(
                fleet,
                options.robot,
                options.keys,
                log,
                listen=listen,
                connect=connect,
                near={key for robot in robots for key in key_expressions.near(fleet.fleet.name, robot)},
                go_on_waiting=waiting,
                is_wanted=lambda: not asked(),
                in_batches=True,
            ) as bus,
            _store(options, role, log) as store,
        ):
            keeper = None if store is None else OrderKeeper(node, bus, store, fleet.fleet.name, log)
            appear(node, bus, clock, keeper)
            started()
            service.ready()
            names = names_of(fleet, options.robot)
            loop(node, bus, clock, shutdown, log, service, keeper, names, ticks_from)
            _say_rejected(node, log)
            bus.leave()
            return True
    finally:
        close()


def main(
    argv: Sequence[str] | None,
    program: str,
    role: str,
    start: Callable[[Fleet, int, Clock, Log], Start],
    own: Sequence[argparse.ArgumentParser] = (),
) -> int:
    """Command line of a robot's process: reads the fleet file, opens the bus, serves.

    Args:
        own: have the program's own options, which its help names; they have been read.
        start: makes the process's part from the fleet, the robot's id, the clock and what writes a line
            of the log. May raise `Error` or `StartError`.

    Returns the exit status: 0 when it was asked to end, 1 when the bus cannot be opened now, 2 for bad input.
    """
    parser = robot_arguments(program, f"The {role} of one robot of a fleet.", own)
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="A.B=V", help="override a field"
    )
    parser.add_argument("--law", help="preset of the control law: paper, edge, joint or penalty")
    parser.add_argument("--orders", metavar="DIR", help="folder in which operators' orders outlive it")
    options = parser.parse_args(argv)
    shutdown = Shutdown(with_parent=options.exit_with_parent)
    log = logger(f"robot {options.robot}", role)
    left = False
    try:
        with SystemdNotifier() as service:
            left = _run(options, role, start, shutdown, service, log)
    except BusError as error:
        if not shutdown.asked:
            log(str(error))
            return FAILED
        left = is_opening()
    except (Error, StartError) as error:
        log(str(error))
        return BAD_INPUT
    if left:
        # A process that closes its links in order waits for each that it has begun to open, and sixty that do
        # so at once keep each other from it. The kernel closes them, and others see that in milliseconds.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(PASSED)
    return PASSED
