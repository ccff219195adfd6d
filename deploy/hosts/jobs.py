"""Work on several hosts side by side, each over its own connection, and the view of its progress.

A dead host never keeps the others. The view is a live table on a terminal, and lines elsewhere.
"""

from __future__ import annotations

import re
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final, Protocol, TextIO

from rich.console import Group
from rich.table import Table

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.terminal import TerminalView, plain
from handfast.deploy.console.views import LinesView, Speaker
from handfast.deploy.console.wording import FEW
from handfast.deploy.console.wording import robots as robots_words
from handfast.deploy.hosts.bundle import end_downloads
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.inventory.hosts import allow_many, robots_on

DOING, DONE, FAILED = "doing", "done", "failed"
_COUNT: Final = re.compile(r" \d+ of (?=\d+ MB)")  # how far it has come is for the table
HEADING: Final = ("host", "robots")
ENDS_SHOWN: Final = 5
"""Of many hosts it is said what became of how many, where that is not more than so many things."""
SHARES: Final = 10
"""How often it is said how far many hosts are, where no table is."""
INTERRUPTED: Final = "interrupted"
STYLES: Final = {DOING: "", DONE: "green", FAILED: "bold red"}


@dataclass
class Row:
    """One host: what is being done with it, and what became of it.

    Attributes:
        host: its name.
        robots: those on it.
        step: what is being done, or what became of it.
        state: `DOING`, `DONE` or `FAILED`.
        outcomes: by robot, what became of it.
    """

    host: str
    robots: tuple[int, ...]
    step: str = "connecting"
    state: str = DOING
    outcomes: dict[int, str] = field(default_factory=dict)

    def fail(self, why: str) -> None:
        self.step, self.state = why, FAILED

    @property
    def is_wrong(self) -> bool:
        """Whether it failed, but for that somebody wanted to end it."""
        return self.state == FAILED and self.step != INTERRUPTED

    def done(self, what: str) -> None:
        self.step, self.state = what, DONE


class HostsView(Speaker, Protocol):
    """Where rows are shown."""

    def show(self, rows: Sequence[Row]) -> None:
        """All rows as they are now."""
        ...


def make_hosts_view(stream: TextIO | None = None) -> HostsView:
    """A table on a terminal, lines elsewhere; on standard error unless another stream is given."""
    stream = sys.stderr if stream is None else stream
    return Terminal(stream) if stream.isatty() else Lines(stream)


def summary(rows: Sequence[Row]) -> list[str]:
    """What happens on many hosts, or became of them: in few lines, without those that failed."""
    counts = {
        "failed": sum(row.is_wrong for row in rows),
        INTERRUPTED: sum(row.state == FAILED and not row.is_wrong for row in rows),
        "under way": sum(row.state == DOING for row in rows),
    }
    others = [f", {count} {what}" for what, count in counts.items() if count]
    lines = [f"{len(rows) - sum(counts.values())} of {len(rows)} hosts done{''.join(others)}"]
    ends = Counter(row.step for row in rows if row.state == DONE)
    if not counts["under way"] and len(ends) <= ENDS_SHOWN:
        lines += [f"{count} hosts: {step}" for step, count in ends.items()]
    return lines


class Lines(LinesView):
    """A line whenever a host comes to something else; of many hosts for those that fail, and how far the
    others are."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._said: dict[str, str] = {}
        self._share = 0

    def show(self, rows: Sequence[Row]) -> None:
        many = len(rows) > FEW
        for row in rows:
            if many and not row.is_wrong:
                continue
            what = _COUNT.sub(" ", row.step)
            if self._said.get(row.host) != what:
                self._said[row.host] = what
                failed = "FAILED: " if row.state == FAILED else ""
                self.say(f"{row.host}: {failed}{what}")
        share = SHARES * sum(row.state != DOING for row in rows) // max(1, len(rows))
        if many and share != self._share:
            self._share = share
            for line in summary(rows):
                self.say(line)


class Terminal(TerminalView):
    """A table of hosts, which stays as it was at the end; of many hosts those that failed, and as many as
    there is room for of those that are worked on."""

    def show(self, rows: Sequence[Row]) -> None:
        table = Table(expand=True, pad_edge=False, box=None)
        for name in HEADING:
            table.add_column(name, no_wrap=True)
        # A row of many is one line.
        table.add_column("", ratio=1, no_wrap=len(rows) > FEW and any(row.state == DOING for row in rows))
        lines: list[str] = []
        if len(rows) > FEW:
            lines = summary(rows)
            failed = [row for row in rows if row.is_wrong]
            doing = [row for row in rows if row.state == DOING]
            room = max(0, self._height - len(lines) - 2)
            rows = [*failed, *doing][:room] if doing else failed
        for row in rows:
            shown = robots_words(row.robots).removeprefix("robots ").removeprefix("robot ")
            table.add_row(plain(row.host), shown, plain(row.step, STYLES[row.state]))
        self._draw(Group(*([table] if rows else []), *map(plain, lines)))


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
        allow_many()

    def __enter__(self) -> HostJobs:
        for host in self._hosts:
            self._pool.submit(self._run, host)
        return self

    def __exit__(self, *_: object) -> None:
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
