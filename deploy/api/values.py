"""Values that Python callers give: checked, and turned into changes of a fleet file as ``--set`` has them."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from math import inf
from numbers import Real
from operator import index
from pathlib import Path
from typing import Final, TypeVar

from handfast.agent.common import plugins
from handfast.agent.common.errors import Error
from handfast.agent.common.reader import Problem
from handfast.agent.fleet import model, plants
from handfast.agent.fleet.model import FleetError

_OPTION: Final = re.compile(r"--(?:set|over) (?=[\w\"])|--(?=law\b)| with --out\b")


class Classes:
    """Laws and plants of one's own, by the names that stand for them in a fleet file."""

    def __init__(self, known: Mapping[str, type] | None = None) -> None:
        self.known = dict(known or {})

    def reference(self, plugin: type) -> str:
        """What the fleet file says for a class: where it can be imported, else a name for this process.

        Raises:
            handfast.agent.common.plugins.PluginError: its name is none.
        """
        module = sys.modules.get(plugin.__module__)
        if plugin.__module__ != "__main__" and getattr(module, plugin.__qualname__, None) is plugin:
            return f"{plugin.__module__}:{plugin.__qualname__}"
        plugins.register(plugin.__name__, plugin)
        self.known[plugin.__name__] = plugin
        return plugin.__name__

    def register(self) -> None:
        """Makes the names known in this process, in the place of what had them."""
        for name, plugin in self.known.items():
            plugins.register(name, plugin)


def override(path: str, value: object, classes: Classes) -> str:
    """One change as ``table.field=value``.

    Raises:
        Error: the value is none that a fleet file can hold.
    """
    if not isinstance(path, str):
        raise Error(f"a field is named by a text such as 'control.kp', got {path!r}")
    return f"{path}={toml(path, value, classes)}"


def toml(path: str, value: object, classes: Classes) -> str:
    """A value as TOML text; raises as `override`."""
    if isinstance(value, type):
        value = classes.reference(value)
    if isinstance(value, Path):
        value = str(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, (int, float)):
        return repr(value) if type(value) in (int, float) else repr(float(value))
    if isinstance(value, Mapping):
        inside = (f"{json.dumps(str(key))} = {toml(path, each, classes)}" for key, each in value.items())
        return f"{{{', '.join(inside)}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(toml(path, each, classes) for each in value)}]"
    if hasattr(value, "tolist"):  # numpy's
        return toml(path, value.tolist(), classes)
    raise Error(
        f"{path}: a number, text, True, False, a list, a dictionary or a class was expected, got {value!r}"
    )


def own_classes(settings: model.Fleet, cannot: str) -> set[str]:
    """Laws and plants of others that a fleet names.

    Args:
        cannot: who needs them somewhere else, as "robots' processes cannot import".

    Raises:
        Error: one of them is known in this process alone.
    """
    named = {robot.plant for robot in settings.robots if robot.plant not in plants.KINDS}
    if settings.control.law is not None:
        named.add(settings.control.law)
    for name in sorted(named):
        if ":" not in name:
            raise Error(
                f"{name}: {cannot} a class that is defined here: put it into a module of its own, and import "
                "it from there (simulate and sweep take it as it is)"
            )
    return named


@contextmanager
def in_words_of_python() -> Iterator[None]:
    """A context whose errors name fields as Python does, not the command line's options."""
    try:
        yield
    except FleetError as error:
        problems = [Problem(_plain(each.place), _plain(each.message)) for each in error.problems]
        raise type(error)(error.source, problems) from None
    except Error as error:
        if error.args == (str(error),) and _plain(str(error)) != str(error):
            raise type(error)(_plain(str(error))) from None
        raise


def _plain(text: str) -> str:
    return _OPTION.sub("", text)


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
