"""Fields that are varied: over values, or drawn by every run, as ``--over`` has them.

Of a range is known here what numbers its ends are to the field itself: its typed unit must be one that the
field takes, for a plain number in the field's unit is all that a run gets.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import floor, isfinite, log10
from types import MappingProxyType, UnionType
from typing import Final, Union, get_args, get_origin

from handfast.agent.common import random_streams
from handfast.agent.common.errors import Error
from handfast.agent.common.quantities import UNITS, quantity
from handfast.agent.common.settings import Entry, entries
from handfast.agent.common.wording import describe, printable
from handfast.agent.fleet.model import Fleet

_BRACKETS: Final = {"[": "]", "{": "}"}
_NUMBER: Final = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\s*(?P<unit>[^\W\d_][\w/^]*|%)?")
Sections = Mapping[str, type]
"""Tables of plugins by their names, with their models."""
_NO_SECTIONS: Final[Sections] = MappingProxyType({})


class SweepError(Error, ValueError):
    """A sweep that cannot be made; the text is one clear message."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One field that is varied, with its values as they were typed.

    Numbers are in ascending order; `numbers` are the values in the field's unit, None where one of them
    is no number. `unit` is that unit, empty without one.
    """

    field: str
    values: tuple[str, ...]
    numbers: tuple[float, ...] | None
    unit: str

    def __str__(self) -> str:
        return f"{self.field}={','.join(self.values)}"


@dataclass(frozen=True, slots=True)
class Range:
    """One field that every run draws, uniform between two numbers in the field's unit.

    `text` is the range as it was typed; `unit` that unit, empty without one. Of a field of whole numbers,
    `whole`, both are such, of any size, and every one in the range is as likely. `typed` are its ends where
    the field takes them so, each with its unit.
    """

    field: str
    low: float
    high: float
    unit: str
    text: str
    whole: bool = False
    typed: tuple[str, str] | None = None

    def __str__(self) -> str:
        return f"{self.field}={self.text}"

    def value(self, seed: int) -> str:
        """What the run with this `fleet.seed` draws, as a plain number; nothing else is drawn with it."""
        share = random_streams.uniform(random_streams.stream("sweep", seed, self.field), 0)
        if self.whole:
            low, high = int(self.low), int(self.high)
            return str(low + ((high - low + 1) * int(share * 2.0**53) >> 53))
        width = self.high - self.low
        # Six digits of where in the range, however far that is from 0.
        digits = 6 + max(0, floor(log10(max(abs(self.low), abs(self.high)) / width)))
        drawn = f"{self.low + width * share:.{min(digits, 17)}g}"
        inside = min(max(self.low, float(drawn)), self.high)  # rounded, it may not be
        return drawn if inside == float(drawn) else _plain(inside)

    @property
    def ends(self) -> tuple[str, str]:
        """The least and the greatest that may be drawn: what is wrong with one is said of what was typed."""
        if self.typed is not None:
            return self.typed
        if self.whole:
            return str(int(self.low)), str(int(self.high))
        return _plain(self.low), _plain(self.high)


def _plain(number: float) -> str:
    """A number as every program reads it, with six digits where these say it."""
    short = f"{number:.6g}"
    return short if float(short) == number else repr(float(number))


def parse_over(text: str, sections: Sections = _NO_SECTIONS) -> Axis | Range:
    """Reads one ``--over``: values (`parse_axis`), or a range ``table.field=low..high``, whose unit may stand
    behind its end alone.

    Args:
        sections: tables of plugins, as far as they are known: what a field takes, only its model says.

    Raises:
        SweepError: it is neither, or no range can be of this field.
    """
    path, _, written = text.partition("=")
    values = [value.strip() for value in _split(written)]
    if not any(map(_is_range, values)):
        return parse_axis(text)
    name = parse_axis(f"{path}=0").field
    entry = entry_of(name.split("."), sections)
    if entry is not None and entry.setting.parse is None and not _number_types(entry):
        raise SweepError(
            f"--over {name}: nothing can be drawn for it, as it is {describe(entry.hint)}, and a range is of "
            "numbers: give its values, with commas between them"
        )
    if len(values) > 1:
        raise SweepError(
            f"--over {printable(text)}: a range cannot stand in a list: give values alone, such as "
            "100ms,1s,2s, or one range, such as 100ms..2s (a value that rises while it is driven stands in "
            'quotes: "100ms..1s")'
        )
    return _range(name, values[0], entry)


def _is_range(value: str) -> bool:
    """Whether it is written as a range, or as one that lacks an end."""
    low, dots, high = (part.strip() for part in value.partition(".."))
    return bool(dots) and all(_NUMBER.fullmatch(end) for end in (low, high) if end)


def _range(name: str, written: str, entry: Entry | None) -> Range:
    """Read the range of a field; `entry` is the field, None if it is not known."""
    said = printable(f"--over {name}={written}")
    ends = _ends(said, written)
    parse = entry.setting.parse if entry is not None else None
    if entry is None:
        numbers, unit = _numbers(name.split("."), ends)
    elif parse is not None:
        numbers, unit = _accepted(said, parse, ends)
    else:
        numbers, unit = _plain_numbers(said, entry, ends)
    if numbers is None:
        raise SweepError(f"{said}: its ends must be numbers of one unit")
    whole = entry is not None and parse is None and _number_types(entry) == {int}
    if whole:
        numbers = _whole_numbers(said, ends, numbers)
    if not numbers[0] < numbers[1]:
        raise SweepError(f"{said}: the range must begin below its end, such as 0..1.4s")
    typed = None if parse is None else ends
    return Range(name, numbers[0], numbers[1], unit, written, whole, typed)


def _ends(said: str, written: str) -> tuple[str, str]:
    """Split a range into its ends. A unit behind the second is that of both."""
    low, _, high = (part.strip() for part in written.partition(".."))
    if "..." in written:
        raise SweepError(f"{said}: a range has two dots, not three; write 0..0.8s for up to 0.8 s")
    if not low or not high:
        raise SweepError(f"{said}: a range needs both ends, such as 0..1.4s")
    if number(low, "") is not None and (match := _NUMBER.fullmatch(high)) is not None:
        low += match["unit"] or ""  # 10..50% is 10 % to 50 %
    return low, high


def _plain_numbers(said: str, entry: Entry, ends: Sequence[str]) -> tuple[list[float], str]:
    """Return the ends of a range in the unit of a field that is a number, and that unit."""
    unit = entry.setting.unit or ""
    found = [value for end in ends if (value := number(end, unit)) is not None]
    if len(found) < len(ends):
        known = f" or end in one of {', '.join(UNITS[unit].suffixes)}" if unit in UNITS else ""
        of = describe(entry.hint, entry.setting.unit)
        raise SweepError(f"{said}: its ends must be plain numbers{known}, as the field is {of}")
    return found, unit


def _whole_numbers(said: str, ends: Sequence[str], values: Sequence[float]) -> list[float]:
    """Return whole numbers as they were typed: a float does not hold all digits of one above 2^53."""
    if not all(value.is_integer() for value in values):
        raise SweepError(f"{said}: the field takes whole numbers only, so its ends must be such, as 0..5")
    return [
        int(end) if re.fullmatch(r"[+-]?\d+", end) else int(value)
        for end, value in zip(ends, values, strict=True)
    ]


def _accepted(
    said: str, parse: Callable[[object], object], ends: Sequence[str]
) -> tuple[list[float] | None, str]:
    """The ends of a range in the one unit of a field with a class of its own, and this unit.

    What is accepted is for the class to say: only it knows that a delay is no number of metres. What is no
    matter of units, such as a share above 1, is said where all of a fleet is.
    """
    numbers, unit = _in_one_unit(ends)
    for place, end in reversed(tuple(enumerate(ends))):  # a unit is typed behind the last
        wrong = _refused(parse, end if number(end, "") is None else float(end))
        if wrong and (numbers is None or not _refused(parse, numbers[place])):
            raise SweepError(f"{said}: {printable(wrong)}")
    return numbers, unit


def _refused(parse: Callable[[object], object], raw: object) -> str:
    """What is wrong with a value, empty when nothing is."""
    try:
        parse(raw)
    except ValueError as error:
        return str(error)
    return ""


def parse_axis(text: str) -> Axis:
    """Reads one ``--over``: ``table.field=value,value,...``, split at commas outside quotes and brackets.

    Raises:
        SweepError: it is not of that form, or gives a value twice.
    """
    path, equals, written = text.partition("=")
    keys = [key.strip() for key in path.split(".")]
    name = ".".join(keys)
    if not equals or len(keys) < 2 or not all(keys):
        raise SweepError(
            f"--over {printable(text)}: must be written as table.field=value,value, "
            "such as control.kp=0.5,1,2 or faults.delay=0,50ms,100ms, or drawn: faults.delay=0..1.4s"
        )
    if name == "fleet.seed":
        raise SweepError(
            "--over fleet.seed: every run has a seed of its own already, made of --seed and its repeat: "
            f"write for example --repeat {len(_split(written))}"
        )
    values = [value.strip() for value in _split(written)]
    if not all(values):
        raise SweepError(f"--over {printable(text)}: a value is missing between two commas or at an end")
    numbers, unit = _numbers(keys, values)
    if numbers is not None:
        order = sorted(range(len(values)), key=numbers.__getitem__)
        values, numbers = [values[k] for k in order], [numbers[k] for k in order]
    _refuse_twice(name, values, values if numbers is None else numbers)
    return Axis(name, tuple(values), None if numbers is None else tuple(numbers), unit)


def _refuse_twice(name: str, values: Sequence[str], meanings: Sequence[object]) -> None:
    """Refuse values that mean the same."""
    same: dict[object, str] = {}
    for value, meaning in zip(values, meanings, strict=True):
        if meaning in same:
            first = same[meaning]
            again = f"{value} twice" if first == value else f"{first} and {value}, which are the same"
            raise SweepError(f"--over {name}: gives {printable(again)}")
        same[meaning] = value


def _split(text: str) -> list[str]:
    parts, closing, start = [], "", 0
    for index, letter in enumerate(text):
        if closing and closing[-1] in "\"'":
            closing = closing[:-1] if letter == closing[-1] else closing
        elif letter in "\"'":
            closing += letter
        elif letter in _BRACKETS:
            closing += _BRACKETS[letter]
        elif closing and letter == closing[-1]:
            closing = closing[:-1]
        elif letter == "," and not closing:
            parts.append(text[start:index])
            start = index + 1
    return [*parts, text[start:]]


def _numbers(keys: Sequence[str], values: Sequence[str]) -> tuple[list[float] | None, str]:
    """The values as numbers of one unit, and that unit."""
    entry = entry_of(keys)
    if entry is None or not entry.setting.unit:
        return _in_one_unit(values)
    found = [number(value, entry.setting.unit) for value in values]
    numbers = [value for value in found if value is not None]
    return (numbers, entry.setting.unit) if len(numbers) == len(values) else (None, "")


def _in_one_unit(values: Sequence[str]) -> tuple[list[float] | None, str]:
    """The values as numbers of one unit, which their suffixes say: a value class of its own, such as a delay,
    has none."""
    for unit in UNITS:
        found = [number(value, unit) for value in values]
        numbers = [value for value in found if value is not None]
        if len(numbers) == len(values):
            bare = all(number(value, "") is not None for value in values)
            return numbers, "" if bare else unit
    return None, ""


def number(text: str, unit: str) -> float | None:
    """The number that a value such as ``50ms`` is in `unit`, None when it is no such number."""
    text = text.strip().strip("\"'")
    try:
        value = quantity(text, unit) if unit in UNITS else float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None


def entry_of(keys: Sequence[str], sections: Sections = _NO_SECTIONS) -> Entry | None:
    """A field of the fleet file, None where it is not known."""
    model: type | None = Fleet
    rest = list(keys)
    while rest and model is not None:
        key = rest.pop(0)
        entry = entries(model).get(key)
        if entry is None:
            model = sections.get(key)  # which has a name of its own in the whole file
            continue
        if not rest:
            return entry
        if entry.tables is not None:
            rest = rest[1:]  # which entry of the array
        model = entry.table or entry.tables
    return None


def _number_types(entry: Entry) -> set[type]:
    """Which of int and float a field may be."""
    hints = get_args(entry.hint) if get_origin(entry.hint) in (Union, UnionType) else (entry.hint,)
    return {hint for hint in hints if hint in (int, float)}
