"""The way of a stop over ssh: to the file that the robots of a host look for, whatever its ports do."""

from __future__ import annotations

import threading
import time
from base64 import b64decode
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import encode, least_believed
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import TIME_NS_MAX, Stop
from handfast.agent.runtime.order_store import packed
from handfast.deploy.console.arguments import InputError
from handfast.deploy.hosts.connection import ANSWER_BYTES, HostConnection, HostError
from handfast.deploy.hosts.remote_program import STOP_TEXT_MAX, STOPS_SHOWN
from handfast.deploy.inventory import hosts
from handfast.deploy.inventory.hosts import robots_on
from handfast.deploy.orders.robot_clocks import OFF_NS
from handfast.deploy.orders.stop_outcome import SAYS_BRAKES, Stopping
from handfast.deploy.session.operator_bus import sealed
from handfast.deploy.session.stop_by_file import kept_versions

LOOK_S: Final = 0.1
LOOK_LATER: Final = 1.5
LOOK_S_MAX: Final = 1.0
"""A host is asked at first after `LOOK_S`, then less and less often: hundreds that are asked ten times a
second would hold up those that have not got the stop yet."""
FOLLOW_S: Final = 8.0
"""So long it is asked whether the robots there have taken it."""


class _Found(NamedTuple):
    """What was found of one process, and when: by this machine's wall clock and by that of its host, ns.

    Attributes:
        state: what the process says of itself; None where it is no unit there.
        version: of the stop or resume that it has kept, -1 without any.
        laid: version of the stop that lies there for it, -1 without any.
    """

    at_ns: int
    there_ns: int
    robot: int
    role: str
    state: str | None
    version: int
    laid: int


