"""The robots of a fleet as a table for a terminal, of as many columns and rows as it has room for."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from rich.cells import cell_len
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from handfast.agent.common.wording import printable
from handfast.agent.supervision.state_machine import State
from handfast.deploy.console.wording import some
from handfast.deploy.drive.display.picture_wording import clock_words
from handfast.deploy.drive.readiness import BLOCKING, WARNING
from handfast.deploy.drive.watch import RobotPicture

STYLES: Final = {
    State.RUNNING.value: "green",
    State.DEGRADED.value: "yellow",
    State.HOLDING.value: "bold yellow",
    State.RELEASED.value: "bold yellow",
    State.STOPPING.value: "cyan",
    State.STOPPED.value: "cyan",
    State.FAULT.value: "bold red",
    State.STANDBY.value: "dim",
    State.WAITING.value: "dim",
}
ROWS_MAX: Final = 24
"""Robots shown one by one; of a larger fleet, those in trouble first."""
ROWS_MIN: Final = 2
WHY: Final = "why"
WHY_WIDTH: Final = 20
"""So much room is left for why a robot does what it does before what matters less has any."""
WHY_WIDTH_MIN: Final = 8
"""So much, before anything that matters more goes."""
GAP: Final = 2
_LEVELS: Final = {WARNING: "yellow", BLOCKING: "bold red"}
_PERCENT: Final = re.compile(r"\d+(?:\.\d+)? ?%")
_VOLTAGE: Final = re.compile(r"\d+(?:\.\d+)? ?V\b")


class Column(NamedTuple):
    """One column: its heading, what it shows of a robot, its least width."""

    heading: str
    text: Callable[[int, RobotPicture], str]
    width: int
    style: Callable[[RobotPicture], str] = lambda _: ""


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _nearest(_: int, about: RobotPicture) -> str:
    return "-" if about.nearest is None else "{:.2f} ({})".format(*about.nearest)


def _battery(_: int, about: RobotPicture) -> str:
    """Its share, or where that is not known its voltage."""
    said = "" if about.battery is None else about.battery.found
    found = _PERCENT.search(said) or _VOLTAGE.search(said)
    return found[0] if found else "-"


def _why(_: int, about: RobotPicture) -> str:
    return "; ".join(filter(None, (about.reason, clock_words(about))))


_NEAREST: Final = Column("nearest m", _nearest, 9)
_BATTERY: Final = Column(
    "battery", _battery, 7, lambda about: _LEVELS.get(about.battery.level, "") if about.battery else ""
)
COLUMNS: Final = (
    Column("robot", lambda robot, _: str(robot), 5),
    Column("state", lambda _, about: about.state or "-", 8, lambda about: STYLES.get(about.state, "")),
    Column("off m", lambda _, about: _number(about.off_m, 2), 5),
    _NEAREST,
    Column("m/s", lambda _, about: _number(about.speed, 2), 5),
    _BATTERY,
    Column(WHY, _why, WHY_WIDTH_MIN),
    Column("worst edge m", lambda _, about: _number(about.error_m, 3), 12),
    Column("oldest ms", lambda _, about: _number(about.age_ms, 0), 9),
    Column("tick us", lambda _, about: _number(about.tick_us, 0), 7),
    Column("missed", lambda _, about: str(about.overruns), 6),
)
"""In the order in which they are shown: what a person asks first comes first."""
_TEXT: Final = frozenset({"state", WHY})
_KEPT: Final = ("robot", "state", WHY)
"""What is shown however narrow it is; the others go from the last one on."""


def rows(robots: Mapping[int, RobotPicture], room: int) -> tuple[dict[int, RobotPicture], list[int]]:
    """Those that are shown in so many lines, of too many those in trouble first; and the others."""
    if len(robots) <= room:
        return dict(sorted(robots.items())), []
    first = sorted(robots.items(), key=lambda item: (item[1].state == State.RUNNING.value, item[0]))
    return dict(first[: room - 1]), sorted(robot for robot, _ in first[room - 1 :])


def fitting(texts: Mapping[Column, Sequence[str]], width: int) -> dict[Column, int]:
    """The columns for which `width` characters have room, and how wide each is; why a robot does what it does
    takes what is left."""
    found = {
        # Numbers are never cut.
        column: column.width if column.heading in _TEXT else max(column.width, *map(cell_len, cells), 0)
        for column, cells in texts.items()
    }

    def left() -> int:
        used = sum(wide for column, wide in found.items() if column.heading != WHY)
        return width - used - GAP * (len(found) - 1)

    after = False
    for column in reversed(COLUMNS):
        after = after or column.heading == WHY
        if left() >= (WHY_WIDTH_MIN if after else WHY_WIDTH):
            break
        if column.heading not in _KEPT:
            found.pop(column, None)
    return {column: max(1, left()) if column.heading == WHY else wide for column, wide in found.items()}


def texts_of(robots: Mapping[int, RobotPicture]) -> dict[Column, list[str]]:
    """Every column that says something, with its text for each robot."""
    texts = {
        column: [printable(column.text(robot, about)) for robot, about in robots.items()]
        for column in COLUMNS
    }
    texts[_NEAREST] = _aligned(texts[_NEAREST])
    if all(text == "-" for text in texts[_BATTERY]):
        del texts[_BATTERY]  # of simulated bodies, and of vehicles that do not measure it
    return texts


def _aligned(texts: Sequence[str]) -> list[str]:
    """Texts with their numbers below each other, however long what follows them is."""
    halves = [text.partition(" ") for text in texts]
    most, rest = (max(len(half[part]) for half in halves) if halves else 0 for part in (0, 2))
    return [f"{number.rjust(most)} {after.ljust(rest)}".rjust(_NEAREST.width) for number, _, after in halves]


def table(robots: Mapping[int, RobotPicture], width: int, room: int) -> Iterator[RenderableType]:
    """What stands in so many lines below the headings, none of them longer than `width`."""
    shown, more = rows(robots, room)
    texts = texts_of(shown)
    found = fitting(texts, width)
    made = Table(padding=(0, GAP, 0, 0), pad_edge=False, box=None)
    for column, wide in found.items():
        made.add_column(
            column.heading,
            justify="left" if column.heading in _TEXT or column is _NEAREST else "right",
            width=wide,
            no_wrap=True,
            overflow="ellipsis",
        )
    for place, about in enumerate(shown.values()):
        made.add_row(*(Text(texts[column][place], style=column.style(about)) for column in found))
    yield made
    if more:
        yield Text(f"and {len(more)} more ({some(more)})", no_wrap=True, overflow="ellipsis")
