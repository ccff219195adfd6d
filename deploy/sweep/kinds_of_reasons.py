"""Reasons of many runs, counted: those that say the same of other robots, or with other numbers, are one
kind.

A robot that is another from run to run is called A, B and so on, in the order in which a sentence names them:
of each of its runs the sentence is true then, which it would not be with all their names in one list.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from handfast.deploy.console.wording import NUMBER

_MANY: Final = r"\b(?P<many>\d+) robots \([^()]*\)"
_ROBOTS: Final = r"(?<=\brobot )\d+\b|(?<=\bRobot )\d+\b"
_LIST: Final = r"(?<=\b[Rr]obots )(?P<list>\d+(?:, \d+)*(?: and \d+)?\b)(?! more)"
_EDGE: Final = r"(?<=\bedge )\d+-\d+\b"
_PART: Final = re.compile(f"{_MANY}|(?P<ids>{_ROBOTS}|{_EDGE}|{_LIST})|{NUMBER}")
LETTERED: Final = re.compile(r"\b(?:[Rr]obots?|edge) A\b")
"""What is in a reason in which robots have no names of their own."""


def kinds_of_reasons(reasons: Iterable[str]) -> list[tuple[str, int]]:
    """Each kind in words, and how many reasons are of it, in the order in which it came first."""
    kinds: dict[str, list[str]] = {}
    for text in reasons:
        kinds.setdefault(_mask(text), []).append(text)
    return [(_in_one(texts), len(texts)) for texts in kinds.values()]


def _letters(text: str) -> Mapping[str, str]:
    """The robots that a text names, in that order, each with its letter."""
    found: dict[str, str] = {}
    for part in _PART.finditer(text):
        if part["ids"]:
            for robot in re.findall(r"\d+", part["ids"]):
                found.setdefault(robot, _letter(len(found)))
    return found


def _letter(place: int) -> str:
    return chr(ord("A") + place) if place < 26 else f"Z{place - 25}"


def _lettered(ids: str, letters: Mapping[str, str]) -> str:
    return re.sub(r"\d+", lambda found: letters[found[0]], ids)


def _mask(text: str) -> str:
    """What texts of one kind have in common."""
    letters = _letters(text)

    def masked(part: re.Match[str]) -> str:
        return _lettered(part["ids"], letters) if part["ids"] else "robots" if part["many"] else "0"

    return _PART.sub(masked, text)


def _in_one(texts: Sequence[str]) -> str:
    """Texts of one kind as one."""
    different = list(dict.fromkeys(texts))
    named = [_letters(text) for text in different]
    letters = None if all(list(each) == list(named[0]) for each in named) else named[0]
    found = iter(zip(*(_PART.finditer(text) for text in different), strict=True))
    return _PART.sub(lambda _: _together(next(found), letters), different[0])


def _together(parts: Sequence[re.Match[str]], letters: Mapping[str, str] | None) -> str:
    """What stands at one place of texts of one kind."""
    first = parts[0]
    if first["ids"]:
        return first["ids"] if letters is None else _lettered(first["ids"], letters)
    if all(part[0] == first[0] for part in parts):
        return first[0]
    numbers = sorted((part["many"] or part[0] for part in parts), key=float)
    span = numbers[0] if numbers[0] == numbers[-1] else f"{numbers[0]} to {numbers[-1]}"
    return f"{span} robots" if first["many"] else span
