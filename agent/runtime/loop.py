"""The fixed-rate loop of a process round a sans-IO core, and the clock that it goes by."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Final

from handfast.agent.common.time import NS_PER_S, Clock, LocalTime, MachineClock
from handfast.agent.common.wording import printable
from handfast.agent.links.ticks import Deadlines, Ticks
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, head
from handfast.agent.messages.types import Stop
from handfast.agent.node import TOLD_SHARE, Node
from handfast.agent.runtime.order_store import OrderStore
from handfast.agent.runtime.service import PARENT_PERIOD_NS, Shutdown, SystemdNotifier
from handfast.agent.transport.bus import Bus
from handfast.agent.transport.presence import Watches

END_TIMEOUT_NS: Final = 3 * NS_PER_S // 10
"""A process that was asked to end has this long to bring its robot to a standstill."""
_STOP: Final = head(Stop)
STALL_NS: Final = NS_PER_S // 10
SETTLE_NS: Final = NS_PER_S // 500
"""A process that has stood for longer than the first takes what came meanwhile the second later."""
LINKS_PERIOD_NS: Final = 2 * NS_PER_S // 5
"""How often is looked for links over which nothing comes, ns."""
SAY_PERIOD_NS: Final = NS_PER_S
"""How often systemd hears of another reason for the same state, at most: some have a time in them, ns."""

DIALLED: Final = "one that had connected to it"

A_ROUTER: Final = "the router at "
ROUTER_PAUSE_NS: Final = 10 * NS_PER_S
"""The link to a router is not opened anew more often, whoever behind it is not heard: others are."""

Log = Callable[[str], None]


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
    names: Mapping[str, str] | None = None,
    ticks_from: Callable[[int], Deadlines] | None = None,
) -> None:
    """Ticks `node` at absolute deadlines (`agent.links.ticks.Ticks`) until it was asked to end and is done.

    Wakes at the deadline, drains the bus, ticks, publishes. A tick gets the time of its
    deadline, not of its waking; skipped ones are counted, and said at the end.

    Args:
        names: of whoever is at an endpoint.
        ticks_from: when the node ticks from a time on, ns; None: as it says itself.
    """
    ticks = Ticks(node, clock.now_ns()) if ticks_from is None else ticks_from(clock.now_ns())
    watches, said = Watches(bus), _Condition(log, service)
    chores = _Chores(node, bus, clock, shutdown, ticks, names or {}, log)
    heard: Sequence[str] = ()
    end_by_ns: int | None = None
    made = skipped = 0
    while True:
        if node.subscriptions is not heard:
            heard = node.subscriptions
            bus.listen(heard)
        start_ns = _wake_ns(clock, ticks.due_ns)
        # Before the clock is read: nothing is from the future for a thread that was held up in between.
        waiting = bus.drain()
        now_ns, missed, late_ns = ticks.take(clock.now_ns())
        made += 1
        skipped += missed
        _receive(node, watches, waiting, now_ns, late_ns)
        if shutdown.asked and end_by_ns is None:
            if skipped:
                log(f"missed {skipped} of {made + skipped} ticks")
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
        said.update(now_ns, node.condition)
        service.lives(start_ns)
        if end_by_ns is not None and (node.done or now_ns >= end_by_ns):
            return
        chores.update(now_ns)
        ticks.plan(now_ns)


def _wake_ns(clock: Clock, due_ns: int) -> int:
    """Sleep until a deadline; return the time after it."""
    clock.sleep_until(due_ns)
    start_ns = clock.now_ns()
    if start_ns - due_ns > STALL_NS:
        # What others sent meanwhile is here, but Zenoh's thread has not run either.
        clock.sleep_until(start_ns + SETTLE_NS)
        start_ns = clock.now_ns()
    return start_ns


def _receive(
    node: Node, watches: Watches, waiting: Sequence[tuple[str, bytes]], now_ns: int, late_ns: int
) -> None:
    """Give `node` what has happened since its last tick."""
    if late_ns * TOLD_SHARE > node.period_ns:
        node.late(now_ns, late_ns)
    for key, here in watches.update(node.watched):
        node.present(key, here)
    for key, payload in waiting:
        node.receive(now_ns, key, payload)


class _Condition:
    """Reports a node's state and reason to the log and to systemd."""

    def __init__(self, log: Log, service: SystemdNotifier) -> None:
        self._log, self._service = log, service
        self._said = "", ""
        self._due_ns = 0

    def update(self, now_ns: int, condition: tuple[str, str]) -> None:
        said = self._said
        if condition is said or condition == said:
            return
        is_new = condition[0] != said[0]
        if not is_new and now_ns < self._due_ns:
            return  # reasons alone may change often
        text = f"{condition[0]}: {condition[1]}" if condition[1] else condition[0]
        if is_new:
            self._log(printable(text))
        self._service.says(text)
        self._said, self._due_ns = condition, now_ns + SAY_PERIOD_NS


