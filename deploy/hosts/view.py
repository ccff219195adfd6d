"""What happens on each host of a fleet, as it happens: a live table on a terminal, elsewhere lines."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol, TextIO

from rich.console import Group
from rich.table import Table

from handfast.deploy.console.terminal import TerminalView, plain
from handfast.deploy.console.views import LinesView, Speaker
from handfast.deploy.console.wording import FEW
from handfast.deploy.console.wording import robots as robots_words

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
