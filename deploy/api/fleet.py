"""Fleets: loaded from a file, a text or a name, changed, checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, wraps
from inspect import signature
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypedDict, TypeVar, Unpack

from handfast.agent.common.errors import Error, packages_named
from handfast.agent.common.wording import did_you_mean
from handfast.agent.fleet import model
from handfast.agent.fleet.loading import (
    add_orders,
    add_scenario,
    fleet_tables,
    parse_fleet,
    read_text,
    to_dict,
)
from handfast.deploy.api.values import Classes, Known, a_path, in_words_of_python, override, own_classes
from handfast.deploy.console.arguments import fleet_path, scenario_path
from handfast.deploy.console.data_files import SCENARIOS, bundled

if TYPE_CHECKING:
    from handfast.deploy.check.finding import Finding

P = ParamSpec("P")
R = TypeVar("R")

_SHOWN_MAX: Final = 8


class Changes(TypedDict, total=False):
    """What can be changed of a fleet by a name of its own, beside its fields.

    law: a preset (`paper`, `edge`, `joint`, `penalty`), a class, ``"package.module:Class"`` or its name.
    plant: a class or the like, for all robots.
    faults: file, text (TOML) or bundled name of a scenario.
    orders: file or text of orders.
    duration: s, or a text such as "2min". seed: of the noise.
    """

    law: str | type
    plant: str | type
    faults: str | Path
    orders: str | Path
    duration: float | str
    seed: int


class Fleet:
    """A fleet file with changes over it. It does not change: `with_` makes another one.

    Attributes:
        source: names it in messages.
        recorded: it is for looking at a drive, and its plugins need not be here.
        settings: everything that is in it, as frozen dataclasses: ``fleet.settings.control.kp``.
    """

    def __init__(
        self,
        text: str,
        source: str,
        overrides: Mapping[str, str] | None = None,
        law: str | None = None,
        classes: Mapping[str, type] | None = None,
        *,
        recorded: bool = False,
    ) -> None:
        self.source, self._text, self._law, self.recorded = source, text, law, recorded
        self._overrides, self._classes = dict(overrides or {}), Classes(classes)
        self._classes.register()
        with in_words_of_python():
            self.settings: model.Fleet = parse_fleet(
                text, source=source, overrides=[*self._overrides.values()], law=law, recorded=recorded
            )

    # --- what can be asked of it -------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self.settings.fleet.name

    @property
    def ids(self) -> tuple[int, ...]:
        """The robots."""
        return self.settings.ids

    @property
    def duration_s(self) -> float:
        return self.settings.fleet.duration_s

    @property
    def seed(self) -> int:
        return self.settings.fleet.seed

    @cached_property
    def resolved(self) -> model.Fleet:
        """`settings` with offsets, edges and distances written out.

        Raises:
            FleetError: the formation contradicts itself.
        """
        from handfast.agent.formation.geometry import resolved

        return resolved(self.settings)

    @property
    def edges(self) -> dict[tuple[int, int], float]:
        """Wanted distances (m) by the two robots of each edge."""
        formation = self.resolved.formation
        lengths = zip(formation.edges or (), formation.distance_m, strict=True)  # type: ignore[arg-type]
        return Known("edge", dict(lengths))

    def __getitem__(self, field: str) -> Any:
        """The value of a field: ``fleet["control.kp"]``, or of one robot ``fleet["robot.2.mass_kg"]``.

        Raises:
            Error: there is no such field, or it has no value.
        """
        value: Any = to_dict(self.settings)
        for key in str(field).split("."):
            if isinstance(value, list):
                value = {str(row.get("id", row.get("name"))): row for row in value if isinstance(row, dict)}
            known = value if isinstance(value, dict) else {}
            if key not in known:
                there = f"; there are {', '.join(map(str, known))}" if known else ""
                raise Error(f"{self.source}: {field} is not given, or is no field{there}")
            value = known[key]
        return value

    def toml(self) -> str:
        """The fleet file as it stands, every field spelled out."""
        if self.recorded:
            return self._text  # with the tables of plugins that are not here
        import tomli_w

        return tomli_w.dumps(to_dict(self.settings))

    def save(self, path: str | Path) -> Path:
        """Writes `toml` to a file; returns its path.

        Raises:
            Error: it cannot be written, or names a law or a plant that is known in this process alone.
        """
        target = a_path(path, "the file")
        if not self.recorded:
            own_classes(self.settings, "a file cannot name")
        try:
            target.write_text(self.toml(), encoding="utf-8")
        except OSError as error:
            raise Error(f"cannot write {path}: {error.strerror or error}") from None
        return target

    # --- other fleets ------------------------------------------------------------------------------

    def with_(
        self,
        changes: Mapping[str, object] | None = None,
        *,
        law: str | type | None = None,
        plant: str | type | None = None,
        faults: str | Path | None = None,
        orders: str | Path | None = None,
        duration: float | str | None = None,
        seed: int | None = None,
    ) -> Fleet:
        """This fleet with changes: values by field, such as ``{"control.kp": 2.0, "faults.delay": "50ms"}``;
        the names are those of `Changes`.

        Raises:
            Error: a change cannot be.
        """
        classes = Classes(self._classes.known)
        if changes is not None and not isinstance(changes, Mapping):
            raise Error(f'changes are given by field, such as {{"control.kp": 2.0}}, got {changes!r}')
        given: dict[str, object] = dict(changes or {})
        if duration is not None:
            given["fleet.duration_s"] = duration
        if seed is not None:
            given["fleet.seed"] = seed
        if plant is not None:
            given |= {f"robot.{robot}.plant": plant for robot in self.ids}
        text = self._text
        if faults is not None or orders is not None:
            text = self._with_tables(faults, orders)
        new = {field: override(field, value, classes) for field, value in given.items()}
        return Fleet(
            text,
            self.source,
            {**{field: each for field, each in self._overrides.items() if field not in new}, **new},
            self._law if law is None else classes.reference(law) if isinstance(law, type) else str(law),
            classes.known,
        )

    def _with_tables(self, faults: str | Path | None, orders: str | Path | None) -> str:
        import tomli_w

        texts: Mapping[str, object] = {"faults": faults, "orders": orders}
        for name, given in texts.items():
            if given is not None and not isinstance(given, (str, PathLike)):
                field = "" if name == "orders" else '; one field is a change: {"faults.delay": "50ms"}'
                raise Error(f"{name} must be a file or a text (TOML), got {given!r}{field}")
        tables = fleet_tables(self._text, self.source)
        if faults is not None:
            is_text = _is_toml(faults)
            path = None if is_text else scenario_path(str(faults))
            add_scenario(
                tables,
                str(faults) if path is None else read_text(path, "scenario"),
                "faults" if path is None else str(path),
            )
        if orders is not None:
            is_text = _is_toml(orders)
            text = str(orders) if is_text else read_text(orders, "file of orders")
            add_orders(tables, text, "orders" if is_text else str(orders))
        return tomli_w.dumps(tables)

    @property
    def text(self) -> str:
        """The fleet file that it began with, with what scenarios and files of orders have added."""
        return self._text

    def register(self) -> None:
        """Makes the classes that its names stand for known in this process, in the place of others."""
        self._classes.register()

    @property
    def overrides(self) -> Mapping[str, str]:
        """The changes by field, as the command line's ``--set`` takes them."""
        return self._overrides

    @property
    def law(self) -> str | None:
        """The law that was asked for, None: the file's."""
        return self._law

    @property
    def classes(self) -> Mapping[str, type]:
        """Laws and plants that are known by these names in this process alone."""
        return self._classes.known

    def __str__(self) -> str:
        """What it will do, as ``handfast check`` tells it."""
        from handfast.deploy.check.description import describe

        return describe(self.settings)

    def __repr__(self) -> str:
        changed = [*([f"law={self._law}"] if self._law else []), *self.overrides.values()]
        shown = ", ".join(changed[:_SHOWN_MAX]) + (", ..." if len(changed) > _SHOWN_MAX else "")
        count = len(self.ids)
        robots = f"{count} robot{'s' * (count != 1)}"
        return f"<Fleet {self.name}: {robots}, {self.duration_s:g} s{', ' if shown else ''}{shown}>"


