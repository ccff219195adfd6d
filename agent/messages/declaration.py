"""How a message is declared: one class, whose fields say all that is to be known of them (PURE).

A message is a `NamedTuple`; its fields stand in the order of the wire, each with its type and an `About`::

    class Wrench(NamedTuple):
        force: Annotated[float, About("Force asked for, along the heading", "N")]

A field is a number, a truth value or a text; rows, ``tuple[Row, ...]`` of another such class, or numbers or
texts one after the other, ``tuple[Annotated[int, About(...)], ...]``. Rows of a message that comes at every
tick may be bare tuples, which take half the time: their class then stands in `About.row`. Validation, codec,
and the JSON schemas and tables of recordings are made of `declared`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Final, get_args, get_origin, get_type_hints

REQUIRED: Final = object()
"""As `About.before`: recordings of all versions have the field."""
SCALARS: Final = (int, float, bool, str)
FLOAT_MAX: Final = 1e15
"""No position, speed, force or multiplier of a robot is larger; below it the law's arithmetic is safe."""


@dataclass(frozen=True, slots=True)
class About:
    """What is declared of a field beside its name and type.

    Attributes:
        doc: what it is, for people.
        unit: SI, "" where it has none.
        least, most: bounds of a number, both allowed; a float has at least those of `FLOAT_MAX`.
        choices: all that a text may be; of an integer, what its values from 0 on stand for.
        characters: most of a text that must be printable and not empty; 0: any text.
        rows: most rows; 0: as many as fit.
        row: class that declares the columns of rows that are bare tuples.
        before: what stands for it in a recording from before it was added, or a function from the JSON
            object to that.
        omitted: left out on the wire while it and all that follow it, which are so too, are empty or 0.
    """

    doc: str
    unit: str = ""
    least: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()
    characters: int = 0
    rows: int = 0
    row: type[tuple[Any, ...]] | None = None
    before: Any = REQUIRED
    omitted: bool = False

    def of(self, doc: str, **changes: Any) -> About:
        """The same of another field."""
        return replace(self, doc=doc, **changes)

    @property
    def text(self) -> str:
        """What it is and in which unit."""
        return f"{self.doc}, {self.unit}" if self.unit else self.doc


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message, or one column of its rows.

    Attributes:
        kind: int, float, bool or str; `object` for any value of a fleet file; tuple for rows.
        row: class of its rows, or None.
        item: what each is where the rows are single values, or None.
    """

    name: str
    kind: type
    about: About
    row: type[tuple[Any, ...]] | None = None
    item: Field | None = None

    @property
    def named(self) -> bool:
        """Whether its rows are of their class, and no bare tuples."""
        return self.row is not None and self.about.row is None

    @property
    def bounds(self) -> tuple[float | None, float | None]:
        """Least and most, both allowed."""
        if self.kind is int and self.about.choices:
            return 0, len(self.about.choices) - 1
        limit = FLOAT_MAX if self.kind is float else None
        least = self.about.least if self.about.least is not None else limit and -limit
        return least, self.about.most if self.about.most is not None else limit


_known: Final[dict[type, tuple[Field, ...]]] = {}


def declared(cls: type[tuple[Any, ...]]) -> tuple[Field, ...]:
    """The fields of a message or of a row, in the order of the wire.

    Raises:
        TypeError: a field is not declared as it should be.
    """
    if cls not in _known:
        hints = get_type_hints(cls, include_extras=True)
        _known[cls] = tuple(_field(name, hint) for name, hint in hints.items())
    return _known[cls]


def _field(name: str, hint: Any) -> Field:
    if get_origin(hint) is not Annotated or not isinstance(hint.__metadata__[0], About):
        raise TypeError(f"{name} says nothing of itself: declare it as Annotated[..., About(...)]")
    kind, about = hint.__origin__, hint.__metadata__[0]
    if kind in SCALARS:
        return Field(name, kind, about)
    if kind is Any or kind is object:
        return Field(name, object, about)
    item, *rest = get_args(kind)
    if get_origin(kind) is not tuple or rest != [Ellipsis]:
        raise TypeError(f"{name} is {kind}: no message can hold that")
    if get_origin(item) is Annotated:
        return Field(name, tuple, about, item=_field(name, item))
    return Field(name, tuple, about, row=about.row or item)
