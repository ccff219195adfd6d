"""Models built from the values that a `Reader` found valid, and written back as tables (PURE).

Also `new`, which makes a named tuple without the call of its class, for what is made at every tick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, NoReturn

from handfast.agent.common.errors import Error
from handfast.agent.common.plugins import attempt, blame
from handfast.agent.common.reader import Problem
from handfast.agent.common.settings import Entry, Sectioned, T, entries
from handfast.agent.common.wording import joined


class ModelError(Error, ValueError):
    """The class of a plugin's table does not take valid values; its argument is the `Problem`."""


def build(
    model: type[T],
    values: Mapping[str, Any],
    known: Callable[[type], Mapping[str, Entry]] = entries,
    place: str = "",
) -> T:
    """The model of what `Reader.read` returned without problems.

    Args:
        known: what a table of a model may hold: `Reader.entries` where tables of plugins are among it.
        place: of the table in the file.

    Raises:
        ModelError: the class of a plugin's table does.
    """
    untyped: type = model
    arguments: dict[str, Any] = {}
    sections: list[tuple[str, object]] = []
    for entry in known(untyped).values():
        if not entry.attribute:
            continue
        value, here = values[entry.attribute], joined(place, entry.key)
        if entry.table is not None and value is not None:
            made = partial(build, entry.table, value, known, here)
            value = attempt(made, partial(_failed, here, entry.table)) if entry.is_section else made()
        elif entry.tables is not None:
            rows = enumerate(value, 1)
            value = tuple(build(entry.tables, row, known, f"{here}[{k}]") for k, row in rows)
        if not entry.is_section:
            arguments[entry.attribute] = value
        elif value is not None:
            sections.append((entry.key, value))
    if sections:
        arguments["sections"] = tuple(sections)
    return model(**arguments)


def _failed(place: str, model: type, error: BaseException) -> NoReturn:
    raise ModelError(Problem(place, blame(error, model))) from None


def plain(instance: object) -> dict[str, Any]:
    """A model as a table that TOML can hold: complete but for None, arrays as lists, in the file's names.

    A value of a class of its own (`Setting.parse`) is written as its text.
    """
    table: dict[str, Any] = {}
    model: type = type(instance)
    for entry in entries(model).values():
        if not entry.attribute or entry.is_section:
            continue
        value = getattr(instance, entry.attribute)
        if entry.table is not None:
            value = plain(value) if value is not None else None
        elif (named := entry.setting.named) is not None:
            value = {getattr(row, named): _without(plain(row), named) for row in value} or None
        elif entry.tables is not None:
            value = [plain(row) for row in value]
        if value is not None:
            table[entry.key] = _lists(value) if entry.setting.parse is None else str(value)
    if isinstance(instance, Sectioned):
        table |= {name: plain(section) for name, section in instance.sections}
    return table


def _without(table: dict[str, Any], key: str) -> dict[str, Any]:
    return {other: value for other, value in table.items() if other != key}


def _lists(value: Any) -> Any:
    return [_lists(item) for item in value] if isinstance(value, tuple) else value


new: Final = tuple.__new__
"""``new(Hand, (x, y, vx, vy))`` is ``Hand(x, y, vx, vy)`` for a fifth of the instructions where that is
compiled. Nothing counts the fields or fills defaults in: all of them have to be there, in their order."""
