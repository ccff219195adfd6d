"""What a caller gave that can be no such thing becomes an `Error`: keys, paths, flags, whole numbers."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from math import inf
from numbers import Real
from operator import index
from pathlib import Path
from typing import Final, TypeVar

from handfast.agent.common.errors import Error

K = TypeVar("K")
V = TypeVar("V")

_SHOWN_MAX: Final = 60


class Known(dict[K, V]):
    """A dictionary of what there is; an `Error` that names it for a key that there is not.

    Args:
        what: one of these, as "robot".
    """

    def __init__(self, what: str, values: Mapping[K, V]) -> None:
        super().__init__(values)
        self._what = what

    def __missing__(self, key: K) -> V:
        there_is = f"there is no {self._what} {key!r}"
        if isinstance(key, tuple) and key[::-1] in self:
            raise Error(f"{there_is}: it is {key[::-1]}")
        if not self:
            raise Error(f"{there_is}, nor any other")
        shown = ", ".join(map(str, list(self)[:_SHOWN_MAX]))
        more = f" and {len(self) - _SHOWN_MAX} more" if len(self) > _SHOWN_MAX else ""
        numbers = " (whole numbers)" if isinstance(key, str) and not isinstance(next(iter(self)), str) else ""
        raise Error(f"{there_is}; there are {shown}{more}{numbers}")


def a_path(given: object, what: str) -> Path:
    """The path that is `what`; raises `Error`."""
    with suppress(TypeError, ValueError):
        path = Path(given)  # type: ignore[arg-type]
        if b"\0" not in os.fsencode(path):
            return path
    raise Error(f"{what} must be a path, got {given!r}")


def flags(**given: object) -> None:
    """Raises `Error` unless each is True or False."""
    for name, value in given.items():
        if not isinstance(value, bool):
            raise Error(f"{name} must be True or False, got {value!r}")


def positive(given: object, what: str) -> float:
    """A number above 0; raises `Error`."""
    if not isinstance(given, bool) and isinstance(given, Real) and 0.0 < float(given) < inf:
        return float(given)
    raise Error(f"{what} must be a number above 0, got {given!r}")


def whole(given: object, what: str, least: int | None = None) -> int:
    """A whole number, numpy's too; raises `Error`."""
    with suppress(TypeError):
        number = index(given)  # type: ignore[arg-type]
        if not isinstance(given, bool) and (least is None or number >= least):
            return number
    bound = "" if least is None else f" of at least {least}"
    raise Error(f"{what} must be a whole number{bound}, got {given!r}")
