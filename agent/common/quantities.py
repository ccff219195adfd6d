"""Numbers with a unit as people write them, "200ms", "30%", "100kbit", and back (PURE).

A plain number, or a text of only a number, is in the SI unit: s, m, m/s, bit/s; a ratio is then 0..1.
What cannot be read is a ValueError that says what is right and what was given, but not of which field.
Settings of several numbers ("normal 80ms 20ms 25%") are read word by word.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

_NUMBER = re.compile(r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)\s*([^\s0-9.]\S*)?")
_QUANTITY_MAX = 60  # characters
_SETTING_MAX = 200
_SHOWN_MAX = 60
Vector = tuple[float, float]
"""(x, y)."""
DISTANCE_MIN: Final = 1e-9
"""Nearer to each other than this (m), two points have no direction between them."""
FAR_M: Final = 1e6
"""Nothing in a fleet file or a mission is further away than this (m): its square is far from overflow."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Spellings of a quantity: suffix -> (times, divided by), so that "35%" is 0.35 exactly."""

    example: str
    suffixes: Mapping[str, tuple[float, float]]
    written: tuple[str, ...] = ()  # suffixes that `text` chooses from
    any_case: bool = False
    ending: tuple[str, str] = ("", "")  # of a suffix, and what it may be written as too: ("bit", "bit/s")


_BITS: Final = {
    f"{prefix}{name}": (scale * size, 1.0)
    for name, size in (("bit", 1), ("bps", 8))
    for prefix, scale in (
        ("", 1), ("k", 10**3), ("m", 10**6), ("g", 10**9), ("ki", 2**10), ("mi", 2**20), ("gi", 2**30),
    )
}  # fmt: skip

UNITS: Final[Mapping[str, Unit]] = {
    "s": Unit(
        "200ms",
        {"us": (1, 1e6), "ms": (1, 1e3), "s": (1, 1), "min": (60, 1), "h": (3600, 1)},
        ("s", "ms", "us"),
    ),
    "Hz": Unit("50Hz", {"Hz": (1, 1), "kHz": (1e3, 1)}),
    "m": Unit("20cm", {"mm": (1, 1e3), "cm": (1, 100), "m": (1, 1), "km": (1e3, 1)}, ("m",)),
    "m/s": Unit("20cm/s", {"mm/s": (1, 1e3), "cm/s": (1, 100), "m/s": (1, 1), "km/h": (1, 3.6)}, ("m/s",)),
    "m/s2": Unit("0.3m/s2", {"m/s2": (1, 1), "m/s^2": (1, 1)}),
    "rad": Unit("90deg", {"rad": (1, 1), "deg": (math.pi, 180)}),
    "rad/s": Unit("5deg/s", {"rad/s": (1, 1), "deg/s": (math.pi, 180)}),
    "kg": Unit("10kg", {"g": (1, 1e3), "kg": (1, 1)}),
    "N": Unit("20N", {"N": (1, 1)}),
    "N m": Unit("2Nm", {"Nm": (1, 1)}),
    "ratio": Unit("30%", {"%": (1, 100), "ppm": (1, 1e6)}, ("%",)),
    "dB": Unit("4dB", {"dB": (1, 1)}, ("dB",)),
    "bit/s": Unit("100kbit", _BITS, ("bit", "kbit", "mbit", "gbit"), True, ("bit", "bit/s")),
}
"""By unit. Rates are as in tc(8): bit, or bit/s, is a bit a second, bps a byte a second, in any case."""


def shown(raw: object) -> str:
    """What was given, as TOML writes it, on one line and cut short."""
    if isinstance(raw, int) and raw.bit_length() > 200:
        return f"an integer of {raw.bit_length()} bits"
    text = json.dumps(raw[:200]) if isinstance(raw, str) else str(raw)
    return text if len(text) <= _SHOWN_MAX else text[: _SHOWN_MAX - 3] + "..."


def quantity(raw: object, unit: str) -> float:
    """A finite number in `unit`, a key of `UNITS`. ValueError for anything else."""
    known = UNITS[unit]
    if isinstance(raw, str):
        match = _NUMBER.fullmatch(raw.strip()) if len(raw) <= _QUANTITY_MAX else None
        suffix = match[2] if match else None
        if suffix is not None and known.any_case:
            suffix = suffix.lower()
        if suffix is not None and known.ending[1] and suffix.endswith(known.ending[1]):
            suffix = suffix.removesuffix(known.ending[1]) + known.ending[0]
        if match is not None and (suffix is None or suffix in known.suffixes):
            times, divided = known.suffixes[suffix] if suffix else (1.0, 1.0)
            return _finite(float(match[1]) * times / divided, raw)
    elif isinstance(raw, (int, float)) and not isinstance(raw, bool):
        try:
            return _finite(float(raw), raw)
        except OverflowError:
            return _finite(math.inf, raw)
    plain = "a number" if unit == "ratio" else f"a number ({unit})"
    units = ", ".join(known.suffixes)
    raise ValueError(
        f"must be {plain} or a text such as {shown(known.example)} (units: {units}), got {shown(raw)}"
    )


