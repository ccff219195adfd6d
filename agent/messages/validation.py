"""What is a valid message: every field of its declared type, and within its bounds (PURE).

Whatever comes over the network is looked at field by field before anybody uses it. Nearly all passes the
short way (`agent.messages.fast_path`). What does not goes the long way, here: it takes numbers as other
languages' encoders write them, and says what is wrong.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final

from handfast.agent.messages.declaration import FLOAT_MAX, Field, declared
from handfast.agent.messages.fast_path import omitted, rows_of_numbers
from handfast.agent.messages.types import Faults, Message

REASONS: Final = ("oversized", "checksum", "malformed", "version", "type", "not_finite", "range")
"""Why payloads are refused; receivers count them by these names."""
_DEPTH_MAX: Final = 2
_EXACT: Final = 2**53
"""Every integer up to it is a float as well."""

Row = tuple[Any, ...]


class Malformed(ValueError):
    """A payload that is not a valid message; `reason` is one of `REASONS`, `detail` is for people."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason, self.detail = reason, detail


def shown(value: Any) -> str:
    """A received value for a message to people: at most 40 characters."""
    if isinstance(value, tuple):  # its repr could be as deep as the sender liked
        return "an array"
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def examined(cls: type[Message], values: Row) -> Message:
    """The message of these fields, `About.omitted` ones with or without.

    Raises:
        Malformed: with the first thing that is wrong with them; wrong types come first.
    """
    rest, missing = omitted(cls), len(cls._fields) - len(values)
    if 0 < missing <= len(rest):
        values = (*values, *rest[-missing:])
    message = cls._make(_row(cls, values, cls.__name__))
    if isinstance(message, Faults) and (contradiction := message.contradiction()):
        raise Malformed("range", contradiction)
    return message


def _row(cls: type[Row], values: Any, what: str) -> Row:
    """The checked values of a message, or of a row `what`."""
    fields = declared(cls)
    if type(values) is not tuple:
        raise Malformed("malformed", f"{what} holds {shown(values)}, not an array")
    if len(values) != len(fields):
        raise Malformed("malformed", f"{what} has {len(fields)} fields, got {len(values)}")
    typed = [
        _typed(field, value, f"{what}.{field.name}") for field, value in zip(fields, values, strict=True)
    ]
    return tuple(
        _bounded(field, value, f"{what}.{field.name}") for field, value in zip(fields, typed, strict=True)
    )


def _typed(field: Field, value: Any, what: str) -> Any:
    """A value of the right type. An encoder may write 1.0 as the integer 1: such a number is a float."""
    if type(value) is field.kind or (field.kind is object and _is_setting(value)):
        return value
    if field.kind is float and type(value) is int and -_EXACT <= value <= _EXACT:
        return float(value)
    wanted = "number, text, truth value or rows of these" if field.kind is object else field.kind.__name__
    raise Malformed("malformed", f"{what} is {shown(value)}, not a {wanted}")


def _bounded(field: Field, value: Any, what: str) -> Any:
    about = field.about
    if field.kind is tuple:
        return _rows(field, value, what)
    if field.kind is object:
        _check_finite(value, what)
    elif field.kind is str:
        if about.choices and value not in about.choices:
            raise Malformed("range", f"{what} is {shown(value)}, not one of {', '.join(about.choices)}")
        if about.characters and not (0 < len(value) <= about.characters and value.isprintable()):
            raise Malformed(
                "range", f"{what} {shown(value)} is not 1 to {about.characters} printable characters"
            )
    elif field.kind is not bool:
        if field.kind is float and not isfinite(value):
            raise Malformed("not_finite", f"{what} is {value}")
        least, most = field.bounds
        if (least is not None and value < least) or (most is not None and value > most):
            raise Malformed("range", f"{what} is {shown(value)}, not within {least} to {most}")
    return value


def _rows(field: Field, values: Row, what: str) -> Row:
    most = field.about.rows
    if most and len(values) > most:
        raise Malformed("range", f"{what} has {len(values)} entries, at most {most} are accepted")
    item, row = field.item, field.row
    if item is not None:
        return tuple(_bounded(item, _typed(item, value, what), what) for value in values)
    assert row is not None
    if (short := rows_of_numbers(field)) and (taken := short(values)) is not None:
        return taken
    kind = row if field.named else tuple
    return tuple(tuple.__new__(kind, _row(row, value, what)) for value in values)


def _is_setting(value: Any, depth: int = 0) -> bool:
    """Whether a fleet file could hold it: number, text, truth value, or rows of numbers."""
    if type(value) is tuple and depth < _DEPTH_MAX:
        return all(_is_setting(item, depth + 1) for item in value)
    return type(value) in (int, float, str, bool)


def _check_finite(value: Any, what: str) -> None:
    for number in value if type(value) is tuple else (value,):
        if type(number) is tuple:
            _check_finite(number, what)
        elif type(number) is float and not abs(number) <= FLOAT_MAX:
            reason = "range" if isfinite(number) else "not_finite"
            raise Malformed(reason, f"{what} holds {number:g}, beyond +-{FLOAT_MAX:g}")
