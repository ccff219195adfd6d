"""A fleet with two robots in reserve, and its plans, for tests of missions and orders."""

from __future__ import annotations

from typing import Any

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import Plan, plan_of
from handfast.agent.messages.types import Mission
from handfast.deploy.orders.mission_editing import first_mission, ordered

S = 1_000_000_000
EPOCH = 1_700_000_000 * S

SQUARE = """
[fleet]
name = "square"

[formation]
edges = [[1, 2], [2, 3], [3, 4], [1, 4], [1, 3]]
offsets = [[0, 0], [1, 0], [1, 1], [0, 1]]
safe_distance_m = 0.2

[trajectory]
kind = "line"
start_m = [5, 6]
velocity_mps = [0.3, 0.1]
"""
for _robot in (1, 2, 3, 4, 7, 8):
    SQUARE += f"\n[[robot]]\nid = {_robot}\nx_m = {_robot}\ny_m = 0\n"
    if _robot > 4:
        SQUARE += "reserve = true\n"


def square(*overrides: str, text: str = SQUARE) -> Fleet:
    return parse_fleet(text, source="square.toml", overrides=overrides)


def first_plan(fleet: Fleet) -> Plan:
    return plan_of(first_mission(fleet, 1, EPOCH - 2 * S, EPOCH, 60 * S), fleet, resolve(fleet))


def order(kind: Any, **fields: Any) -> OrderSection:
    return OrderSection(0.0, kind, **fields)


def after(
    what: OrderSection, plan: Plan, fleet: Fleet, at_s: float = 10.0, version: int | None = None
) -> tuple[Mission, Plan]:
    """The mission and plan after an order that is given `at_s` after the epoch."""
    number = plan.mission.version + 1 if version is None else version
    mission = ordered(what, plan, fleet, EPOCH + round(at_s * S), number)
    return mission, plan_of(mission, fleet, resolve(fleet))
