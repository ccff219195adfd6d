"""Orders from what an operator writes on the command line (PURE).

They are made as ``[[order]]`` tables and read as those of a fleet file are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from handfast.agent.common.reader import Problem, Reader
from handfast.agent.common.settings import entries
from handfast.agent.fleet.loading import ScenarioError, read_orders
from handfast.agent.fleet.orders import OrderSection, ShapeSection
from handfast.agent.fleet.sections import TRAJECTORY_FIELDS
from handfast.deploy.console.arguments import InputError

if TYPE_CHECKING:
    from handfast.agent.formation.mission_plan import Plan

OPTIONS: Final = {
    "robot": "--robot",
    "by": "--by",
    "edges": "--edges",
    "distance_m": "--distance",
    "offset_m": "--offset",
    "over_s": "--over",
    "scale": "--scale",
    "robots": "--robot",
}
"""The option that gives each field of an order."""
_ARRAYS: Final = ("edges", "offset_m", "robots")


def order_of_options(
    kind: str, given: Mapping[str, str], ids: Sequence[int], more: Mapping[str, Any] | None = None
) -> OrderSection:
    """The order of a command.

    Args:
        kind: of the order, and name of the command.
        given: by field, what was written after its option (`OPTIONS`).
        ids: the fleet's robots.
        more: tables of the order that are read already.

    Raises:
        InputError: naming the options.
    """
    raw: dict[str, Any] = {"at": 0.0, "kind": kind, **(more or {})}
    reader = Reader(OrderSection)
    for key, written in given.items():
        listed = "," in written or key in _ARRAYS
        reader.override(raw, f"{key}={f'[{written}]' if listed and '[' not in written else written}")
    try:
        return read_orders({"order": [raw]}, ids)[0]
    except ScenarioError as error:
        raise InputError("\n".join(map(_as_option, error.problems))) from None


def _as_option(problem: Problem) -> str:
    key, dot, rest = problem.place.removeprefix("order[1]").removeprefix(".").partition(".")
    name, bracket, index = key.partition("[")
    where = OPTIONS.get(name, name) + bracket + index + dot + rest
    return f"{where}: {problem.message}" if where else problem.message


def shape_tables(
    plan: Plan, overrides: Sequence[str], file: Mapping[str, Any] | None, source: str
) -> dict[str, Any]:
    """``formation`` and ``trajectory`` of a reshaping.

    Args:
        plan: what the fleet does now: fields of the trajectory that are not given stay as they are, those
            of another kind apart; but a line and a hold count from where the formation is.
        overrides: ``formation.field=value`` and ``trajectory.field=value``, as typed after ``--set``.
        file: tables of a fleet file whose formation and trajectory are wanted, if one was given; `source`
            names it in messages.

    Raises:
        InputError: there is nothing of the kind in the file, or an override cannot be.
    """
    from handfast.agent.formation.mission_plan import (
        trajectory_parts,  # here: numpy, which comes with it, takes its time
    )

    tables: dict[str, Any] = {}
    if file is not None:
        known = entries(ShapeSection)
        shape = {key: value for key, value in _table(file, "formation").items() if key in known}
        if shape:
            tables["formation"] = shape
        if _table(file, "trajectory"):
            tables["trajectory"] = dict(_table(file, "trajectory"))
        if not tables:
            raise InputError(f"{source}: has neither [formation] nor [trajectory]")
    paths = [override.partition("=")[0].strip() for override in overrides]
    if any(path.startswith("trajectory.") for path in paths) and "trajectory" not in tables:
        now = dict(trajectory_parts(plan.section))
        if now["kind"] in ("line", "hold"):
            now.pop("start_m", None)
        tables["trajectory"] = now
    reader = Reader(OrderSection)
    for path, override in zip(paths, overrides, strict=True):
        if not path.startswith(("formation.", "trajectory.")):
            raise InputError(
                f"--set {path}: reshape takes formation.offsets, formation.edges, formation.distance_m and "
                "the fields of trajectory"
            )
        reader.override(tables, override)
    if reader.problems:
        raise InputError("\n".join(map(str, reader.problems)))
    if "trajectory.kind" in paths:
        _forget_old_kind(tables["trajectory"], paths)
    return tables


def _forget_old_kind(trajectory: dict[str, Any], paths: Sequence[str]) -> None:
    """Drops what only the kind before took, as in a fleet file."""
    needed, taken = TRAJECTORY_FIELDS.get(str(trajectory["kind"]), ((), ()))
    for key in trajectory.keys() - {"kind", *needed, *taken}:
        if f"trajectory.{key}" not in paths:
            del trajectory[key]


def _table(tables: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = tables.get(key)
    return value if isinstance(value, Mapping) else {}
