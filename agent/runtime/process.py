"""The fixed-rate loop of a process round a sans-IO core, and how every such process starts and ends."""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final, NamedTuple

from agent.common.errors import Error
from agent.common.exit import BAD_INPUT, FAILED, PASSED
from agent.common.time import NS_PER_S, Clock
from agent.common.wording import printable
from agent.fleet.model import Fleet
from agent.links.fault_plan import FaultPlan
from agent.links.ticks import Ticks
from agent.messages import key_expressions
from agent.messages.codec import decode, head
from agent.messages.types import Stop
from agent.node import TOLD_SHARE, Node
from agent.runtime.bus import Bus, BusError
from agent.runtime.certificate_wait import wait_until_valid
from agent.runtime.clock import RealClock
from agent.runtime.listening_gate import Gate
from agent.runtime.order_store import OrderStore
from agent.runtime.preloaded import fleet_of, started
from agent.runtime.presence import Watches
from agent.runtime.sealed_bus import bus_for
from agent.runtime.systemd_notify import SystemdNotifier
from agent.security.credentials import CredentialsError, NotValidNowError
from agent.security.identity import of_robot
from agent.security.private_files import KeyFileError

END_TIMEOUT_NS: Final = 3 * NS_PER_S // 10
"""A process that was asked to end has this long to bring its robot to a standstill."""
_STOP: Final = head(Stop)
STALL_NS: Final = NS_PER_S // 10
SETTLE_NS: Final = NS_PER_S // 500
"""A process that has stood for longer than the first takes what came meanwhile the second later."""
GATE_PERIOD_NS: Final = NS_PER_S // 5
"""How often is looked for who knocks, ns."""
LOOK_PERIOD_NS: Final = 2 * NS_PER_S // 5
"""How often is looked for the parent process, and for links over which nothing comes, ns."""
SAY_PERIOD_NS: Final = NS_PER_S
"""How often systemd hears of another reason for the same state, at most: some have a time in them, ns."""

DIALLED: Final = "one that had connected to it"

A_ROUTER: Final = "the router at "
ROUTER_PAUSE_NS: Final = 10 * NS_PER_S
"""The link to a router is not opened anew more often, whoever behind it is not heard: others are."""

Log = Callable[[str], None]


class StartError(RuntimeError):
    """A process's part cannot be made; the text is one clear message."""


class Start(NamedTuple):
    """What a process serves: the endpoints to listen on and to connect to; `close` is called at its end."""

    node: Node
    listen: Sequence[str]
    connect: Sequence[str]
    close: Callable[[], None] = lambda: None


class Shutdown:
    """Whether the process was asked to end: by SIGTERM, SIGINT or SIGHUP (unless that is ignored, as nohup(1)
    has it), or because its parent is gone.

    A signal handler only sets a flag: Zenoh must be closed by the main thread.
    """

    def __init__(self, *, with_parent: bool) -> None:
        self.asked = False
        self.why = ""
        self._parent = os.getppid() if with_parent else 0
        ignores_hangup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        for number in (signal.SIGTERM, signal.SIGINT, *([] if ignores_hangup else [signal.SIGHUP])):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, _frame: object) -> None:
        self.asked, self.why = True, signal.Signals(number).name
        self.look_for_parent()  # its end may be why the kernel sent it

    def look_for_parent(self) -> None:
        """Asks the process to end when its parent is gone, if it is to end with it."""
        if self._parent and os.getppid() != self._parent:
            self.asked, self.why = True, "the process that started it is gone"


