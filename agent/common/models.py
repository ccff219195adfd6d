"""Models built from the values that a `Reader` found valid, and written back as tables (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.common.reader import T
from agent.common.settings import entries


def build(model: type[T], values: Mapping[str, Any]) -> T:
    """The model of what `Reader.read` returned without problems."""
    untyped: type = model
    arguments: dict[str, Any] = {}
    for entry in entries(untyped).values():
        if not entry.attribute:
            continue
        value = values[entry.attribute]
        if entry.table is not None:
            value = build(entry.table, value) if value is not None else None
        elif entry.tables is not None:
            value = tuple(build(entry.tables, row) for row in value)
        arguments[entry.attribute] = value
    return model(**arguments)


def plain(instance: object) -> dict[str, Any]:
    """A model as a table that TOML can hold: complete but for None, arrays as lists, in the file's names.

    A value of a class of its own (`Setting.parse`) is written as its text.
    """
    table: dict[str, Any] = {}
    model: type = type(instance)
    for entry in entries(model).values():
        if not entry.attribute:
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
    return table


def _without(table: dict[str, Any], key: str) -> dict[str, Any]:
    return {other: value for other, value in table.items() if other != key}


def _lists(value: Any) -> Any:
    return [_lists(item) for item in value] if isinstance(value, tuple) else value
