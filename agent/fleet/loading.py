"""Loading of fleet files: from text to a `Fleet`, and back to tables.

`parse_fleet` turns the text and the command line's overrides into a `Fleet`, or raises one `FleetError` with
every problem of the file and its place. `digest` identifies what all robots must agree on. Scenarios of
faults and files of orders hold some tables of a fleet file and nothing else; live faults and manual orders
are read the same way. PURE except `load_fleet`, which reads the file it is given.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

from handfast.agent.common.models import ModelError, build, plain
from handfast.agent.common.plugins import PluginError
from handfast.agent.common.reader import Problem, Reader
from handfast.agent.common.settings import about
from handfast.agent.common.wording import printable, show
from handfast.agent.fleet import plants
from handfast.agent.fleet.checks import check_fleet
from handfast.agent.fleet.fault_checks import check_faults
from handfast.agent.fleet.fault_rules import FaultsSection
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.fleet.orders import ORDER_FIELDS, OrderSection, check_orders, kinds_by_field
from handfast.agent.fleet.plugin_tables import NAMES_A_PLUGIN, complete, read_plugins
from handfast.agent.fleet.sections import LAWS, REPLACED, TRAJECTORY_FIELDS, ControlSection, load_law


@dataclass(frozen=True, slots=True)
class Scenario:
    """A file of faults, or the text of live ones: the tables of a fleet file, and nothing else."""

    faults: FaultsSection = field(default_factory=FaultsSection, metadata=about("Faults."))


class ScenarioError(ValueError):
    """A scenario that cannot be used; `problems` as a fleet file's."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(map(str, self.problems)))


def parse_scenario(text: str, ids: Sequence[int]) -> FaultsSection:
    """The faults in a TOML text, for a fleet of the robots `ids`.

    Raises:
        ScenarioError: with every problem of the text.
    """
    try:
        raw = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ScenarioError([Problem("", f"not valid TOML: {show(str(error), 200)[1:-1]}")]) from None
    reader = Reader(Scenario, REPLACED)
    values = reader.read(raw)
    check_faults(values.get("faults", {}), ids, reader)
    if reader.problems:
        raise ScenarioError(reader.problems)
    return build(Scenario, values).faults


@dataclass(frozen=True, slots=True)
class _Orders:
    orders: tuple[OrderSection, ...] = field(default=(), metadata=about("Orders.", key="order"))


def read_orders(raw: Mapping[str, Any], ids: Sequence[int]) -> tuple[OrderSection, ...]:
    """The orders in these tables, for a fleet of the robots `ids`.

    Raises:
        handfast.agent.fleet.loading.ScenarioError: with every problem; something else than ``[[order]]`` is
        one.
    """
    reader = Reader(_Orders)
    values = reader.read(raw)
    check_orders(values.get("orders", ()), raw, ids, reader)
    if reader.problems:
        raise ScenarioError(reader.problems)
    return build(_Orders, values).orders


FILE_BYTES_MAX: Final = 1 << 20
"""Largest fleet file, scenario or file of orders."""
_last_digest: tuple[Fleet | None, str] = None, ""
"""The last one that was made, and of which fleet: it takes milliseconds, and a process has one fleet."""


def load_fleet(
    path: str | Path,
    overrides: Sequence[str] = (),
    law: str | None = None,
    scenario: str | Path | None = None,
    orders: str | Path | None = None,
    *,
    recorded: bool = False,
) -> Fleet:
    """Reads and parses a fleet file, with the faults of a scenario file and the orders of another one if they
    are given; see `parse_fleet`.

    Raises:
        FleetError: of one line when a file cannot be read.
    """
    return parse_fleet(
        read_text(path, "fleet file"),
        source=str(path),
        overrides=overrides,
        law=law,
        scenario=None if scenario is None else read_text(scenario, "scenario"),
        scenario_source=str(scenario),
        orders=None if orders is None else read_text(orders, "file of orders"),
        orders_source=str(orders),
        recorded=recorded,
    )


