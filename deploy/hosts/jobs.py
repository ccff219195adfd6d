"""Work on several hosts side by side, each over its own connection: a dead one never keeps the others."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Final

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.hosts.artifacts.bundle import end_downloads
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.hosts.view import DOING, INTERRUPTED, HostsView, Row
from handfast.deploy.inventory import ssh
from handfast.deploy.inventory.hosts import robots_on

AT_ONCE_MAX: Final = 32
"""Hosts that are brought something at a time: megabytes for each."""
ASKED_AT_ONCE: Final = 128
"""Hosts that are asked something at a time: those that are slow, or not there, hold up no others."""

Work = Callable[[HostConnection, Row], None]
"""What is done with one host, in a thread of its own. Says in the row what it does and what became of it; may
raise `HostError`."""


class HostJobs:
    """One job for each host. A context manager; leaving it ends what is still under way.

    Args:
        accept_new: takes the keys of hosts that were never met before for their own.
        at_once: how many hosts are worked on at a time.
        look_s: how often it is looked what happens.
        failed: is told of each host on which something goes wrong, at once and in the thread that works on
            it; not of what is ended.

    Attributes:
        rows: by host, what happens there.
        ended: whether what is under way is to end.
    """

    def __init__(
        self,
        fleet: Fleet,
        hosts: Sequence[HostSection],
        work: Work,
        *,
        accept_new: bool = False,
        at_once: int = ASKED_AT_ONCE,
        look_s: float = 0.1,
        failed: Callable[[Row], None] = lambda _: None,
    ) -> None:
        self.rows: Final = {host.name: Row(host.name, robots_on(fleet, host)) for host in hosts}
        self.ended = False
        self._why = INTERRUPTED
        self._work, self._accept_new, self._look_s = work, accept_new, look_s
        self._hosts, self._failed = hosts, failed
        self._connections: list[HostConnection] = []
        self._guard = threading.Lock()
        self._pool = ThreadPoolExecutor(min(len(hosts), at_once), "host")
        ssh.allow_many()

    def __enter__(self) -> HostJobs:
        for host in self._hosts:
            self._pool.submit(self._run, host)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()
        self._pool.shutdown(cancel_futures=True)
        for row in self.rows.values():
            if row.state == DOING:
                row.fail(self._why)

    @property
    def busy(self) -> bool:
        return any(row.state == DOING for row in self.rows.values())

    def wait(self, view: HostsView, interrupt: Interrupt, look: Callable[[], None] = lambda: None) -> None:
        """Shows what happens until all are done, or Ctrl-C; calls `look` now and then."""
        while self.busy and not interrupt.count:
            look()
            view.show(list(self.rows.values()))
            time.sleep(self._look_s)
        if interrupt.count:
            self.end()

    def end(self, why: str = INTERRUPTED) -> None:
        """Makes what is still under way fail now, for a reason; the first reason counts."""
        with self._guard:
            self._why = self._why if self.ended else why
            self.ended = True
            connections = list(self._connections)
        for connection in connections:
            connection.abort()
        end_downloads()

    def _run(self, host: HostSection) -> None:
        row = self.rows[host.name]
        try:
            connection = HostConnection(host, len(row.robots), accept_new=self._accept_new)
            with self._guard:  # before it answers, which may take its time: Ctrl-C must reach it
                self._connections.append(connection)
                if self.ended:
                    connection.abort()
            with connection:
                self._work(connection, row)
                if row.state == DOING:
                    row.done("done")
        except HostError as error:
            row.fail(self._why if self.ended else str(error))
        except Exception as error:  # a mistake of ours must not leave the others waiting for this host
            row.fail(f"{type(error).__name__}: {error}")
        if row.is_wrong and not self.ended:
            self._failed(row)