class SshWay:
    """The way to the hosts of `fleet`, side by side, each in a thread of its own."""

    def __init__(self, fleet: Fleet, hosts: Sequence[HostSection]) -> None:
        self._fleet, self._hosts = fleet, hosts
        self._guard = threading.Lock()
        self._news = threading.Condition()
        self._found: list[_Found] = []
        self._laid_before: list[tuple[int, int]] = []
        """Robots, each with the version of the stop that lay there for it."""
        self._connections: list[HostConnection] = []
        self._threads: list[threading.Thread] = []
        self._stop: Stop | None = None
        self._content: set[str] = set()
        """Hosts whose robots have all taken that stop."""
        self._sealing = threading.Lock()
        self._sealed: tuple[Stop, bytes] | None = None
        self._ended = False
        self.troubles: list[str] = []

    def send(self, stop: Stop) -> None:
        """See `deploy.session.stop.Way`."""
        with self._news:
            self._stop = stop
            self._content.clear()
            self._news.notify_all()
        if not self._threads:
            hosts.allow_many()
            self._threads = [
                threading.Thread(target=self._run, args=(host,), name=host.name, daemon=True)
                for host in self._hosts
            ]
            for thread in self._threads:
                try:
                    thread.start()
                except RuntimeError as error:  # there are as many as this computer allows
                    self.troubles.append(f"not over ssh to {thread.name}: {error}")

    def collect(self, stopping: Stopping) -> None:
        """See `deploy.session.stop.Way`."""
        with self._guard:
            found, self._found = self._found, []
            laid, self._laid_before = self._laid_before, []
        for robot, version in laid:
            stopping.found_laid(robot, version)
        for each in found:
            way = f"over ssh to {self._fleet.robot(each.robot).host}"
            stopping.show_clock(each.at_ns, each.robot, each.there_ns)
            if each.state is not None:
                stopping.found(each.at_ns, each.robot, each.role, each.state, each.version, way)
            else:
                stopping.found_down(each.robot, each.role, each.version, each.laid, way)

    @property
    def busy(self) -> bool:
        """See `deploy.session.stop.Way`."""
        return any(thread.is_alive() and thread.name not in self._content for thread in self._threads)

    def close(self) -> None:
        """See `deploy.session.stop.Way`."""
        with self._news:
            self._ended = True
            self._news.notify_all()
        with self._guard:
            connections = list(self._connections)
        for connection in connections:
            connection.abort()

    # ------------------------------------------------------------------ one host, in a thread of its own

    def _run(self, host: HostSection) -> None:
        try:
            connection = HostConnection(host, robots=len(robots_on(self._fleet, host)))
            with self._guard:
                self._connections.append(connection)
                if self._ended:
                    connection.abort()
            with connection:
                self._follow(connection)
        except HostError as error:
            if not self._ended:
                self.troubles.append(f"not over ssh to {host.name}: {error}")

    def _follow(self, connection: HostConnection) -> None:
        """Lays the stop there, and looks who takes it; another one, when the stop has changed."""
        name, robots = self._fleet.fleet.name, robots_on(self._fleet, connection.host)
        # As many stops of the greatest size as two processes of each robot can have.
        most = len(robots) * len(ROLES) * (STOPS_SHOWN + 1) * STOP_TEXT_MAX + ANSWER_BYTES
        left: set[int] = set()
        laid: tuple[Stop, int] | None = None
        lies, why, ahead_ns = -1, "", 0
        deadline, look_s = time.monotonic() + FOLLOW_S, LOOK_S
        while not self._ended and time.monotonic() < deadline:
            stop = self._stop
            assert stop is not None
            if laid is None or laid[0] is not stop or laid[1] != ahead_ns:
                is_first, laid, left, look_s = laid is None, (stop, ahead_ns), set(robots), LOOK_S
                lies, why = -1, ""
                try:
                    before, _ = connection.exchange("order", self._packed(stop, ahead_ns), fleet=name)
                    if is_first:
                        self._found_laid(robots, before)
                    lies = stop.version
                except InputError as error:  # it may be right by the clock there
                    why = str(error)
            processes = [f"robot-{robot}-{role}" for robot in sorted(left) for role in ROLES]
            there = _There(connection.ask("kept", fleet=name, processes=processes, answer_bytes=most))
            if abs(there.ahead_ns - ahead_ns) > OFF_NS:  # what is sealed has to be valid by that clock
                ahead_ns = there.ahead_ns
                continue
            if why:
                self._say(f"not over ssh: {why}")
                return
            for robot in sorted(left):
                taken = [self._look(robot, role, there, stop, lies) for role in ROLES]
                if all(taken):
                    left.discard(robot)
            self._rest(
                connection.host, look_s if left else deadline - time.monotonic(), stop, content=not left
            )
            look_s = min(look_s * LOOK_LATER, LOOK_S_MAX)

    def _packed(self, stop: Stop, ahead_ns: int) -> bytes:
        """The stop as a host's robots take it whose clock is so far ahead: not of a time to come. Raises
        `InputError`: no certificate of this operator's is valid by that."""
        with self._sealing:
            if not ahead_ns and self._sealed is not None and self._sealed[0] is stop:
                return self._sealed[1]
            version = least_believed(stop.version, time.time_ns() + ahead_ns)
            order = packed([sealed(self._fleet, encode(stop._replace(version=version)), ahead_ns)])
            if not ahead_ns:
                self._sealed = stop, order
            return order

    def _found_laid(self, robots: Iterable[int], before: Any) -> None:
        """Notes the stop that lay there: who was to find it when it comes up finds this one instead."""
        stopped, _ = self._versions(before)
        with self._guard:
            self._laid_before += [(robot, stopped) for robot in robots]

    def _versions(self, texts: Any) -> tuple[int, int]:
        """The greatest of the stops, and of the resumes, that a host says are kept there; -1 without any."""
        with suppress(ValueError, TypeError):
            orders = [b64decode(text) for text in texts] if isinstance(texts, list) else []
            return kept_versions(orders, is_secured=self._fleet.is_secured)
        return -1, -1

    def _say(self, trouble: str) -> None:
        with self._guard:
            if trouble not in self.troubles:
                self.troubles.append(trouble)

    def _rest(self, host: HostSection, seconds: float, laid: Stop, *, content: bool) -> None:
        """Waits, but not when there is another stop than was laid there, or it is over; `content`: nothing
        is waited for but that."""
        with self._news:
            if content and self._stop is laid:
                self._content.add(host.name)
            self._news.wait_for(lambda: self._ended or self._stop is not laid, seconds)

    def _look(self, robot: int, role: str, there: _There, stop: Stop, lies: int) -> bool:
        """Notes what is said there of a process; whether no more can come of it: it has kept the stop and
        says that it brakes, or is down and will find it.

        What it has kept is read after what it says: one that takes the stop between the two says so at the
        next look.
        """
        about = there.processes.get(f"robot-{robot}-{role}")
        if not isinstance(about, Mapping):
            return False
        says = about.get("says")
        stopped, resumed = self._versions(about.get("orders"))
        its_ns = there.time_ns - max(0, time.time_ns() - stop.time_ns)  # when the stop was given, or before
        holds = stopped >= least_believed(stop.version, its_ns) and stopped > resumed
        state = None if says is None else str(says).partition(":")[0]
        version = max(stopped, resumed)
        if holds and state is not None:
            version = max(stop.version, version)
        with self._guard:
            self._found.append(_Found(time.time_ns(), there.time_ns, robot, role, state, version, lies))
        if state is None:
            return version < lies
        return holds and state in SAYS_BRAKES[role]


class _There:
    """What a host answered: of processes by name, and its wall clock, this one's where it tells none."""

    def __init__(self, answer: Any) -> None:
        found = answer if isinstance(answer, Mapping) else {}
        processes, time_ns, now_ns = found.get("processes"), found.get("time_ns"), time.time_ns()
        self.processes: Mapping[str, Any] = processes if isinstance(processes, Mapping) else {}
        self.time_ns = time_ns if type(time_ns) is int and 0 <= time_ns <= TIME_NS_MAX else now_ns
        off_ns = self.time_ns - now_ns
        self.ahead_ns = off_ns if abs(off_ns) > OFF_NS else 0
