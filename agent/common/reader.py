"""Reads valid values from the tables of a TOML file, and collects every problem on the way (PURE).

`Reader` walks a raw table against a model (`agent.common.settings`). It never stops at the first problem:
what is wrong is collected as `Problem`s, what is right is returned, so that checks across fields still run.
Positions in arrays are counted from 1 in every place (``robot[1]`` is the first ``[[robot]]``).
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin

from handfast.agent.common.quantities import UNITS, Unit, quantity
from handfast.agent.common.settings import Entry, Sectioned, Setting, entries
from handfast.agent.common.wording import describe, did_you_mean, example, joined, key_text, printable, show

# What would move a terminal's cursor or turn the direction of writing.
_CONTROL: Final = re.compile("[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_LINES_CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_INVALID: Final = object()  # what a value that has a problem reads as

_POSITION = re.compile(r"\[\d+\]")
_ENTRY = re.compile(r"\[\d+\]|\.\d+(?=\.)")  # of an array, in a file or after --set

_SUGGESTIONS_MAX = 100  # nearest names are slow to find: a file of rubbish does not get one for each line


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing to correct: where (``control.kp``, ``robot[3].mass_kg``, ``--set control.kp``), and what."""

    place: str
    message: str

    def __str__(self) -> str:
        return f"{self.place}: {self.message}" if self.place else self.message


def _branch(hint: Any, raw: object) -> Any:
    """Return the part of a union that `raw` may be: an array, or not. Return any other type as it is."""
    if get_origin(hint) not in (Union, UnionType):
        return hint
    is_array = isinstance(raw, (list, tuple))
    return next((arg for arg in get_args(hint) if (get_origin(arg) is tuple) == is_array), hint)


