"""A formation whose places somebody drags: what would come of it, and the order for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from handfast.agent.common.quantities import FAR_M
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.mission_plan import Plan
from handfast.agent.messages.types import Mission
from handfast.deploy.check.check import check
from handfast.deploy.orders.mission_editing import OrderError, ordered
from handfast.deploy.orders.operator import NO_MISSION
from handfast.deploy.view.orders import RefusedError, order_of

SAID_MAX: Final = 3
_OF_SHAPE: Final = ("formation", "control", "limits")


def order_to_move(content: Mapping[str, Any], plan: Plan | None, fleet: Fleet) -> OrderSection:
    """The reshaping that moves places `by` so far, {robot: [east, north]} in m, from where `plan` has them.

    Raises:
        RefusedError: there is no mission, or `by` is something else.
    """
    if plan is None:
        raise RefusedError(NO_MISSION)
    by = content.get("by")
    if not isinstance(by, Mapping) or not by:
        raise RefusedError("nothing is moved")
    moved: dict[int, tuple[float, float]] = dict(plan.offsets)
    for name, step in by.items():
        is_number = isinstance(name, str) and len(name) < 10 and name.isascii() and name.isdecimal()
        robot = int(name) if is_number else -1
        is_step = isinstance(step, list) and len(step) == 2 and all(map(_is_length, step))
        if robot not in moved or not is_step:
            raise RefusedError(f"by.{name}: not a member and how far its place moves, [east, north] in m")
        x, y = moved[robot]
        moved[robot] = x + step[0], y + step[1]
    offsets = [[round(x, 4), round(y, 4)] for x, y in (moved[robot] for robot in plan.members)]
    return order_of({"kind": "reshape", "formation": {"offsets": offsets}}, fleet.ids)


def _is_length(value: object) -> bool:
    # A larger int need not fit a float; NaN is not within anything.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FAR_M


def judged(order: OrderSection, plan: Plan, fleet: Fleet, now_ns: int) -> tuple[str, bool]:
    """What would come of a reshaping, in words, and whether it may be ordered. Takes part of a second."""
    try:
        mission = ordered(order, plan, fleet, now_ns, plan.mission.version + 1)
    except OrderError as error:
        return str(error), False
    known = {(each.place, each.message) for each in check(_shaped(fleet, plan.mission))}
    found = [
        each
        for each in check(_shaped(fleet, mission))
        if each.level in ("error", "warning") and (each.place, each.message) not in known
    ]
    over = f"takes {mission.blend_ns / 1e9:.1f} s"
    if not found:
        return f"check finds nothing wrong; {over}", True
    more = f"; and {len(found) - SAID_MAX} more" if len(found) > SAID_MAX else ""
    said = "; ".join(f"{each.level}: {each.message}" for each in found[:SAID_MAX])
    return f"{said}{more}; {over}", not any(each.level == "error" for each in found)


def _shaped(fleet: Fleet, mission: Mission) -> Fleet:
    """`fleet` with the formation of a mission; as it is where that has none of its own."""
    if not mission.robots:
        return replace(fleet, orders=())
    places = {place.robot: (place.x, place.y) for place in mission.robots}
    robots = tuple(replace(robot, reserve=robot.id not in places) for robot in fleet.robots)
    formation = replace(
        fleet.formation,
        offsets=tuple(places[robot.id] for robot in robots if robot.id in places),
        edges=tuple((edge.robot, edge.other) for edge in mission.edges),
        distance_m=tuple(edge.distance for edge in mission.edges),
    )
    return replace(fleet, formation=formation, robots=robots, orders=())