def read_text(path: str | Path, what: str) -> str:
    """The text of a file; `what` names it in messages. `FleetError` of one line when it cannot be read."""
    source = str(path)
    try:
        with open(path, "rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)  # not all of it: it may be endless
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise FleetError(source, [Problem("", f"cannot read the {what}: {reason}")]) from None
    except ValueError:  # a NUL in the path
        raise FleetError(source, [Problem("", f"cannot read the {what}: not a possible file name")]) from None
    if len(data) > FILE_BYTES_MAX:
        raise FleetError(source, [_too_large(what)])
    try:
        return data.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        message = f"a {what} must be text in UTF-8: byte 0x{data[error.start]:02x} on line {line} is not"
        raise FleetError(source, [Problem("", message)]) from None


def parse_fleet(
    text: str,
    *,
    source: str,
    overrides: Sequence[str] = (),
    law: str | None = None,
    scenario: str | None = None,
    scenario_source: str = "the scenario",
    orders: str | None = None,
    orders_source: str = "the orders",
    recorded: bool = False,
) -> Fleet:
    """The fleet that a TOML text describes.

    `source` names the text in messages. `law` is a name of `LAWS`, or a plugin; `overrides` are
    ``table.field=value`` as typed after ``--set``. They win over the law, and the law over the text.
    `scenario` is the text of a file of faults: its rules come before the text's, its other settings win over
    them. `orders` is the text of one of orders, which are added to the text's. Where it is `recorded`, for
    looking at a drive, plugins that are not here are no problem, but their tables are left out. Raises
    `FleetError` with every problem at once (of a text that is not TOML, the one that its parser stops at),
    and nothing else.
    """
    raw = fleet_tables(text, source)
    if scenario is not None:
        add_scenario(raw, scenario, scenario_source)
    if orders is not None:
        add_orders(raw, orders, orders_source)

    reader = Reader(Fleet, REPLACED)
    reader.is_recorded = recorded
    law_problems = _apply_law(raw, law, recorded)
    kind_before = _table(raw, "trajectory").get("kind", "hold")
    # First what says which plugins there are: they say which tables there may be.
    choosing = [text for text in overrides if NAMES_A_PLUGIN.match(text)]
    for override in choosing:
        reader.override(raw, override)
    _apply_named_law(raw, reader)
    read_plugins(raw, reader)
    for override in overrides:
        if override not in choosing:
            reader.override(raw, override)
    _forget_old_kind(raw, kind_before, reader)
    plugin_problems = read_plugins(raw, reader)
    values = reader.read(raw)
    if recorded and plugin_problems:
        plugin_problems.clear()
    elif not reader.problems and not plugin_problems:
        complete(values, reader)
    for problem in plugin_problems:
        reader.add(problem.place, problem.message)
    check_fleet(values, raw, reader)
    problems = (*law_problems, *_with_ids(reader.problems, raw))
    if problems:
        raise FleetError(source, problems)
    try:
        return build(Fleet, values, reader.entries)
    except ModelError as error:
        raise FleetError(source, [*_with_ids(error.args, raw)]) from None


def fleet_tables(text: str, source: str) -> dict[str, Any]:
    """The tables of a TOML text, of which nothing is known yet. `FleetError` when it is not TOML."""
    if len(text) > FILE_BYTES_MAX:
        raise FleetError(source, [_too_large("fleet file")])
    try:
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        raise FleetError(source, [_syntax_problem(error)]) from None
    except RecursionError:
        too_deep = Problem("", "not valid TOML: arrays or tables nested too deeply")
        raise FleetError(source, [too_deep]) from None


def add_scenario(raw: dict[str, Any], text: str, source: str) -> None:
    """Puts the faults of a scenario into the tables of a fleet file.

    Raises:
        FleetError: of `source`, for what is wrong with the scenario.
    """
    added = fleet_tables(text, source)
    try:
        parse_scenario(text, _ids(raw))
    except ScenarioError as error:
        raise FleetError(source, error.problems) from None
    own = raw.setdefault("faults", {})
    if isinstance(own, dict):
        for key, value in added.get("faults", {}).items():
            before = own.get(key, [])
            own[key] = [*value, *before] if isinstance(value, list) and isinstance(before, list) else value


def add_orders(raw: dict[str, Any], text: str, source: str) -> None:
    """Adds the orders of a file of orders to the tables of a fleet file; raises as `add_scenario`."""
    added = fleet_tables(text, source)
    try:
        read_orders(added, _ids(raw))
    except ScenarioError as error:
        raise FleetError(source, error.problems) from None
    own = raw.setdefault("order", [])
    if isinstance(own, list):
        own += added.get("order", [])


def _ids(raw: Mapping[str, Any]) -> list[int]:
    """Ids of the robots of a fleet file of which nothing is known yet."""
    rows = raw.get("robot")
    ids = [row.get("id") for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    return [number for number in ids if isinstance(number, int)]


def _too_large(what: str) -> Problem:
    return Problem("", f"larger than {FILE_BYTES_MAX // 1024} KiB: this is not a {what}")


def _syntax_problem(error: ValueError) -> Problem:
    message = printable(str(error))
    match = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|(end of document))\)", message)
    if match is None:
        return Problem("", f"not valid TOML: {message[:200]}")
    place = match[4] or f"line {match[2]}, column {match[3]}"
    return Problem(place, f"not valid TOML: {match[1]}")


