"""A scenario that fails, made smaller: parts are left out for as long as what was violated still is.

Zeller's delta debugging, over the parts of a fleet file instead of over lines: orders, rules, obstacles,
robots with all that names them, settings, time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from copy import deepcopy
from typing import Any, Final

from agent.fleet.model import FleetError
from deploy.chaos.dice import Tables
from deploy.chaos.run import CRASH, Outcome, drive, scenario_text
from deploy.simulate.worker_pool import GoOn

RUNS_MAX: Final = 120
LISTS: Final = (("order",), ("faults", "rule"), ("obstacle",))
_SETTINGS: Final = ("control", "robot_defaults", "supervision", "avoidance", "faults", "formation", "fleet")
_NEEDED: Final = ("name", "edges", "offsets", "safe_distance_m", "rule", "duration_s")
_AFTER_S: Final = 0.5
"""A shorter drive ends so long after what was violated."""
_CALM: Final = {"kind": "hold"}


def shrink(tables: Tables, first: Outcome, go_on: GoOn, runs_max: int = RUNS_MAX) -> tuple[Tables, Outcome]:
    """The smallest scenario that was found within so many runs, and what came of it.

    Args:
        tables: a scenario in which something is violated.
        first: what came of that.

    Raises:
        deploy.simulate.worker_pool.Abandoned: `go_on` said no.
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
        """Drives a candidate; True when it is as bad, and then it is the smallest so far."""
        if self.left <= 0 or candidate == self.tables:
            return False
        self.left -= 1
        try:
            outcome = drive(scenario_text(candidate), self._go_on)
        except (FleetError, ValueError):
            return False  # not a scenario
        if self._wanted not in outcome.oracles or not outcome.oracles <= self._known | {self._wanted}:
            return False  # another fault is another scenario
        if self._wanted == CRASH and outcome.violations[0].message != self.outcome.violations[0].message:
            return False
        self.tables, self.outcome = candidate, outcome
        return True

    # ------------------------------------------------------------------ what is left out

    def shorten(self) -> None:
        """Ends the drive soon after what was violated."""
        found = [each.t_s for each in self.outcome.violations if each.oracle == self._wanted]
        end_s = round(min(found) + _AFTER_S, 1)
        if 0.5 < end_s < self.tables["fleet"]["duration_s"] - 0.2:
            candidate = deepcopy(self.tables)
            candidate["fleet"]["duration_s"] = end_s
            self._try(candidate)

    def leave_out(self, path: tuple[str, ...]) -> None:
        """Leaves out entries of an array of tables: all, halves, and so on down to single ones."""
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
        """Leaves out robots, one at a time, with all that names them."""
        for robot in [row["id"] for row in self.tables["robot"]]:
            if len(self.tables["robot"]) > 1:
                self._try(_tidied(without_robot(self.tables, robot)))

    def without_settings(self) -> None:
        """Settings that are left out have their defaults."""
        if "geofence" in self.tables:
            self._try({key: value for key, value in self.tables.items() if key != "geofence"})
        for table in _SETTINGS:
            for key in list(self.tables.get(table, ())):
                if key not in _NEEDED:
                    candidate = deepcopy(self.tables)
                    del candidate[table][key]
                    self._try(_tidied(candidate))

    def calm(self) -> None:
        """The formation stays where it is."""
        self._try({**self.tables, "trajectory": dict(_CALM)})


def _entries(tables: Tables, path: tuple[str, ...]) -> list[Tables]:
    found: Any = tables
    for key in path:
        found = found.get(key, {} if key != path[-1] else [])
    entries: list[Tables] = found
    return entries


def _tidied(tables: Tables) -> Tables:
    """Without tables that have nothing left in them."""
    if not tables.get("faults", {}).get("rule", True):
        del tables["faults"]["rule"]
    return {key: value for key, value in tables.items() if value not in ({}, [])}


# --- without a robot ------------------------------------------------------------------------------


def without_robot(tables: Tables, robot: int) -> Tables:
    """The tables without a robot, its place, its edges, and what is ordered of it or done to it."""
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
            # Its places are those of the members of then, which other orders may have changed.
            if "offsets" in order["formation"]:
                continue
            edges = [edge for edge in order["formation"].get("edges", ()) if robot not in edge]
            if not edges:
                continue
            order["formation"]["edges"] = edges
        yield order


def _names(rule: Tables, robot: int) -> bool:
    """Whether a rule is about a robot; one about all of them, or about groups, is not."""
    if rule.get("robot") == robot:
        return True
    text = f"{rule.get('link', '')} {rule.get('partition', '')}"
    return re.search(rf"\b{robot}\b", text) is not None