class _Chores:
    """Rare work between ticks. Each piece has a tick of its own: it touches much that has left the caches."""

    def __init__(
        self,
        node: Node,
        bus: Bus,
        clock: Clock,
        shutdown: Shutdown,
        ticks: Deadlines,
        names: Mapping[str, str],
        log: Log,
    ) -> None:
        self._node, self._bus, self._clock, self._shutdown = node, bus, clock, shutdown
        self._ticks, self._names, self._log = ticks, names, log
        self._links_due_ns = ticks.due_ns + LINKS_PERIOD_NS // 4
        self._parent_due_ns = ticks.due_ns + 3 * LINKS_PERIOD_NS // 4
        self._has_epoch = False

    def update(self, now_ns: int) -> None:
        if now_ns >= self._links_due_ns:
            self._links_due_ns = now_ns + LINKS_PERIOD_NS
            look_at_links(self._node, self._bus, now_ns, self._names, self._log)
        if now_ns >= self._parent_due_ns:
            self._parent_due_ns = now_ns + PARENT_PERIOD_NS
            self._shutdown.look_for_parent()
        epoch_ns = self._ticks.epoch_ns
        if epoch_ns is not None and not self._has_epoch:
            self._has_epoch = True
            self._clock.begin(epoch_ns)


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


_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
_TIME_NAMESPACE: Final = Path("/proc/self/ns/time")


def boot() -> int:
    """Names the monotonic clock of this process: other processes with the same number read the same clock.

    It is made of the boot's id and the time namespace where the system tells them, else of the host's name.
    """
    parts = [socket.gethostname()]
    with suppress(OSError):
        parts = [_BOOT_ID.read_text().strip()]
    with suppress(OSError):
        parts.append(os.readlink(_TIME_NAMESPACE))
    return int.from_bytes(blake2b(" ".join(parts).encode(), digest_size=7).digest(), "big")


class RealClock:
    """The machine's clock: wall time at the start of the process, carried on by the monotonic clock.

    A wall clock that is set while robots drive must not move them: it is read once.

    Args:
        skew_ns, drift: by how much it is to be wrong (`agent.common.time.LocalTime`).

    Attributes:
        machine: how it comes from the machine's own clock.
    """

    def __init__(self, skew_ns: int = 0, drift: float = 0.0) -> None:
        # The reading of the wall clock lies between two of the monotonic one: the closest of a
        # few pairs keeps a preempted process from starting with an offset.
        samples = []
        for _ in range(5):
            before = time.monotonic_ns()
            wall = time.time_ns()
            after = time.monotonic_ns()
            samples.append((after - before, wall - (before + after) // 2))
        self._offset_ns = min(samples)[1]
        self.machine: Final = MachineClock(boot(), self._offset_ns)
        self._local = LocalTime(skew_ns, drift)
        self._ahead_ns = self._offset_ns + skew_ns
        self._drifts = bool(drift)

    def begin(self, epoch_ns: int) -> None:
        """See `agent.common.time.Clock`."""
        if self._local.epoch_ns is None:
            self._local = self._local._replace(epoch_ns=epoch_ns)

    def now_ns(self) -> int:
        """The present, wall time in ns."""
        if self._drifts:
            return self._local.local_ns(time.monotonic_ns() + self._offset_ns)
        return time.monotonic_ns() + self._ahead_ns

    def sleep_until(self, time_ns: int) -> None:
        """Returns at `time_ns` (wall time) or, when that is past, at once."""
        if self._drifts:
            remaining = self._local.true_ns(time_ns) - time.monotonic_ns() - self._offset_ns
        else:
            remaining = time_ns - time.monotonic_ns() - self._ahead_ns
        if remaining > 0:
            time.sleep(remaining / NS_PER_S)