def _finite(value: float, raw: object) -> float:
    if not math.isfinite(value):
        raise ValueError(f"must be a finite number, got {shown(raw)}")
    return value + 0.0  # -0.0 and 0.0 must be written alike


def seconds(raw: object) -> float:
    """A time: "200ms", "80us", 0.2."""
    return quantity(raw, "s")


def metres(raw: object) -> float:
    """A length: "10m", "20cm", 10."""
    return quantity(raw, "m")


def metres_per_second(raw: object) -> float:
    """A speed: "1500m/s", 1500."""
    return quantity(raw, "m/s")


def decibels(raw: object) -> float:
    """A level: "4dB", 4."""
    return quantity(raw, "dB")


def bits_per_second(raw: object) -> float:
    """A rate: "100kbit", "10kbps" (bytes a second, as in tc), 100000 (bits a second)."""
    return quantity(raw, "bit/s")


def ratio(raw: object) -> float:
    """A number within 0..1: "30%", 0.3, "0.3"."""
    value = quantity(raw, "ratio")
    if 0.0 <= value <= 1.0:
        return value
    meant = "" if isinstance(raw, str) and "%" in raw else '; a percentage is written "30%"'
    raise ValueError(f"must be between 0% and 100%, got {shown(raw)}{meant}")


def text(value: float, unit: str) -> str:
    """A finite number with a handy suffix, from which `quantity` reads exactly the same number."""
    known = UNITS[unit]
    exact: dict[str, float] = {}
    for suffix in known.written:
        times, divided = known.suffixes[suffix]
        number = float(f"{value * divided / times:.15g}")
        if number * times / divided == value:
            exact[suffix] = number
    handy = [suffix for suffix, number in exact.items() if 1.0 <= abs(number) < 1000.0]
    for suffix in (*handy, *exact):
        return f"{exact[suffix]:.15g}{suffix}"
    return repr(value)


# --- settings of several words ----------------------------------------------------------------


def split(raw: object, example: str) -> list[str]:
    """The words of a text, or a number as the only one. ValueError for anything else, and for none."""
    if isinstance(raw, (int, float)) and not isinstance(raw, bool) and abs(raw) < 1e300:
        return [repr(raw)]
    if not isinstance(raw, str) or not raw.split() or len(raw) > _SETTING_MAX:
        raise ValueError(f"must be a number or a text such as {example}, got {shown(raw)}")
    return raw.split()


def take_kind(words: list[str], kinds: Sequence[str]) -> str | None:
    """Takes the leading word when it is a name. ValueError when it is none of `kinds`."""
    if not words[0][0].isalpha():
        return None
    if words[0] not in kinds:
        raise ValueError(
            f"must be a number with its unit, or begin with one of {', '.join(kinds)}, got {shown(words[0])}"
        )
    return words.pop(0)


def within(
    read: Callable[[object], float], least: float, most: float, unit: str
) -> Callable[[object], float]:
    """A reader of the same quantity with bounds."""

    def read_within(raw: object) -> float:
        value = read(raw)
        if value < least:
            wrong = "not be negative" if least == 0.0 else f"be at least {text(least, unit)}"
            raise ValueError(f"must {wrong}, got {shown(raw)}")
        if value > most:
            raise ValueError(f"must be at most {text(most, unit)}, got {shown(raw)}")
        return value

    return read_within


def named(name: str, read: Callable[[object], float], word: str) -> float:
    """One number of several. ValueError begins with its name."""
    try:
        return read(word)
    except ValueError as error:
        raise ValueError(f"{name} {error}") from None


def correlation(words: Sequence[str]) -> float:
    """Of successive draws, 0..1 without 1: the only word, or 0 where there is none."""
    if not words:
        return 0.0
    value = named("correlation", ratio, words[0])
    if value == 1.0:
        raise ValueError(f"correlation must be less than 100%, got {shown(words[0])}")
    return value


def whole(name: str, word: str, least: int, most: int) -> int:
    """A whole number within bounds."""
    if not re.fullmatch(r"[0-9]{1,9}", word) or not least <= int(word) <= most:
        raise ValueError(f"{name} must be a whole number between {least} and {most}, got {shown(word)}")
    return int(word)
