"""The way of a stop over ssh: to the file that the robots of a host look for, whatever its ports do."""

from __future__ import annotations

import threading
import time
from base64 import b64decode
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from agent.fleet.hosts import HostSection
from agent.fleet.model import Fleet
from agent.messages.codec import encode
from agent.messages.key_expressions import ROLES
from agent.messages.types import Stop
from agent.runtime.order_store import packed
from deploy.console.arguments import InputError
from deploy.hosts import systemd_units
from deploy.hosts.connection import HostConnection, HostError
from deploy.hosts.remote_program import STOP_TEXT_MAX, STOPS_SHOWN
from deploy.inventory import ssh
from deploy.inventory.hosts import robots_on
from deploy.orders.stop_outcome import SAYS_BRAKES, Stopping
from deploy.session.sealing import sealed
from deploy.session.stop_by_file import kept_versions

LOOK_S: Final = 0.1
LOOK_LATER: Final = 1.5
LOOK_S_MAX: Final = 1.0
"""A host is asked at first after `LOOK_S`, then less and less often: hundreds that are asked ten times a
second would hold up those that have not got the stop yet."""
ROBOTS_LEFT: Final = 4
FOLLOW_S: Final = 8.0
"""So long it is asked whether the robots there have taken it."""

Found = tuple[int, int, str, str, int]
"""When it was found (wall clock, ns), of which robot and role: its state, and the version of its stop."""


class SshWay:
    """The way to the hosts of `fleet`, side by side, each in a thread of its own."""

    def __init__(self, fleet: Fleet, hosts: Sequence[HostSection]) -> None:
        self._fleet, self._hosts = fleet, hosts
        self._guard = threading.Lock()
        self._news = threading.Condition()
        self._found: list[Found] = []
        self._connections: list[HostConnection] = []
        self._threads: list[threading.Thread] = []
        self._order: tuple[Stop, bytes] | None = None
        self._ended = False
        self.troubles: list[str] = []

    def send(self, stop: Stop) -> None:
        """See `deploy.session.stop.Way`."""
        try:
            order = stop, packed(sealed(self._fleet, encode(stop)))
        except InputError as error:
            self.troubles.append(f"not over ssh: {error}")
            return
        with self._news:
            self._order = order
            self._news.notify_all()
        if not self._threads:
            ssh.allow_many()
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
        for at_ns, robot, role, state, version in found:
            stopping.found(at_ns, robot, role, state, version, self._words(robot))

    def _words(self, robot: int) -> str:
        return f"over ssh to {self._fleet.robot(robot).host}"

    @property
    def busy(self) -> bool:
        """See `deploy.session.stop.Way`."""
        return any(thread.is_alive() for thread in self._threads)

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
        name, robots = self._fleet.fleet.name, set(robots_on(self._fleet, connection.host))
        laid: tuple[Stop, bytes] | None = None
        # As many stops of the greatest size as two processes of each robot, and of some left over, can have.
        most = (len(robots) + ROBOTS_LEFT) * len(ROLES) * (STOPS_SHOWN + 1) * STOP_TEXT_MAX
        deadline, look_s = time.monotonic() + FOLLOW_S, LOOK_S
        while not self._ended and time.monotonic() < deadline and robots:
            if self._order is not laid and self._order is not None:
                laid = self._order
                connection.exchange("order", laid[1], fleet=name)
                look_s = LOOK_S
            answer = connection.ask("kept", fleet=name, answer_bytes=most)
            assert laid is not None
            for robot in sorted(robots):
                taken = [self._look(robot, role, answer, laid[0]) for role in ROLES]
                if all(taken):
                    robots.discard(robot)
            if robots:
                self._rest(look_s, laid)
                look_s = min(look_s * LOOK_LATER, LOOK_S_MAX)

    def _rest(self, seconds: float, laid: tuple[Stop, bytes]) -> None:
        """Waits, but not when there is another stop than was laid there, or it is over."""
        with self._news:
            self._news.wait_for(lambda: self._ended or self._order is not laid, seconds)

    def _look(self, robot: int, role: str, answer: Mapping[str, Any], stop: Stop) -> bool:
        """Notes what is said there of a process; whether it has kept the stop and says that it brakes.

        What it has kept is read after what it says: one that takes the stop between the two says so at the
        next look.
        """
        about = answer.get(systemd_units.unit_name(self._fleet.fleet.name, robot, role))
        if not isinstance(about, Mapping):
            return False
        state, kept = str(about.get("says", "")).partition(":")[0], about.get("orders")
        stopped = resumed = -1
        with suppress(ValueError, TypeError):
            orders = [b64decode(text) for text in kept] if isinstance(kept, list) else []
            stopped, resumed = kept_versions(orders, is_secured=self._fleet.is_secured)
        holds = stopped >= stop.version and stopped > resumed
        # By a later stop, whoever gave it, it brakes as well: that is nothing to outdo.
        version = stop.version if holds else max(stopped, resumed)
        with self._guard:
            self._found.append((time.time_ns(), robot, role, state, version))
        return holds and state in SAYS_BRAKES[role]
