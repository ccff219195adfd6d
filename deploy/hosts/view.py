"""What happens on each host of a fleet, as it happens: a live table on a terminal, elsewhere lines."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol, TextIO

from rich.table import Table

from deploy.console.views import LinesView, Speaker, TerminalView, plain
from deploy.console.wording import robots as robots_words

DOING, DONE, FAILED = "doing", "done", "failed"
_COUNT: Final = re.compile(r" \d+ of (?=\d+ MB)")  # how far it has come is for the table
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


class Lines(LinesView):
    """A line whenever a host comes to something else."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._said: dict[str, str] = {}

    def show(self, rows: Sequence[Row]) -> None:
        for row in rows:
            what = _COUNT.sub(" ", row.step)
            if self._said.get(row.host) != what:
                self._said[row.host] = what
                failed = "FAILED: " if row.state == FAILED else ""
                self.say(f"{row.host}: {failed}{what}")


class Terminal(TerminalView):
    """A table of hosts, which stays as it was at the end."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream, transient=False)

    def show(self, rows: Sequence[Row]) -> None:
        table = Table(expand=True, pad_edge=False, box=None)
        table.add_column("host", no_wrap=True)
        table.add_column("robots", no_wrap=True)
        table.add_column("", ratio=1)
        for row in rows:
            shown = robots_words(row.robots).removeprefix("robots ").removeprefix("robot ")
            table.add_row(plain(row.host), shown, plain(row.step, STYLES[row.state]))
        self._draw(table)
