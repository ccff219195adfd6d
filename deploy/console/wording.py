"""Lists of robots, limits and errors in messages: short, and in good English."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterable, Sequence
from typing import Any, Final

from handfast.agent.control.limits import speed_max
from handfast.agent.fleet.model import Fleet

NAMES_SHOWN: Final = 8
FEW: Final = 20
"""Of so many hosts or robots each has a line of its own; more are summed up, but for those where something is
wrong."""
ALIKE_MAX: Final = 3
"""So many texts that differ in nothing but numbers are said one by one; more are one text."""
_ROBOTS: Final = r"\b[Rr]obots? (?P<ids>\d+(?:, \d+)*(?: and \d+)?\b)(?! more|[.:]\d)"
NUMBER: Final = r"(?<![\w.:/-])-?\d+(?:\.\d+)?(?![\w/-]|[.:]\d)"
"""A number that stands alone: no time of day, no address."""
_PART: Final = re.compile(f"{_ROBOTS}|{NUMBER}")
"""What texts that are alike may differ in: names of robots, and numbers that stand alone."""


def robots(ids: Iterable[Any]) -> str:
    """'robot 3', 'robots 1, 2 and 3', or '45 robots (1-30, 33, 35-40, 42 and 7 more)'."""
    shown = list(ids)
    if len(shown) > NAMES_SHOWN:
        return f"{len(shown)} robots ({some(shown)})"
    if len(shown) > 1:
        return f"robots {some(shown[:-1])} and {shown[-1]}"
    return f"robot{'s' * (len(shown) != 1)} {some(shown)}"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return one line for each row, with columns padded to the width of their longest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def counted(name: str, numbers: Iterable[Any]) -> str:
    """Numbered things as a subject: 'leg 2 is' or 'legs 2, 3 are'."""
    shown = list(numbers)
    return f"{name} {some(shown)} is" if len(shown) == 1 else f"{name}s {some(shown)} are"


def some(ids: Iterable[Any], shown: int = NAMES_SHOWN) -> str:
    """The first few of a list: '1, 2, 3'; of one that is longer than `NAMES_SHOWN` the numbers that follow
    each other together, and `shown` such parts: '1-30, 33, 35-40, 42 and 7 more'."""
    every = list(ids)
    parts = _runs(every) if len(every) > NAMES_SHOWN else [[each] for each in every]
    text = ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts[:shown])
    left = sum(map(len, parts[shown:]))
    return f"{text} and {left} more" if left else text


def _runs(ids: Sequence[Any]) -> list[list[Any]]:
    """A list in parts, of numbers that follow each other; two are two parts."""
    out: list[list[Any]] = []
    for each in ids:
        if out and isinstance(each, int) and each - 1 == out[-1][-1]:
            out[-1].append(each)
        else:
            out.append([each])
    return [part for run in out for part in ([run] if len(run) > 2 else [[each] for each in run])]


def grouped(said: Iterable[tuple[str, int]]) -> list[tuple[str, list[int]]]:
    """What is said, and the robots that it is said of, in the order in which it was said first.

    Where more than `ALIKE_MAX` texts differ in nothing but numbers, they are one, which says from which to
    which: a hundred robots that are late by as many times are one matter.

    Args:
        said: pairs of a text and a robot.
    """
    alike: dict[str, dict[str, list[int]]] = {}
    for text, robot in said:
        alike.setdefault(_PART.sub(_mask, text), {}).setdefault(text, []).append(robot)
    out: list[tuple[str, list[int]]] = []
    for texts in alike.values():
        if len(texts) > ALIKE_MAX:
            out.append((_in_one(list(texts)), sorted({robot for ids in texts.values() for robot in ids})))
        else:
            out += texts.items()
    return out


def _mask(part: re.Match[str]) -> str:
    return "robots" if part["ids"] else "0"


def _in_one(texts: Sequence[str]) -> str:
    """Texts that are alike, as one."""
    found = iter(zip(*(_PART.finditer(text) for text in texts), strict=True))
    return _PART.sub(lambda _: _spanned(next(found)), texts[0])


def _spanned(parts: Sequence[re.Match[str]]) -> str:
    """What stands at one place of texts that are alike: all robots that do, or the least and the greatest."""
    if parts[0]["ids"]:
        named = robots(sorted({int(number) for part in parts for number in re.findall(r"\d+", part["ids"])}))
        return named.capitalize() if parts[0][0][0] == "R" else named
    numbers = sorted((part[0] for part in parts), key=float)
    return numbers[0] if numbers[0] == numbers[-1] else f"{numbers[0]} to {numbers[-1]}"


def clock_ahead(by_s: float) -> str:
    """What is wrong with a clock whose orders no robot believes."""
    return (
        f"set this machine's clock: it is {by_s / 3600.0:.0f} h ahead of the robots', which believe no order "
        "of it but a stop"
    )


def clock_behind(by_s: float) -> str:
    """What is wrong with a clock for which robots' certificates, and what they said, are of the future."""
    by = f"{by_s / 3600.0:.0f} h" if by_s >= 5400.0 else f"{by_s / 60.0:.0f} min"
    return f"set this machine's clock: it is {by} behind the robots'"


def error_text(error: BaseException, before: str = "") -> str:
    """An exception on one line, with the place that it comes from."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({frames[-1].filename.rpartition('/')[2]}, line {frames[-1].lineno})" if frames else ""
    return " ".join(f"{before}{type(error).__name__}: {error}".split())[:300] + where


def speed_limit(fleet: Fleet) -> str:
    """What limits the speed of a fleet's robots, by the name of its field."""
    control = fleet.control
    most = speed_max(fleet)
    if most < control.max_speed_mps:
        return (
            f"the {most:.4g} m/s at which control.max_acceleration = {control.max_acceleration:.4g} can steer"
        )
    return f"control.max_speed_mps = {control.max_speed_mps:.4g}"
