"""What is a valid message: every field of its declared type, and within its bounds (PURE).

Whatever comes over the network is looked at here, field by field, before anybody uses it. `taker` writes the
short way for one class out of its declaration, as a function without loops over fields; what does not pass
there goes the long way, `examined`, which takes numbers as other languages' encoders write them, and says
what is wrong. Rows of numbers have a short way there, too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import takewhile
from math import isfinite
from typing import Any, Final

from agent.messages.declaration import FLOAT_MAX, Field, declared
from agent.messages.types import Faults, Message, Mission

REASONS: Final = ("oversized", "checksum", "malformed", "version", "type", "not_finite", "range")
"""Why payloads are refused; receivers count them by these names."""
HEAD: Final = 2
"""Version and type come before the fields."""
_DEPTH_MAX: Final = 2
_EXACT: Final = 2**53
"""Every integer up to it is a float as well."""

Row = tuple[Any, ...]
Taker = Callable[[Row], Message]


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


def omitted(cls: type[Row]) -> Row:
    """What a message of this class ends with where the wire leaves it out, or nothing: ``((),)``."""
    left_out = tuple(takewhile(lambda field: field.about.omitted, reversed(declared(cls))))
    return tuple(field.kind() for field in reversed(left_out))


# ---------------------------------------------------------------------- the short way


def taker(cls: type[Message]) -> Taker:
    """A function from an unpacked array, of this version and of the class's number, to the message.

    The function raises `Malformed` where it is none.
    """
    names: dict[str, Any] = {"new": tuple.__new__, "cls": cls, "examined": examined, "F": FLOAT_MAX}
    body = ""
    if cls in (Faults, Mission):  # rare, and with bounds that are no comparison of one number
        for field in declared(cls):
            if field.row is not None:
                _rows_of_numbers(field)  # made now as well
    else:
        rest = omitted(cls)
        for left_out in (rest[first:] for first in range(len(rest) + 1)):
            fields = declared(cls)[: len(cls._fields) - len(left_out)]
            whole = ", ".join(field.name for field in fields)
            body += (
                f"    if len(array) == {HEAD + len(fields)}:\n"
                f"        _, _, {whole} = array\n"
                f"        if {_conditions(fields, names)}:\n"
                f"            return new(cls, ({', '.join([whole, *map(repr, left_out)])}))\n"
            )
    exec(f"def take(array):\n{body}    return examined(cls, array[{HEAD}:])\n", names)
    take: Taker = names["take"]
    return take


def _conditions(fields: tuple[Field, ...], names: dict[str, Any], place: str = "") -> str:
    """Python that is true where no value needs a second look; rows become those of their class.

    Args:
        place: how the value of a number is had, where it is not known by its name yet.
    """
    tests = []
    for number, field in enumerate(fields):
        name, about = field.name, field.about
        least, most = field.bounds
        value = f"({name} := {place.format(number)})" if place else name
        tests.append(f"type({value}) is {field.kind.__name__}")
        if about.choices and field.kind is str:
            tests.append(f"{name} in {about.choices!r}")
        elif field.kind is float and (least, most) == (-FLOAT_MAX, FLOAT_MAX):
            tests.append(f"-F <= {name} <= F")  # false for a NaN, too
        elif least is not None and most is not None:
            tests.append(f"{least!r} <= {name} <= {most!r}")
        elif field.kind is tuple:
            names[f"{name}_"] = _rows_taker(field)
            tests.append(f"(not {name} or ({name} := {name}_({name})) is not None)")
    return " and ".join(tests)


def _rows_taker(field: Field) -> Callable[[Row], Row | None]:
    """A function from a field's rows to those of their class; None where some need a second look."""
    names: dict[str, Any] = {"new": tuple.__new__, "F": FLOAT_MAX, "row": field.row}
    if field.item is not None:
        conditions = _conditions((field.item,), names, "each")
    else:
        assert field.row is not None
        columns = declared(field.row)
        conditions = f"type(each) is tuple and len(each) == {len(columns)} and " + _conditions(
            columns, names, "each[{}]"
        )
    most = f"    if len(rows) > {field.about.rows}: return None\n" if field.about.rows else ""
    made = "tuple([new(row, each) for each in rows])" if field.named else "rows"
    exec(
        f"def take(rows):\n{most}    for each in rows:\n        if not ({conditions}): return None\n"
        f"    return {made}\n",
        names,
    )
    take: Callable[[Row], Row | None] = names["take"]
    return take


# ---------------------------------------------------------------------- the long way


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
    if (short := _rows_of_numbers(field)) and (taken := short(values)) is not None:
        return taken
    kind = row if field.named else tuple
    return tuple(tuple.__new__(kind, _row(row, value, what)) for value in values)


@cache
def _rows_of_numbers(field: Field) -> Callable[[Row], Row | None] | None:
    """The short way for rows whose columns are numbers within bounds; None for others. A mission of 100
    robots has 360 of them, and all of the fleet read it at once."""
    assert field.row is not None
    is_plain = all(each.kind is float or None not in each.bounds for each in declared(field.row))
    return _rows_taker(field) if is_plain else None


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
