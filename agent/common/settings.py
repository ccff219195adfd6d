"""Settings: descriptions of a model's fields, for whoever reads or documents a file (PURE).

A model is a frozen dataclass whose fields carry what a user needs to know of them::

    kp: float = setting(1.0, "Stiffness of an edge", unit="1/s2", ge=0)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache, reduce
from operator import or_
from types import NoneType, UnionType
from typing import Any, Final, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")
S = TypeVar("S", bound="Sectioned")

Sections = tuple[tuple[str, Any], ...]
"""Tables of plugins that a model holds: name and model of each."""

_METADATA: Final = "setting"


@dataclass(frozen=True, slots=True)
class Setting:
    """Description of a field beyond its type and default. Bounds hold for every number in it."""

    doc: str
    unit: str | None = None
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    key: str | None = None  # name in the file, where it is not the attribute's
    required: bool = False  # the file must give it although the class has a default
    pattern: str | None = None  # of a string, matched in full
    pattern_says: str = ""  # the pattern in words: "must be ..."
    lines: bool = False  # of a string that may have several lines
    example: str | None = None  # TOML text of a value
    shared: tuple[str, type] | None = None  # array of tables: key and model of the table of defaults
    parse: Callable[[object], object] | None = None  # reads the value; ValueError says what is right
    named: str | None = None  # tables by name, [key.NAME]: attribute of the model that holds the NAME
    sections: Callable[[], Iterable[Entry]] | None = None  # the field `sections`: those that are built in

    def range_text(self) -> str:
        """The bounds in words, empty when there are none."""
        if self.ge is not None and self.le is not None:
            return f"between {_bound(self.ge)} and {_bound(self.le)}"
        bounds = (("more than", self.gt), ("at least", self.ge), ("less than", self.lt), ("at most", self.le))
        return " and ".join(f"{words} {_bound(bound)}" for words, bound in bounds if bound is not None)

    def admits(self, value: float) -> bool:
        """Whether a finite number is within the bounds."""
        return (
            (self.gt is None or value > self.gt)
            and (self.ge is None or value >= self.ge)
            and (self.lt is None or value < self.lt)
            and (self.le is None or value <= self.le)
        )


def _bound(value: float) -> str:
    return str(int(value)) if value == int(value) else f"{value:.6g}"


def about(doc: str, **rest: Any) -> dict[str, Setting]:
    """Metadata of a field, for ``field(metadata=about(...))``; arguments as `Setting`'s."""
    return {_METADATA: Setting(doc, **rest)}


def setting(default: Any, doc: str, **rest: Any) -> Any:
    """A field with a default and what is said about it; arguments as `Setting`'s.

    A field without a default is written ``field(metadata=about(...))``, so that type checkers see that its
    class cannot be made without it.
    """
    return field(default=default, metadata=about(doc, **rest))


@dataclass(frozen=True, slots=True)
class Entry:
    """One name that a table may hold. `attribute` is empty for a table of defaults, which no model keeps."""

    attribute: str
    key: str
    hint: Any  # the type, without None
    optional: bool  # None allowed, as "not given"
    required: bool
    default: Any  # None when required or optional
    setting: Setting
    is_section: bool = False  # held in the model's `sections`, by its key

    @property
    def table(self) -> type | None:
        """Model of a sub-table, None for anything else."""
        return _model(self.hint) if self.setting.parse is None else None

    @property
    def tables(self) -> type | None:
        """Model of each entry of an array of tables, or of tables by name, None for anything else."""
        args = get_args(self.hint)
        return _model(args[0]) if get_origin(self.hint) is tuple and args[-1] is Ellipsis else None


def _model(hint: Any) -> type | None:
    return hint if isinstance(hint, type) and is_dataclass(hint) else None


def section_entry(name: str, model: type, doc: str) -> Entry:
    """The table `name` that is held in a model's `sections`."""
    return Entry(name, name, model, True, False, None, Setting(doc), is_section=True)


class Sectioned:
    """Base of a model that holds tables of plugins, in a field `sections`."""

    __slots__ = ()
    sections: Sections

    def section(self, model: type[T]) -> T | None:
        """The table of this model, None where it is not given."""
        return next((section for _, section in self.sections if type(section) is model), None)

    def with_section(self: S, section: object) -> S:
        """The same with another table in the place of that of its model."""
        model = type(section)
        held = tuple((name, section if type(old) is model else old) for name, old in self.sections)
        return replace(self, sections=held)  # type: ignore[type-var]  # subclasses are dataclasses


@cache
def entries(model: type) -> Mapping[str, Entry]:
    """Everything a table of this model may hold, by key: own fields first, inherited ones after them."""
    hints = get_type_hints(model)
    inherited = {f.name for base in model.__bases__ if is_dataclass(base) for f in fields(base)}
    found: dict[str, Entry] = {}
    for item in sorted(fields(model), key=lambda f: f.name in inherited):
        said: Setting = item.metadata[_METADATA]
        if said.sections is not None:
            found |= {entry.key: entry for entry in said.sections()}
            continue
        hint, optional = _without_none(hints[item.name])
        default = item.default
        if item.default_factory is not MISSING:
            default = item.default_factory()
        required = said.required or default is MISSING
        key = said.key or item.name
        if said.shared is not None:
            name, shared = said.shared
            doc = f"Defaults for every `[[{key}]]`."
            found[name] = Entry("", name, shared, False, False, None, Setting(doc))
        found[key] = Entry(item.name, key, hint, optional, required, None if required else default, said)
    return found


def _without_none(hint: Any) -> tuple[Any, bool]:
    if get_origin(hint) in (Union, UnionType) and NoneType in get_args(hint):
        rest = tuple(arg for arg in get_args(hint) if arg is not NoneType)
        return reduce(or_, rest), True
    return hint, False
