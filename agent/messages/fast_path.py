"""The short way to check a message, written out of its declaration: Python without loops over fields (PURE).

    python -m handfast.agent.messages.fast_path

prints a module with the fast paths of all messages: `make compiled` makes C of it. Elsewhere that of a class
is made when its first message comes (`taker`). What does not pass there goes the long way
(`agent.messages.validation.examined`), which says what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import takewhile
from typing import Any, Final

from handfast.agent.messages.declaration import FLOAT_MAX, Field, declared
from handfast.agent.messages.types import CLASSES, Faults, Message, Mission

HEAD: Final = 2
"""Version and type come before the fields."""

Row = tuple[Any, ...]
Examined = Callable[[type[Message], Row], Message]
Taker = Callable[[Row, Examined], Message]
"""From an unpacked array, of this version and of the class's number, to the message: what the fast path does
not take, it gives to what goes the long way, which raises where it is no message."""

_HEADER: Final = '''"""Fast paths of all messages, as `agent.messages.fast_path` writes them."""

from __future__ import annotations

from typing import Any, Final

from handfast.agent.messages.declaration import FLOAT_MAX
from handfast.agent.messages.types import {names}

F: Final[float] = FLOAT_MAX
new: Final[Any] = tuple.__new__
'''


def omitted(cls: type[Row]) -> Row:
    """What a message of this class ends with where the wire leaves it out, or nothing: ``((),)``."""
    left_out = tuple(takewhile(lambda field: field.about.omitted, reversed(declared(cls))))
    return tuple(field.kind() for field in reversed(left_out))


def taker(cls: type[Message]) -> Taker:
    """The fast path of a class."""
    take: Taker = _made(_source(cls), cls, *_row_classes(cls))[f"take_{cls.__name__}"]
    return take


@cache
def rows_of_numbers(field: Field) -> Callable[[Row], Row | None] | None:
    """That of rows whose columns are numbers within bounds; None for others. A mission of 100 robots has 360
    of them, and all of the fleet read it at once."""
    assert field.row is not None
    if not all(each.kind is float or None not in each.bounds for each in declared(field.row)):
        return None
    take: Callable[[Row], Row | None] = _made(_rows_source(field, "take_rows"), field.row)["take_rows"]
    return take


def module() -> str:
    """Those of all classes, as the text of a module: its `TAKERS` has them by the numbers of the classes."""
    known = {cls.__name__ for cls in CLASSES} | {row.__name__ for cls in CLASSES for row in _row_classes(cls)}
    takers = ", ".join(f"take_{cls.__name__}" for cls in CLASSES)
    header = _HEADER.format(names=", ".join(sorted(known)))
    return f"{header}\n\n" + "\n\n".join(map(_source, CLASSES)) + f"\n\nTAKERS: Final = ({takers})\n"


def _row_classes(cls: type[Message]) -> list[type[Row]]:
    return [field.row for field in declared(cls) if field.row is not None]


def _made(source: str, *classes: type[Row]) -> dict[str, Any]:
    """What a source defines that knows these classes."""
    names = {"new": tuple.__new__, "F": FLOAT_MAX, "Any": Any} | {cls.__name__: cls for cls in classes}
    exec(source, names)
    return names


def _source(cls: type[Message]) -> str:
    """What defines ``take_CLASS``, and what checks its rows."""
    name, rows, body = cls.__name__, "", ""
    if cls not in (Faults, Mission):  # rare, and with bounds that are no comparison of one number
        for field in declared(cls):
            if field.kind is tuple:
                rows += _rows_source(field, f"take_{name}_{field.name}") + "\n\n"
        rest = omitted(cls)
        for left_out in (rest[first:] for first in range(len(rest) + 1)):
            fields = declared(cls)[: len(cls._fields) - len(left_out)]
            whole = ", ".join(field.name for field in fields)
            body += (
                f"    if len(array) == {HEAD + len(fields)}:\n"
                f"        _, _, {whole} = array\n"
                f"        if {_conditions(fields, name)}:\n"
                f"            return new({name}, ({', '.join([whole, *map(repr, left_out)])}))\n"
            )
    return (
        f"{rows}def take_{name}(array: tuple[Any, ...], examined: Any) -> Any:\n"
        f"{body}    return examined({name}, array[{HEAD}:])\n"
    )


def _conditions(fields: tuple[Field, ...], message: str = "", place: str = "") -> str:
    """Python that is true where no value needs a second look; rows become those of their class.

    Args:
        message: name of the class whose fields these are.
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
            tests.append(f"(not {name} or ({name} := take_{message}_{name}({name})) is not None)")
    return " and ".join(tests)


def _rows_source(field: Field, name: str) -> str:
    """What defines `name`: from a field's rows to those of their class; None for a second look."""
    if field.item is not None:
        conditions = _conditions((field.item,), place="each")
    else:
        assert field.row is not None
        columns = declared(field.row)
        each = _conditions(columns, place="each[{}]")
        conditions = f"type(each) is tuple and len(each) == {len(columns)} and {each}"
    most = f"    if len(rows) > {field.about.rows}:\n        return None\n" if field.about.rows else ""
    made = "rows"
    if field.named:
        assert field.row is not None
        made = f"tuple([new({field.row.__name__}, each) for each in rows])"
    return (
        f"def {name}(rows: tuple[Any, ...]) -> tuple[Any, ...] | None:\n{most}    for each in rows:\n"
        f"        if not ({conditions}):\n            return None\n    return {made}\n"
    )


if __name__ == "__main__":
    print(module(), end="")