class OrderKeeper:
    """Has `node`'s lasting orders kept in `store`, and gives it what others lay there.

    Args:
        fleet: its name.
    """

    def __init__(self, node: Node, bus: Bus, store: OrderStore, fleet: str, log: Log) -> None:
        self._node, self._bus, self._store, self._log = node, bus, store, log
        self._key_stop = key_expressions.stop(fleet)
        self._wanted: tuple[bytes, ...] = ()
        self._is_kept = True

    def recall(self, now_ns: int) -> None:
        """Gives `node` what was kept when the process ran last, before its first tick."""
        self._node.recall(now_ns, self._opened(self._store.read()))

    def look(self, now_ns: int) -> None:
        """Before a tick: takes a stop that was laid there. After it a process that has too little of the
        machine would brake by it a tick later, which may be a second."""
        laid = self._store.stops(now_ns)
        if laid:
            for order in self._opened(laid):
                if order.startswith(_STOP):
                    self._node.receive(now_ns, self._key_stop, order)

    def step(self) -> None:
        """After a tick: has kept what is new, and says what is."""
        node, store = self._node, self._store
        if node.lasting is not self._wanted:
            self._wanted, self._is_kept = node.lasting, False
            store.keep(self._wanted, [came for each in self._wanted if (came := self._bus.as_it_came(each))])
        if not self._is_kept and (done := store.done()) is not None:
            orders, trouble = done
            self._is_kept = orders is self._wanted and not trouble
            node.kept(orders, trouble)

    def _opened(self, kept: Sequence[bytes]) -> list[bytes]:
        """The orders in what was kept; what is none any more is left out, and said."""
        orders = []
        for each in kept:
            try:
                order = self._bus.opened(each)
                decode(order)  # it may be of another version of this program
                orders.append(order)
            except ValueError as error:
                self._log(f"an order that was kept is not taken: {error}")
        return orders


def loop(
    node: Node,
    bus: Bus,
    clock: Clock,
    shutdown: Shutdown,
    log: Log,
    service: SystemdNotifier,
    keeper: OrderKeeper | None = None,
    gate: Gate | None = None,
    names: Mapping[str, str] | None = None,
) -> None:
    """Ticks `node` at absolute deadlines (`agent.links.ticks.Ticks`) until it was asked to end and is done.

    Wakes at the deadline, drains the bus, ticks, publishes. A tick gets the time of its
    deadline, not of its waking; skipped ones are counted.

    Args:
        names: of whoever is at an endpoint.
    """
    ticks = Ticks(node, clock.now_ns())
    end_by_ns: int | None = None
    # Not in one tick: each of them touches much that has left the caches since it was looked at last.
    gate_due_ns = ticks.due_ns
    links_due_ns, parent_due_ns = gate_due_ns + GATE_PERIOD_NS // 2, gate_due_ns + 3 * GATE_PERIOD_NS // 2
    say_due_ns = 0
    said = "", ""
    watches = Watches(bus)
    heard: Sequence[str] = ()
    has_epoch = False
    while True:
        if node.subscriptions is not heard:
            heard = node.subscriptions
            bus.listen(heard)
        clock.sleep_until(ticks.due_ns)
        start_ns = clock.now_ns()
        if start_ns - ticks.due_ns > STALL_NS:
            # What others sent meanwhile is here, but Zenoh's thread has not run either.
            clock.sleep_until(start_ns + SETTLE_NS)
            start_ns = clock.now_ns()
        # Before the clock is read: nothing is from the future for a thread that was held up in between.
        waiting = bus.drain()
        now_ns, missed, late_ns = ticks.take(clock.now_ns())
        if late_ns * TOLD_SHARE > node.period_ns:
            node.late(now_ns, late_ns)
        for key, here in watches.update(node.watched):
            node.present(key, here)
        for key, payload in waiting:
            node.receive(now_ns, key, payload)
        if shutdown.asked and end_by_ns is None:
            log(f"ending ({shutdown.why})")
            service.stopping()
            node.end()
            end_by_ns = now_ns + END_TIMEOUT_NS
        if keeper is not None:
            keeper.look(now_ns)
        outgoing = node.tick(now_ns)
        node.timed(clock.now_ns() - start_ns, missed)
        for key, payload in outgoing:
            bus.publish(key, payload)
        if keeper is not None:
            keeper.step()
        condition = node.condition
        if condition is not said and condition != said and (condition[0] != said[0] or now_ns >= say_due_ns):
            text = f"{condition[0]}: {condition[1]}" if condition[1] else condition[0]
            if condition[0] != said[0]:  # reasons alone may change often
                log(printable(text))
            service.says(text)
            said, say_due_ns = condition, now_ns + SAY_PERIOD_NS
        service.lives(start_ns)
        if end_by_ns is not None and (node.done or now_ns >= end_by_ns):
            return
        if now_ns >= gate_due_ns:
            gate_due_ns = now_ns + GATE_PERIOD_NS
            if gate is not None and (knocked := gate.look(now_ns)):
                log(knocked)
        if now_ns >= links_due_ns:
            links_due_ns = now_ns + LOOK_PERIOD_NS
            look_at_links(node, bus, now_ns, names or {}, log)
        if now_ns >= parent_due_ns:
            parent_due_ns = now_ns + LOOK_PERIOD_NS
            shutdown.look_for_parent()
        if not has_epoch and ticks.epoch_ns is not None:
            has_epoch = True
            clock.begin(ticks.epoch_ns)
        ticks.plan(now_ns)


