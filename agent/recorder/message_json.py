"""Messages of the bus as JSON, the form in which a recording keeps them, and their JSON schemas.

JSON because Foxglove and every other MCAP tool reads it without our code. A number is written as the
shortest decimal that reads back to the same double, so nothing is lost. Rows become objects
(``{"neighbour": 2, "value": 0.5}``): Foxglove has no arrays within arrays, and its message
paths find and filter by these names. All is made of the messages' declarations
(`agent.messages.declaration`).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from operator import itemgetter
from typing import Any, Final

import orjson

from handfast.agent.messages.declaration import REQUIRED, Field, declared
from handfast.agent.messages.types import Message

_TYPES: Final = {int: "integer", float: "number", bool: "boolean", str: "string", object: "string"}
_writers: Final[dict[type, Callable[[Any], bytes]]] = {}


def schema_name(cls: type[Message]) -> str:
    """Name of a message's schema in a recording, such as ``handfast.HandState``."""
    return f"handfast.{cls.__name__}"


def schema(cls: type[Message]) -> dict[str, Any]:
    """JSON schema of one message class."""
    about = {"title": schema_name(cls), "description": (cls.__doc__ or "").split("\n", 1)[0]}
    return about | _object_schema(cls)


def _object_schema(cls: type[tuple[Any, ...]]) -> dict[str, Any]:
    properties = {field.name: _schema(field) for field in declared(cls)}
    return {"type": "object", "properties": properties, "required": list(properties)}


def _schema(field: Field) -> dict[str, Any]:
    described: dict[str, Any] = {"description": field.about.text}
    if field.row is not None:
        return described | {"type": "array", "items": _object_schema(field.row)}
    if field.item is not None:
        return described | {"type": "array", "items": {"type": _TYPES[field.item.kind]}}
    if field.about.choices:
        return described | {"type": "string", "enum": list(field.about.choices)}
    return described | {"type": _TYPES[field.kind]}


# ---------------------------------------------------------------------- writing


def to_json(message: Message) -> bytes:
    """The message as one line of JSON, its fields in the order of the class. Its floats must be finite."""
    cls = type(message)
    write = _writers.get(cls)
    if write is None:
        write = _writers[cls] = _writer(cls)
    return write(message)


def _writer(cls: type[Message]) -> Callable[[Message], bytes]:
    """A function that writes messages of one class: by a dictionary that is built in one expression, which
    orjson writes in a sixth of the time that templates of Python take."""
    names: dict[str, Any] = {"dumps": orjson.dumps, "text": _dumps}
    content = _content(cls, names)
    fields = ", ".join(field.name for field in declared(cls))
    exec(
        f"def write(message):\n    {fields}, = message\n    content = {content}\n"
        "    try:\n        return dumps(content)\n"
        # Integers of more than 64 bits, which no message of the bus holds, and halves of surrogate pairs.
        "    except TypeError:\n        return text(content).encode()\n",
        names,
    )
    write: Callable[[Message], bytes] = names["write"]
    return write


def _content(cls: type[tuple[Any, ...]], names: dict[str, Any], prefix: str = "") -> str:
    """Python for the dictionary of an object, by the names of its fields.

    What this Python needs is added to `names`.
    """
    values = []
    for field in declared(cls):
        name = value = prefix + field.name
        if field.row is not None:
            columns = ", ".join(f"{name}_{column.name}" for column in declared(field.row))
            value = f"[{_content(field.row, names, f'{name}_')} for {columns}, in {name}] if {name} else ()"
        elif field.kind is int and field.about.choices:
            names[f"{name}_texts"] = field.about.choices
            value = f"{name}_texts[{name}]"
        elif field.kind is object:  # a schema has one type for it: text, of its JSON
            value = f"text({name})"
        values.append(f'"{field.name}": {value}')
    return "{" + ", ".join(values) + "}"


def _dumps(content: Any) -> str:
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


# ---------------------------------------------------------------------- reading


def reader(cls: type[Message]) -> Callable[[dict[str, Any]], Message]:
    """A function from a parsed JSON object to the message. Recordings of earlier versions are read as well.

    The function raises KeyError, TypeError or ValueError for an object that is not such a message.
    """
    read: Callable[[dict[str, Any]], Message] = _reader(cls, cls._make)
    return read


def _reader(
    cls: type[tuple[Any, ...]], made: Callable[[tuple[Any, ...]], Any]
) -> Callable[[dict[str, Any]], Any]:
    """A function from a JSON object to `made` of its values."""
    fields = declared(cls)
    values = itemgetter(*(field.name for field in fields))
    added = {field.name: field.about.before for field in fields if field.about.before is not REQUIRED}
    changes = [
        (index, change) for index, field in enumerate(fields) if (change := _change(field)) is not None
    ]

    def read(content: dict[str, Any]) -> Any:
        try:
            found = values(content)
        except KeyError:
            lacking = {name: value for name, value in added.items() if name not in content}
            known = {name: value(content) if callable(value) else value for name, value in lacking.items()}
            found = values(known | content)
        if changes:
            found = list(found)
            for index, change in changes:
                found[index] = change(found[index])
        return made(found)

    return read


def _change(field: Field) -> Callable[[Any], Any] | None:
    """What makes of a value in JSON that of a message; None where they are the same."""
    if field.row is not None:
        row: Any = field.row
        read = _reader(field.row, row._make if field.named else tuple)
        return lambda rows: tuple(map(read, rows))
    if field.item is not None:
        return tuple
    if field.kind is object:
        return lambda text: _hashable(json.loads(text))
    return field.about.choices.index if field.kind is int and field.about.choices else None


def _hashable(value: Any) -> Any:
    """A value as messages have it: tuples for lists."""
    return tuple(map(_hashable, value)) if isinstance(value, list) else value
