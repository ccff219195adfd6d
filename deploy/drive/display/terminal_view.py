"""The live view on a terminal: a table of robots; loads Rich, so only who draws imports it."""

from __future__ import annotations

from typing import TextIO

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.progress import BarColumn, Progress, TextColumn

from handfast.deploy.analysis.silence import in_words
from handfast.deploy.console.terminal import TerminalView, plain
from handfast.deploy.drive.display.fleet_table import ROWS_MAX, ROWS_MIN, table
from handfast.deploy.drive.display.picture_wording import REASONS_MAX, faults_line, packed, parts
from handfast.deploy.drive.watch import Picture


class Terminal(TerminalView):
    """A table of robots, which stays as it was last."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._picture: Picture | None = None

    def show(self, picture: Picture) -> None:
        self._picture = picture
        self._draw(_Fleet(picture))

    def _last(self) -> RenderableType | None:
        return None if self._picture is None else _Fleet(self._picture, is_over=True)


class _Fleet:
    """A picture, as Rich draws it.

    Args:
        is_over: it is the last one, which may be more than the terminal has lines.
    """

    def __init__(self, picture: Picture, *, is_over: bool = False) -> None:
        self._picture, self._is_over = picture, is_over

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        picture = self._picture
        lines = [plain(line) for line in packed(parts(picture), options.max_width)]
        lines += [plain(line, "yellow") for line in in_words(picture.silent, REASONS_MAX)]
        if picture.faults:
            lines.append(plain(faults_line(picture), "yellow"))
        above: list[RenderableType] = [_bar(picture, is_over=self._is_over), *lines]
        yield from above
        room = ROWS_MAX
        if not self._is_over:
            used = sum(len(console.render_lines(each, options, pad=False)) for each in above)
            # Above the rows stand their headings, below them the number of those that are not shown.
            room = max(ROWS_MIN, min(ROWS_MAX, options.size.height - used - 1))
        yield from table(picture.robots, options.max_width, room)


def _bar(picture: Picture, *, is_over: bool) -> Progress:
    progress = Progress(
        TextColumn("[bold]{task.description}"), BarColumn(bar_width=None), TextColumn("{task.fields[clock]}")
    )
    now = max(0.0, picture.time_s or 0.0)
    what = "starting" if picture.time_s is None else "drove" if is_over else "driving"
    clock = f"{now:5.1f} of {picture.duration_s:.0f} s"
    task = progress.add_task(what, total=picture.duration_s, clock=clock)
    progress.update(task, completed=min(now, picture.duration_s))
    return progress