def _table(raw: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = raw.get(key)
    return value if isinstance(value, dict) else {}


def _apply_law(raw: dict[str, Any], law: str | None, recorded: bool = False) -> tuple[Problem, ...]:
    if law is None:
        return ()
    if law not in LAWS and not recorded:
        try:
            load_law(law)
        except PluginError as error:
            return (Problem("--law", str(error)),)
    presets: Mapping[str, Mapping[str, object]] = LAWS.get(law, {"control": {"law": law}})
    for table, preset in presets.items():
        given = raw.setdefault(table, {})
        if isinstance(given, dict):
            given.pop("law", None)
            given.update(preset)
    return ()


def _apply_named_law(raw: dict[str, Any], reader: Reader) -> None:
    """Takes a name of `LAWS` as `control.law`: what it sets wins over the file where ``--set`` gave it."""
    law = _table(raw, "control").get("law")
    if not isinstance(law, str) or law not in LAWS:
        return
    if reader.overridden("control.law"):
        _apply_law(raw, law)
        return
    del raw["control"]["law"]
    for table, preset in LAWS[law].items():
        given = raw.setdefault(table, {})
        if isinstance(given, dict):
            given.update({key: value for key, value in preset.items() if key not in given})


def _forget_old_kind(raw: dict[str, Any], before: object, reader: Reader) -> None:
    """Drops the file's velocity when ``--set trajectory.kind=hold`` turns its line into another kind."""
    trajectory = _table(raw, "trajectory")
    kind = trajectory.get("kind")
    if kind == before or not isinstance(kind, str) or kind not in TRAJECTORY_FIELDS:
        return
    needed, taken = TRAJECTORY_FIELDS[kind]
    for key in set(kinds_by_field()) - {*needed, *taken}:
        if not reader.overridden(f"trajectory.{key}"):
            trajectory.pop(key, None)


def _with_ids(problems: Sequence[Problem], raw: Mapping[str, Any]) -> Iterator[Problem]:
    """``robot[3]`` counts entries: says the id as well where that is another number."""
    rows = raw.get("robot")
    for problem in problems:
        match = re.match(r"robot\[(\d+)\]", problem.place)
        if match is not None and isinstance(rows, list):
            row = rows[int(match[1]) - 1]
            number = row.get("id") if isinstance(row, dict) else None
            if type(number) is int and number != int(match[1]):
                yield Problem(problem.place, f"{problem.message} (the robot with id {show(number)})")
                continue
        yield problem


def law_name(control: ControlSection) -> str:
    """The name in `LAWS` whose coupling and kp these are, or the plugin that is the law, else "custom"."""
    if control.law is not None:
        return control.law
    for name, preset in LAWS.items():
        if all(getattr(control, key) == value for key, value in preset["control"].items()):
            return name
    return "custom"


def to_dict(fleet: Fleet) -> dict[str, Any]:
    """A complete table for a TOML writer: ``parse_fleet`` of what it writes gives an equal `Fleet`."""
    table = plain(fleet)
    table["trajectory"] = _of_kind(table["trajectory"], TRAJECTORY_FIELDS)
    table["order"] = [{"at": row["at"], **_of_kind(row, ORDER_FIELDS)} for row in table["order"]]
    for row in table["order"]:
        if "trajectory" in row:
            row["trajectory"] = _of_kind(row["trajectory"], TRAJECTORY_FIELDS)
    return table


def _of_kind(
    row: Mapping[str, Any], fields: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]
) -> dict[str, Any]:
    """A table without the fields that its kind does not take: to read them would be an error."""
    needed, taken = fields[row["kind"]]
    return {key: value for key, value in row.items() if key in ("kind", *needed, *taken)}


def digest(fleet: Fleet) -> str:
    """16 hex digits over what all robots must agree on.

    That is everything but where and how processes run and how they reach each other, what
    is recorded, and how a vehicle's own computer reaches it.
    """
    global _last_digest
    before, found = _last_digest
    if fleet is not before:
        found = _digest(fleet)
        _last_digest = fleet, found
    return found


def _digest(fleet: Fleet) -> str:
    table = to_dict(fleet)
    for key in ("network", "host", "recording"):
        table.pop(key, None)
    del table["fleet"]["description"]
    for robot in table["robot"]:
        robot.pop("host", None)
        for kind in plants.KINDS.values():
            for key in kind.local:
                robot.get(kind.name, {}).pop(key, None)
    canonical = json.dumps(table, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return blake2b(canonical.encode(), digest_size=8).hexdigest()
