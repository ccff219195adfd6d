"""Shrink a scenario that fails: leave parts out as long as the same oracle is still violated.

This is Zeller's delta debugging on the parts of a fleet file instead of lines: orders, rules, obstacles,
robots with everything that names them, settings, time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from copy import deepcopy
from typing import Any, Final

from handfast.agent.fleet.model import FleetError
from handfast.deploy.simulate.worker_pool import GoOn
from tests.chaos.dice import Tables
from tests.chaos.run import CRASH, Outcome, drive
from tests.chaos.text import scenario_text

RUNS_MAX: Final = 120
LISTS: Final = (("order",), ("faults", "rule"), ("obstacle",))
_SETTINGS: Final = ("control", "robot_defaults", "supervision", "avoidance", "faults", "formation", "fleet")
_NEEDED: Final = ("name", "edges", "offsets", "safe_distance_m", "rule", "duration_s")
_AFTER_S: Final = 0.5
"""Time from the violation to the end of a shortened drive."""
_CALM: Final = {"kind": "hold"}


def shrink(tables: Tables, first: Outcome, go_on: GoOn, runs_max: int = RUNS_MAX) -> tuple[Tables, Outcome]:
    """Return the smallest scenario found within `runs_max` drives, and its outcome.

    Args:
        tables: a scenario in which an oracle is violated.
        first: its outcome.

    Raises:
        handfast.deploy.simulate.worker_pool.Abandoned: `go_on` returned False.
    """
    search = _Search(tables, first, go_on, runs_max)
    before = None
    while before != search.tables and search.left:
        before = search.tables
        search.shorten()
        for path in LISTS:
            search.leave_out(path)
        search.without_robots()
        search.without_settings()
        search.calm()
        for path in (("order",), ("faults", "rule")):
            search.leave_out(path)
    return search.tables, search.outcome


class _Search:
    def __init__(self, tables: Tables, first: Outcome, go_on: GoOn, runs_max: int) -> None:
        self.tables, self.outcome = deepcopy(tables), first
        self._go_on, self.left = go_on, runs_max
        self._known = first.oracles
        self._wanted = first.violations[0].oracle

    def _try(self, candidate: Tables) -> bool:
        """Drive a candidate. Keep it and return True if the same oracle is violated in it."""
        if self.left <= 0 or candidate == self.tables:
            return False
        self.left -= 1
        try:
            outcome = drive(scenario_text(candidate), self._go_on)
        except (FleetError, ValueError):
            return False  # not a scenario
        if self._wanted not in outcome.oracles or not outcome.oracles <= self._known | {self._wanted}:
            return False  # a different fault
        if self._wanted == CRASH and outcome.violations[0].message != self.outcome.violations[0].message:
            return False
        self.tables, self.outcome = candidate, outcome
        return True

    def shorten(self) -> None:
        """End the drive soon after the violation."""
        found = [each.t_s for each in self.outcome.violations if each.oracle == self._wanted]
        end_s = round(min(found) + _AFTER_S, 1)
        if 0.5 < end_s < self.tables["fleet"]["duration_s"] - 0.2:
            candidate = deepcopy(self.tables)
            candidate["fleet"]["duration_s"] = end_s
            self._try(candidate)

    def leave_out(self, path: tuple[str, ...]) -> None:
        """Leave out entries of an array of tables: all, halves, and so on down to single ones."""
        size = len(_entries(self.tables, path))
        while size >= 1 and self.left:
            start = 0
            while start < len(_entries(self.tables, path)):
                candidate = deepcopy(self.tables)
                del _entries(candidate, path)[start : start + size]
                if not self._try(_tidied(candidate)):
                    start += size
            size //= 2

    def without_robots(self) -> None:
        """Leave out robots, one at a time, with everything that names them."""
        for robot in [row["id"] for row in self.tables["robot"]]:
            if len(self.tables["robot"]) > 1:
                self._try(_tidied(without_robot(self.tables, robot)))

    def without_settings(self) -> None:
        """Leave out settings, so that they have their defaults."""
        if "geofence" in self.tables:
            self._try({key: value for key, value in self.tables.items() if key != "geofence"})
        for table in _SETTINGS:
            for key in list(self.tables.get(table, ())):
                if key not in _NEEDED:
                    candidate = deepcopy(self.tables)
                    del candidate[table][key]
                    self._try(_tidied(candidate))

    def calm(self) -> None:
        """Have the formation stay where it is."""
        self._try({**self.tables, "trajectory": dict(_CALM)})


def _entries(tables: Tables, path: tuple[str, ...]) -> list[Tables]:
    found: Any = tables
    for key in path:
        found = found.get(key, {} if key != path[-1] else [])
    entries: list[Tables] = found
    return entries


def _tidied(tables: Tables) -> Tables:
    """Return the tables without empty ones."""
    if not tables.get("faults", {}).get("rule", True):
        del tables["faults"]["rule"]
    return {key: value for key, value in tables.items() if value not in ({}, [])}


def without_robot(tables: Tables, robot: int) -> Tables:
    """Return the tables without a robot, its place, its edges, and orders and rules that name it."""
    out = deepcopy(tables)
    formation = out["formation"]
    members = [row["id"] for row in out["robot"] if not row.get("reserve")]
    if robot in members:
        del formation["offsets"][members.index(robot)]
    formation["edges"] = [edge for edge in formation["edges"] if robot not in edge]
    out["robot"] = [row for row in out["robot"] if row["id"] != robot]
    if "order" in out:
        out["order"] = list(_orders_without(out["order"], robot))
    if "faults" in out:
        rules = out["faults"].get("rule", [])
        out["faults"]["rule"] = [rule for rule in rules if not _names(rule, robot)]
    return out


def _orders_without(orders: list[Tables], robot: int) -> Iterator[Tables]:
    for order in orders:
        if robot in (order.get("robot"), order.get("by")):
            continue
        for key in ("edges", "robots"):
            if key in order:
                order[key] = [other for other in order[key] if other != robot]
        if order.get("robots") == []:
            continue
        if "formation" in order:
            # The places are those of the members at that time, which other orders may have changed.
            if "offsets" in order["formation"]:
                continue
            edges = [edge for edge in order["formation"].get("edges", ()) if robot not in edge]
            if not edges:
                continue
            order["formation"]["edges"] = edges
        yield order


def _names(rule: Tables, robot: int) -> bool:
    """Return True if a rule names a robot."""
    if rule.get("robot") == robot:
        return True
    text = f"{rule.get('link', '')} {rule.get('partition', '')}"
    return re.search(rf"\b{robot}\b", text) is not None
