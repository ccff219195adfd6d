"""The checks of many vehicles in one table: a mark for each, and words for what is not well (PURE)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from handfast.deploy.drive.vehicle_checks import BLOCKING, OK, WARNING, Line, sentences

MARKS: Final = {OK: ".", WARNING: "!", BLOCKING: "X"}
LEGEND: Final = f"{MARKS[OK]} ok   {MARKS[WARNING]} warning   {MARKS[BLOCKING]} blocking"
_LEVELS: Final = tuple(MARKS)
_GAP: Final = 2


def matrix(found: Mapping[int, Sequence[Line]], width: int) -> list[str]:
    """Lines of text: a row for each check, a column for each robot, as many side by side as `width` has room
    for; then what is not well, said once of all robots of which it is true, what blocks first.

    Args:
        found: by robot, its lines.
    """
    names = list(dict.fromkeys(line.name for lines in found.values() for line in lines))
    label = max(map(len, ("check", *names)), default=0)
    column = max((len(str(robot)) for robot in found), default=0) + _GAP
    beside = max(1, (width - label) // column)
    ids = list(found)
    out = []
    for first in range(0, len(ids), beside):
        part = ids[first : first + beside]
        out.append("check".ljust(label) + "".join(f"{robot:>{column}}" for robot in part))
        for name in names:
            marks = "".join(_mark(found[robot], name).rjust(column) for robot in part)
            out.append(f"{name:<{label}}{marks}".rstrip())
    return [*out, LEGEND, *_words(found)]


def _mark(lines: Sequence[Line], name: str) -> str:
    """The worst of a check's lines; blank where a robot says nothing of it."""
    levels = [line.level for line in lines if line.name == name]
    return MARKS[max(levels, key=_LEVELS.index)] if levels else ""


def _words(found: Mapping[int, Sequence[Line]]) -> Iterator[str]:
    for level in (BLOCKING, WARNING):
        said = [(line, robot) for robot, lines in found.items() for line in lines if line.level == level]
        yield from (f"{MARKS[level]} {sentence}" for sentence in sentences(said))