def look_at_links(node: Node, bus: Bus, now_ns: int, names: Mapping[str, str], log: Log) -> None:
    """Has links opened anew over which nothing comes, and says so."""
    said = [f"was deaf to {names.get(each, each or DIALLED)}: link opened anew" for each in bus.were_deaf()]
    deaf_to = node.deaf_to(now_ns)
    if deaf_to:
        endpoints = {name: endpoint for endpoint, name in names.items()}
        routers = [endpoint for endpoint, name in names.items() if name.startswith(A_ROUTER)]
        for name in (f"robot {robot}" for robot in deaf_to):
            there = name in endpoints and bus.reopen(endpoints[name])
            if there or any(bus.reopen(each, ROUTER_PAUSE_NS) for each in routers):
                said.append(f"deaf to {name}: link opened anew")
    for each in said:
        log(each)
        node.link_opened_anew(now_ns, each)


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
    bus.announce(node.alive_key)  # from here on others may count on being heard
    # What was made so far lives as long as the process: the collector need not look at it again.
    gc.collect()
    gc.freeze()


def _say_rejected(node: Node, log: Log) -> None:
    if node.rejected:
        reasons = sorted(((count, name) for name, count in node.rejected.items()), reverse=True)
        shown = ", ".join(f"{count} {name}" for count, name in reasons)
        log(f"ignored {sum(node.rejected.values())} messages that were not valid: {shown}")


def robot_arguments(program: str, description: str) -> argparse.ArgumentParser:
    """Parser of what the command line of every process of a robot has."""
    parser = argparse.ArgumentParser(prog=program, description=description)
    parser.add_argument("--fleet", required=True, metavar="FILE", help="the fleet file (TOML)")
    parser.add_argument("--robot", required=True, type=int, metavar="ID", help="id of the robot in that file")
    parser.add_argument("--keys", metavar="DIR", help="folder of the robot's key and certificates")
    parser.add_argument(
        "--exit-with-parent", action="store_true", help="end when the process that started it is gone"
    )
    return parser


def logger(whose: str, role: str) -> Log:
    """Writes lines of a process's log. Others' words may be in them: these move no terminal's cursor."""

    def log(text: str) -> None:
        lines = "\n".join(map(printable, text.split("\n")))
        print(f"{whose} {role}: {lines}", file=sys.stderr, flush=True)

    return log


def open_bus(fleet: Fleet, robot: int, folder: str | None, log: Log, **bus: Any) -> Bus:
    """The bus of one of a robot's processes: see `agent.runtime.sealed_bus.bus_for`.

    Raises:
        agent.runtime.bus.BusError: it cannot be opened now; nor can it with a certificate that is not valid
            now (`agent.runtime.certificate_wait`).
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
    node, listen, connect, close = start(fleet, options.robot, clock, log)
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
                near=key_expressions.near(fleet.fleet.name, options.robot),
                go_on_waiting=waiting,
            ) as bus,
            _store(options, role, log) as store,
        ):
            keeper = None if store is None else OrderKeeper(node, bus, store, fleet.fleet.name, log)
            appear(node, bus, clock, keeper)
            started()
            service.ready()
            with Gate(len(fleet.robots)) as gate:
                if gate.trouble:
                    log(gate.trouble)
                loop(node, bus, clock, shutdown, log, service, keeper, gate, names_of(fleet, options.robot))
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
) -> int:
    """Command line of a robot's process: reads the fleet file, opens the bus, serves.

    Args:
        start: makes the process's part from the fleet, the robot's id, the clock and what writes a line
            of the log. May raise `Error` or `StartError`.

    Returns the exit status: 0 when it was asked to end, 1 when the bus cannot be opened now, 2 for bad input.
    """
    parser = robot_arguments(program, f"The {role} of one robot of a fleet.")
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
