"""What happens on each host of a fleet, as it happens: a live table on a terminal, elsewhere lines."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Final, Protocol, TextIO

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from deploy.wording import robots as robots_words

DOING, DONE, FAILED = "doing", "done", "failed"
_COUNT: Final = re.compile(r" \d+ of (?=\d+ MB)")  # how far it has come is for the table
STYLES: Final = {DOING: "", DONE: "green", FAILED: "bold red"}


@dataclass
class Row:
    """One host.

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


class HostsView(Protocol):
    """Where rows are shown. A context manager."""

    def __enter__(self) -> HostsView: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
    def say(self, text: str) -> None:
        """One line that stays."""
        ...

    def show(self, rows: Sequence[Row]) -> None:
        """All rows as they are now."""
        ...


def make_hosts_view(stream: TextIO | None = None) -> HostsView:
    """A table on a terminal, lines elsewhere; on standard error unless told otherwise."""
    stream = sys.stderr if stream is None else stream
    return Terminal(Console(file=stream)) if stream.isatty() else Lines(stream)


class Lines:
    """A line whenever a host comes to something else."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._said: dict[str, str] = {}

    def __enter__(self) -> Lines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def say(self, text: str) -> None:
        print(text, file=self._stream, flush=True)

    def show(self, rows: Sequence[Row]) -> None:
        for row in rows:
            what = _COUNT.sub(" ", row.step)
            if self._said.get(row.host) != what:
                self._said[row.host] = what
                failed = "FAILED: " if row.state == FAILED else ""
                self.say(f"{row.host}: {failed}{what}")


class Terminal:
    """A table that is redrawn in place, and stays as it was at the end."""

    def __init__(self, console: Console) -> None:
        self._live = Live(console=console, auto_refresh=False)

    def __enter__(self) -> Terminal:
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def say(self, text: str) -> None:
        self._live.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def show(self, rows: Sequence[Row]) -> None:
        table = Table(expand=True, pad_edge=False, box=None)
        table.add_column("host", no_wrap=True)
        table.add_column("robots", no_wrap=True)
        table.add_column("", ratio=1)
        for row in rows:
            shown = robots_words(row.robots).removeprefix("robots ").removeprefix("robot ")
            table.add_row(row.host, shown, Text(row.step, style=STYLES[row.state]))
        self._live.update(table, refresh=True)