def names_known(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which takes the names of `Changes`: a `TypeError` for another name is said as its own."""
    given = signature(function).parameters.values()
    known = [*(each.name for each in given if each.kind is not each.VAR_KEYWORD), *Changes.__annotations__]

    @wraps(function)
    def checked(*args: P.args, **named: P.kwargs) -> R:
        for name in named:
            if name not in known:
                hint = did_you_mean(name, known) or f"there are {', '.join(known)}"
                raise TypeError(
                    f"handfast.{function.__name__}() got an unexpected keyword argument {name!r}; {hint}"
                )
        return function(*args, **named)

    return checked


Source = Fleet | str | Path | Mapping[str, Any]
"""A fleet; a file; the name of a bundled fleet; the text of a fleet file; or its tables."""


@names_known
@packages_named("handfast.load")
def load(fleet: Source, changes: Mapping[str, object] | None = None, **named: Unpack[Changes]) -> Fleet:
    """Loads a fleet: a file, the name of a bundled one (`fleets`), the text of one (TOML), or its tables.

    Args:
        changes: values by field, such as ``{"control.kp": 2.0, "robot.1.mass_kg": 12}``. Texts have units:
            ``"50ms"``, ``"90deg"``. Classes stand for themselves.
        named: law, plant, faults, orders, duration, seed (`handfast.Changes`).

    Raises:
        Error: it cannot be loaded, or changed so. `FleetError` has every problem of the file.
    """
    source: object = fleet
    if isinstance(source, Fleet):
        loaded = source.with_() if source.recorded else source
    elif isinstance(source, Mapping):
        import tomli_w

        try:
            loaded = Fleet(tomli_w.dumps(source), "the tables")
        except (TypeError, ValueError) as error:
            if isinstance(error, Error):
                raise
            raise Error(f"the tables are no TOML: {error}") from None
    elif isinstance(source, str) and _is_toml(source):
        loaded = Fleet(source, "the text")
    elif isinstance(source, (str, Path)) and source != "":
        path = fleet_path(str(source))
        loaded = Fleet(read_text(path, "fleet file"), str(path))
    else:
        raise Error(
            "a fleet is a path, the name of a bundled one, a text, tables, or what `load` returned; "
            f"got {type(source).__name__}"
        )
    return loaded.with_(changes, **named) if changes is not None or named else loaded


def _is_toml(text: str | Path) -> bool:
    return isinstance(text, str) and ("\n" in text or "=" in text)


def fleets() -> list[str]:
    """Names of the bundled fleets."""
    return bundled()


def scenarios() -> list[str]:
    """Names of the bundled scenarios of faults."""
    return bundled(SCENARIOS)


class Findings(tuple["Finding", ...]):
    """What `check` found, errors first: a tuple of `Finding`, each with `level`, `place` and `message`."""

    @property
    def errors(self) -> Findings:
        """Those with which it would not work."""
        return Findings(finding for finding in self if finding.level == "error")

    def __str__(self) -> str:
        return "\n".join(map(str, self)) or "nothing to say"

    __repr__ = __str__


@names_known
@packages_named("handfast.check")
def check(fleet: Source, changes: Mapping[str, object] | None = None, **named: Unpack[Changes]) -> Findings:
    """Finds what would go wrong with a fleet, without driving it; arguments and errors as `load`'s."""
    from handfast.deploy.check.check import check

    return Findings(check(load(fleet, changes, **named).settings))


def refuse_errors(fleet: Fleet) -> None:
    """Refuses a fleet that `check` finds errors in.

    Raises:
        Error: with all of them.
    """
    errors = check(fleet).errors
    if errors:
        lines = "\n".join(f"  {finding.place}: {finding.message}" for finding in errors)
        raise Error(f"{fleet.source}: not started (check=False drives all the same):\n{lines}")


def refuse_overload(fleet: Fleet) -> None:
    """Refuses a fleet that this machine does not carry as processes.

    Raises:
        Error: what it carries, and what would fit.
    """
    from handfast.deploy.processes.machine import overload_here

    text = overload_here(fleet.settings)
    if text:
        raise Error(f"{fleet.source}: not started (check=False drives all the same): {text}")