class Reader:
    """Reads one document of model `root`, and keeps every problem it meets.

    `override` first, for each ``--set``; then `read`, whose result (attribute -> value, nested tables as
    dicts, arrays of tables as lists of dicts) holds only what is valid: a value with a problem is absent,
    and an element of an array with a problem is None. `build` makes the models when there is no problem.

    Args:
        replaced: fields that no longer exist, by place without positions, and what replaced each; `robot`
            stands for `robot_defaults` as well.

    Attributes:
        sections: tables of plugins that a model, or one derived from it, may hold besides its own.
        is_recorded: the document is of a former drive: fields that no longer exist are no problem.
        unread: models of which not all such tables are known: an unknown one is no problem there.
    """

    def __init__(self, root: type, replaced: Mapping[str, str] | None = None) -> None:
        self._root, self._replaced = root, replaced or {}
        self.sections: Mapping[type, Sequence[Entry]] = {}
        self.unread: frozenset[type] = frozenset()
        self.is_recorded = False
        self._problems: list[Problem] = []
        self._overridden: dict[str, str] = {}  # place in the file -> how the command line names it
        self._suggestions = 0

    @property
    def problems(self) -> tuple[Problem, ...]:
        """All problems so far; those of a value that ``--set`` gave are placed there, not in the file."""
        return tuple(Problem(self._blamed(problem.place), problem.message) for problem in self._problems)

    def entries(self, model: type) -> Mapping[str, Entry]:
        """Everything that a table of this model may hold in this document, by key."""
        own = entries(model)
        added = [e for holder, held in self.sections.items() if issubclass(model, holder) for e in held]
        return {**own, **{entry.key: entry for entry in added}} if added else own

    @property
    def bad(self) -> set[str]:
        """Places of the file with a problem, whoever gave the value."""
        return {problem.place for problem in self._problems}

    def add(self, place: str, message: str) -> None:
        """Adds one problem at a place of the file."""
        self._problems.append(Problem(place, message))

    def overridden(self, place: str) -> bool:
        """Whether ``--set`` gave this place, or a table around it."""
        return self._blamed(place) != place

    def _blamed(self, place: str) -> str:
        for start in sorted(self._overridden, key=len, reverse=True):
            if place == start or place.startswith((start + ".", start + "[")):
                return self._overridden[start] + place[len(start) :]
        return place

    def read(self, raw: Mapping[str, Any]) -> dict[str, Any]:
        """The valid part of a document."""
        return self._table(self._root, raw, "")

    def _table(
        self, model: type, raw: Mapping[str, Any], place: str, inherited: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        known = self.entries(model)
        for key in raw:
            if key not in known:
                self._unknown(model, str(key), joined(place, key), raw[key])
        values: dict[str, Any] = {}
        shared: dict[str, Any] = {}
        for entry in known.values():
            here = joined(place, entry.key)
            if entry.table is not None:
                handed = None if inherited is None else inherited.get(entry.attribute)
                value = self._sub_table(entry, entry.table, raw, here, handed)
            elif inherited is not None and entry.attribute in inherited and entry.key not in raw:
                value = inherited[entry.attribute]
            elif entry.tables is not None and entry.setting.named is not None:
                value = self._named(entry, entry.tables, raw, here)
            elif entry.tables is not None:
                value = self._rows(entry, entry.tables, raw, here, shared)
            elif entry.key in raw:
                value = self._value(entry.hint, raw[entry.key], here, entry.setting, entry.default)
            elif entry.required:
                given = example(entry.hint, entry.setting)
                self.add(here, f"is missing: write for example {entry.key} = {given}")
                value = _INVALID
            else:
                value = self.default(entry, here)
            if not entry.attribute:
                shared = self._handed_down(entry.hint, value)
            elif value is not _INVALID:
                values[entry.attribute] = value
        return values

    def _sub_table(
        self,
        entry: Entry,
        model: type,
        raw: Mapping[str, Any],
        place: str,
        inherited: Any,
    ) -> Any:
        """The table's values. `inherited`: those of the table of defaults, None where it has none."""
        if entry.key not in raw:
            if inherited is _INVALID:
                return _INVALID  # its problem is reported where the defaults are
            if entry.optional and inherited is None:
                return None
        value, header = raw.get(entry.key, {}), f"[{_POSITION.sub('', place)}]"
        if not isinstance(value, Mapping):
            self.add(place, f"must be a table: write {header} and its fields below it, got {show(value)}")
            return _INVALID
        handed = inherited if isinstance(inherited, Mapping) else None
        needs = [e.key for e in self.entries(model).values() if e.required]
        if needs and entry.key not in raw and handed is None:
            self.add(place, f"table {header} is missing: it must give at least {' and '.join(needs)}")
            return _INVALID
        return self._table(model, value, place, handed)

    def default(self, entry: Entry, place: str) -> Any:
        """What a field is that nobody gave: its default, read as if the file gave it."""
        if entry.setting.parse is not None or (entry.default is None and entry.optional):
            return entry.default
        return self._value(entry.hint, entry.default, place, entry.setting)

    def complete(self, entry: Entry, values: dict[str, Any], place: str) -> None:
        """Puts a table that nobody gave into valid values, as if it stood there empty."""
        if entry.table is not None and values.get(entry.attribute, _INVALID) is None:
            here = joined(place, entry.key)
            value = self._sub_table(replace(entry, optional=False), entry.table, {}, here, None)
            if value is not _INVALID:
                values[entry.attribute] = value

    def _rows(
        self, entry: Entry, model: type, raw: Mapping[str, Any], place: str, shared: Mapping[str, Any]
    ) -> Any:
        rows = raw.get(entry.key, [])
        if not isinstance(rows, (list, tuple)):
            double = f"[[{place}]]"
            self.add(place, f"must be an array of tables: write {double} above each entry, got {show(rows)}")
            return _INVALID
        if entry.required and not rows:
            self.add(place, f"there must be at least one [[{place}]]")
            return _INVALID
        values = []
        for number, row in enumerate(rows, 1):
            here = f"{place}[{number}]"
            if isinstance(row, Mapping):
                values.append(self._table(model, row, here, shared))
            else:
                self.add(here, f"must be a table, [[{place}]] with its fields below it, got {show(row)}")
                values.append({})
        return values

    def _named(self, entry: Entry, model: type, raw: Mapping[str, Any], place: str) -> Any:
        """Tables by name, in the file's order; each with its name as the attribute that is to hold it."""
        tables = raw.get(entry.key, {})
        if not isinstance(tables, Mapping):
            self.add(place, f"must be tables: write [{place}.NAME] above each, got {show(tables)}")
            return _INVALID
        named = entry.setting.named
        assert named is not None
        values = []
        for name, table in tables.items():
            here = joined(place, name)
            if not isinstance(table, Mapping):
                self.add(here, f"must be a table, [{here}] with its fields below it, got {show(table)}")
                continue
            right = self._string(str(name), here, entries(model)[named].setting)
            if named in table:
                self.add(joined(here, named), "unknown field: the name stands in the table's own, " + here)
            rest = {key: value for key, value in table.items() if key != named}
            row = self._table(model, rest, here, {named: name})
            values.append(row if right is not _INVALID else {**row, named: None})
        return values

    def _value(self, hint: Any, raw: object, place: str, said: Setting, default: object = None) -> Any:
        """A field's value, or `_INVALID` after adding what is wrong with it."""
        if said.parse is not None:
            try:
                return said.parse(raw)
            except ValueError as error:
                self.add(place, printable(str(error)))
                return _INVALID
        hint = _branch(hint, raw)
        unit = UNITS.get(said.unit or "") if hint is float else None
        if get_origin(hint) is Literal:
            return self._option(hint, raw, place)
        if get_origin(hint) is tuple and isinstance(raw, (list, tuple)):
            return self._array(hint, raw, place, said)
        if hint is bool and isinstance(raw, bool):
            return raw
        if hint is str and isinstance(raw, str):
            return self._string(raw, place, said)
        if hint in (int, float) and isinstance(raw, (int, float)) and not isinstance(raw, bool):
            return self._number(hint, raw, place, said)
        if isinstance(raw, str) and unit is not None:
            return self._quantity(raw, place, said, unit)
        wanted = f"must be {describe(hint, said.unit)}, such as {example(hint, said, default)}"
        wanted += "" if unit is None else f" or {show(unit.example)}"
        self.add(place, f"{wanted}, got {show(raw)}")
        return _INVALID

    def _option(self, hint: Any, raw: object, place: str) -> Any:
        for option in get_args(hint):
            if option == raw and isinstance(option, bool) is isinstance(raw, bool):  # true is not 1
                return option
        spelled = {str(option): show(option) for option in get_args(hint)}
        question = self._did_you_mean(raw, spelled, spelled.__getitem__) if isinstance(raw, str) else ""
        self.add(place, f"must be {describe(hint)}, got {show(raw)}{question and f'; {question}'}")
        return _INVALID

    def _array(self, hint: Any, raw: Sequence[Any], place: str, said: Setting) -> Any:
        args = get_args(hint)
        if args[-1] is not Ellipsis and len(raw) != len(args):
            self.add(place, f"must be {describe(hint, said.unit)}, got {len(raw)}: {show(raw)}")
            return _INVALID
        item = args[0]
        # Without the example, which is one of the whole array.
        inner = Setting("", said.unit, said.gt, said.ge, said.lt, said.le)
        got = [self._value(item, value, f"{place}[{number}]", inner) for number, value in enumerate(raw, 1)]
        if args[-1] is Ellipsis:
            return tuple(None if value is _INVALID else value for value in got)
        return _INVALID if any(value is _INVALID for value in got) else tuple(got)

    def _string(self, raw: str, place: str, said: Setting) -> Any:
        if any("\ud800" <= c <= "\udfff" for c in raw):  # from a shell argument that is not UTF-8
            self.add(place, f"must be text in UTF-8, got {show(raw)}")
        elif said.pattern is not None and not re.fullmatch(said.pattern, raw):
            self.add(place, f"must be {said.pattern_says}, got {show(raw)}")
        elif (_LINES_CONTROL if said.lines else _CONTROL).search(raw):  # what prints it need not look again
            self.add(place, f"must be text without control characters, got {show(raw)}")
        else:
            return raw
        return _INVALID

    def _number(self, hint: Any, raw: float, place: str, said: Setting, written: object = None) -> Any:
        shown = show(raw if written is None else written)
        if hint is int and not isinstance(raw, int):
            self.add(place, f"must be a whole number, such as {example(int, said)}, got {shown}")
            return _INVALID
        try:
            value = raw if hint is int else float(raw) + 0.0  # + 0.0: -0.0 and 0.0 must be written alike
        except OverflowError:
            value = math.inf
        if not isinstance(value, int) and not math.isfinite(value):
            self.add(place, f"must be a finite number, got {shown}")
        elif not said.admits(value):
            unit = f" {said.unit}" if said.unit and said.unit != "ratio" else ""
            degrees = '; degrees are written "90deg"' if said.unit == "rad" else ""
            self.add(place, f"must be {said.range_text()}{unit}, got {shown}{degrees}")
        else:
            return value
        return _INVALID

    def _quantity(self, raw: str, place: str, said: Setting, unit: Unit) -> Any:
        try:
            value = quantity(raw, said.unit or "")
        except ValueError:
            value = None
        if value is None or raw.strip()[-1:] in "0123456789.":  # text without a unit may mean any unit
            spelled = f"a string such as {show(unit.example)} (units: {', '.join(unit.suffixes)})"
            self.add(place, f"must be {describe(hint=float, unit=said.unit)} or {spelled}, got {show(raw)}")
            return _INVALID
        return self._number(float, value, place, said, raw)

    def _unknown(self, model: type, key: str, place: str, value: object = None) -> None:
        former = _ENTRY.sub("", place.removeprefix("--set ")).replace("_defaults.", ".", 1)
        if (table := former.partition(".")[0]) in ("host", "order"):  # a name or a number stands between
            former = f"{table}.{key}"
        if former in self._replaced and self.is_recorded:
            return
        if former in self._replaced:
            self.add(place, f"is no field any more: {self._replaced[former]}")
            return
        names = list(self.entries(model))
        is_section = isinstance(value, Mapping) and issubclass(model, Sectioned)
        kind = "table" if model is self._root or is_section else "field"
        elsewhere = [home for e in entries(self._root).values() for home in self._homes(e, key)]
        question = self._did_you_mean(key, names)
        if is_section and issubclass(model, tuple(self.unread)):
            return
        if elsewhere:
            homes = " or ".join(f"[{name}]" for name in elsewhere)
            here = f"; here, {question}" if question else ""
            self.add(place, f"unknown {kind}; {key} belongs in {homes}{here}")
        elif question:
            self.add(place, f"unknown {kind}; {question}")
        elif is_section:
            self.add(place, f"unknown {kind}: no plugin that is used here has one of this name")
        else:
            self.add(place, f"unknown {kind}; known here: {', '.join(names)}")

    def _did_you_mean(self, name: str, names: Iterable[str], spelled: Callable[[str], str] = str) -> str:
        self._suggestions += 1
        return did_you_mean(name, names, spelled) if self._suggestions <= _SUGGESTIONS_MAX else ""

    def override(self, raw: dict[str, Any], text: str) -> None:
        """Puts one ``table.field=value`` of the command line into the raw document, before it is read.

        The value is read as TOML and, failing that, taken as a bare string. Entries of an array of tables are
        addressed by their ``id`` or ``name``: ``robot.3.mass_kg=12``.
        """
        path, equals, written = text.partition("=")
        keys = [key.strip() for key in path.split(".")]
        label = f"--set {show(path.strip(), 80)[1:-1]}"
        if not equals or not all(keys):
            self.add(label, "must be written as table.field=value, such as control.kp=1")
            return
        model, node, place = self._root, raw, ""
        while keys:
            key = keys.pop(0)
            entry = self.entries(model).get(key)
            if entry is None:
                self._unknown(model, key, label, {} if keys else None)
                return
            place = joined(place, key)
            if not keys:
                node[key] = _override_value(entry, written)
                self._overridden[place] = label
                return
            inside = entry.table or entry.tables
            if inside is None:
                self.add(label, f"{place} is a single value: nothing can follow it but =value")
                return
            if entry.setting.named is not None:
                name = keys.pop(0)
                place = joined(place, name)
                row = node.setdefault(key, {})
                row = row.setdefault(name, {}) if isinstance(row, dict) else row
            elif entry.tables is not None:
                row, place = self._row(node.get(key, []), keys.pop(0), place, label)
            else:
                row = node.setdefault(key, {})
            if not isinstance(row, dict):
                return  # reported by _row, or by read(): the file has no table there
            model, node = inside, row
        first = next(iter(self.entries(model)))
        self.add(label, f"names an entry, not a field of it: write for example {label[6:]}.{first}=value")

    def _row(self, rows: Any, wanted: str, place: str, label: str) -> tuple[Any, str]:
        if not isinstance(rows, list):
            return None, place
        known = [row.get("id", row.get("name")) for row in rows if isinstance(row, dict)]
        for number, row in enumerate(rows, 1):
            name = row.get("id", row.get("name")) if isinstance(row, dict) else None
            if name is not None and str(name) == wanted:
                return row, f"{place}[{number}]"
        there_are = show([name for name in known if name is not None], 80)[1:-1] or "none"
        self.add(label, f"there is no {place} with id {key_text(wanted)}; ids are {there_are}")
        return None, place

    def _homes(self, entry: Entry, key: str, above: str = "") -> Iterable[str]:
        """Names of the tables, from this one down, that may hold `key`."""
        model, name = entry.table or entry.tables, above + entry.key
        if model is not None:
            if key in self.entries(model):
                yield name
            for inside in self.entries(model).values():
                yield from self._homes(inside, key, name + ".")

    def _handed_down(self, model: type, values: Any) -> dict[str, Any]:
        """What entries of an array inherit of their table of defaults.

        `_INVALID` for what had a problem there. Else they would take the model's own default for it, and be
        blamed for what nobody wrote.
        """
        given = values if isinstance(values, Mapping) else {}
        handed: dict[str, Any] = {}
        for entry in self.entries(model).values():
            value = given.get(entry.attribute, _INVALID)
            nested = entry.table is not None and isinstance(value, Mapping)
            handed[entry.attribute] = self._handed_down(entry.hint, value) if nested else value
        return handed


def _override_value(entry: Entry, written: str) -> object:
    text = written.strip()
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):  # ValueError: also an integer with too many digits
        return text
    if set(parsed) != {"value"}:  # more lines than one
        return text
    value = parsed["value"]
    # fleet.name=42 means the name "42"; where options are texts so does 42, unless it is an option itself.
    options = get_args(entry.hint) if get_origin(entry.hint) is Literal else ()
    wants_text = entry.hint is str or (value not in options and any(isinstance(o, str) for o in options))
    return value if isinstance(value, str) or not wants_text else text
