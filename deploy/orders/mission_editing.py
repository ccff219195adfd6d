"""An operator's order to a fleet that drives, made into its next mission (PURE).

A mission is the whole state that the fleet is to have. So an order is a function of the mission before:
whoever has that can make the next, and robots only ever get missions, never the order itself.

Lengths in m, W; times in ns of the wall clock.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import dist
from typing import Final

import numpy as np

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import show
from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import Fleet, FormationError
from handfast.agent.fleet.orders import ORDER_FIELDS, OrderSection, ShapeSection
from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.mission_plan import (
    Edges,
    Plan,
    PlanError,
    mission_parts,
    trajectory_parts,
    written_plan,
)
from handfast.agent.formation.points import components
from handfast.agent.formation.realisation import DISTANCE_TOLERANCE, realise_near, worst_edge
from handfast.agent.formation.trajectory import make_trajectory
from handfast.agent.links.ticks import next_tick_ns
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Distance, Mission, Place, Removed, clipped
from handfast.agent.messages.validation import Malformed
from handfast.deploy.orders.blend_time import BLEND_MAX_S, blend_ns_for, left_of, reference_at
from handfast.deploy.orders.trilateration import place_apart

LEAD_NS: Final = NS_PER_S
"""From an order to its take-over: time for every robot to get it, also relayed by another one."""


_FROM_THERE: Final = ("line", "hold")
"""Trajectories that count from where the formation is."""


class OrderError(ValueError):
    """An order that cannot be carried out; the text is one sentence that says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Change:
    """What is to hold from the take-over on; `note` says in words what is new. Trajectory None: as it is."""

    offsets: Mapping[int, Vector]
    edges: Sequence[tuple[int, int, float]]
    note: str
    trajectory: TrajectorySection | None = None


def first_mission(fleet: Fleet, version: int, now_ns: int, epoch_ns: int, duration_ns: int) -> Mission:
    """The mission that begins a drive: all is as in the fleet file."""
    return Mission(version, now_ns, epoch_ns, duration_ns, digest(fleet))


def must_be_known(order: OrderSection, plan: Plan) -> tuple[int, ...]:
    """Robots on whose being heard, or not, it depends whether an order can be carried out."""
    if order.kind == "remove":
        return order.robots or ()
    newcomer = _newcomer(order)
    return (newcomer,) if newcomer is not None and newcomer in dict(plan.mission.removed) else ()


def _newcomer(order: OrderSection) -> int | None:
    """Who is to get a place."""
    return {"join": order.robot, "replace": order.by}.get(order.kind)


def ordered(
    order: OrderSection,
    plan: Plan,
    fleet: Fleet,
    now_ns: int,
    version: int,
    lead_ns: int = LEAD_NS,
    heard: Collection[int] | None = None,
) -> Mission:
    """The mission after an order to join, leave, replace, remove or reshape.

    It is taken over on the first tick of the fleet after `lead_ns`, though never before the latest one is.
    What is ordered before the drive begins holds from its begin.

    Args:
        order: its fields for its kind are looked at (`agent.fleet.orders.ORDER_FIELDS`); `at` is not.
        plan: the latest.
        version: of the new mission, greater than any that is known.
        heard: the robots that are heard at the moment; None where nobody can tell, as before a drive.

    Raises:
        OrderError: it cannot be carried out.
    """
    make = _KINDS.get(order.kind)
    if make is None:
        raise OrderError(f'an order of kind "{order.kind}" does not change the mission')
    for name in ORDER_FIELDS[order.kind][0]:
        if getattr(order, name) is None:
            raise OrderError(f"{order.kind} needs {name}")
    if heard is not None:
        _refuse_by_ear(order, plan, heard)
    before = plan.mission
    from_ns = next_tick_ns(now_ns + lead_ns, fleet.period_ns, 0)
    if from_ns <= before.epoch_ns:
        from_ns = before.epoch_ns
    elif from_ns <= plan.from_ns:
        from_ns = next_tick_ns(plan.from_ns, fleet.period_ns, 0)
    change = make(order, plan, fleet)
    section, trajectory_ns = plan.section, plan.trajectory_ns
    if change.trajectory is not None:
        section, trajectory_ns = _from_there(change.trajectory, plan, fleet, from_ns, 0), from_ns
    mission = Mission(
        version,
        now_ns,
        before.epoch_ns,
        before.duration_ns,
        before.digest,
        from_ns,
        0,
        clipped(change.note),
        trajectory_ns,
        trajectory_parts(section),
        tuple(Place(robot, *change.offsets[robot]) for robot in fleet.ids if robot in change.offsets),
        tuple(Distance(*edge) for edge in change.edges),
        _removed(order, before, now_ns),
    )
    after = _sendable(mission, fleet)
    if from_ns == before.epoch_ns:
        return mission

    def within(blend_ns: int) -> Plan:
        if change.trajectory is None or change.trajectory.kind not in _FROM_THERE:
            return after
        moved = _from_there(change.trajectory, plan, fleet, from_ns, blend_ns)
        return replace(after, section=moved, trajectory=make_trajectory(moved))

    blend_ns = blend_ns_for(plan, within, fleet) if order.over_s is None else round(order.over_s * NS_PER_S)
    if blend_ns is None and order.kind in ("leave", "remove"):
        blend_ns = round(BLEND_MAX_S * NS_PER_S)  # nobody else goes elsewhere for it: it is never too late
    if blend_ns is None:
        goes_on = plan.from_ns + plan.blend_ns > from_ns
        raise OrderError(
            f"it needs more than {BLEND_MAX_S:g} s to keep the limits of [control]"
            f"{', by what is left of the change before it' if goes_on else ''}: order it in parts, each when "
            "the one before is over, or say how long it is to take (over_s)"
        )
    there = within(blend_ns)
    mission = mission._replace(
        blend_ns=blend_ns,
        trajectory=trajectory_parts(there.section),
        left=left_of(plan, there, blend_ns, fleet),
    )
    _sendable(mission, fleet)
    return mission


def _sendable(mission: Mission, fleet: Fleet) -> Plan:
    """Its plan; `OrderError` where robots would not drive it, or not even get it."""
    try:
        plan = written_plan(mission, fleet)
        decode(encode(mission))
    except PlanError as error:
        raise OrderError(str(error)) from None
    except Malformed as error:
        raise OrderError(f"the new mission cannot be sent: {error}") from None
    return plan


def _join(order: OrderSection, plan: Plan, fleet: Fleet) -> _Change:
    robot, ends = order.robot, order.edges
    assert robot is not None
    assert ends is not None
    _refuse_newcomer(robot, plan, fleet)
    for k, end in enumerate(ends):
        _refuse_stranger(end, plan, fleet)
        if end in ends[:k]:
            raise OrderError(f"robot {robot} is to share an edge with robot {end} twice")
    anchors = [plan.offsets[end] for end in ends]
    place, distances = order.offset_m, _edge_distances(order, anchors, plan)
    if place is None:
        if not ends:
            raise OrderError(f"where robot {robot} is to be is not known without edges: give offset_m")
        place = place_apart(anchors, distances, list(plan.offsets.values()))
    if place is None:
        wanted = zip(ends, distances, strict=True)
        shown = _listed([f"{distance:.4g} m from robot {end}" for end, distance in wanted])
        raise OrderError(f"no place for robot {robot} is {shown}")
    for end, anchor, distance in zip(ends, anchors, distances, strict=True):
        if abs(dist(place, anchor) - distance) > DISTANCE_TOLERANCE * distance:
            raise OrderError(
                f"robot {robot} at {_point(place)} would be {dist(place, anchor):.4g} m from robot {end}, "
                f"not {distance:.4g} m"
            )
    _, edges, _ = mission_parts(plan)
    edges += tuple((robot, end, distance) for end, distance in zip(ends, distances, strict=True))
    joined = f"{'edges' if len(ends) > 1 else 'edge'} to {_listed(ends)}" if ends else "no edges"
    offsets = {**plan.offsets, robot: place}
    return _Change(offsets=offsets, edges=edges, note=f"robot {robot} joins ({joined})")


def _edge_distances(order: OrderSection, anchors: Sequence[Vector], plan: Plan) -> list[float]:
    """Return the lengths of the edges of a robot that joins, to robots with places at `anchors`."""
    place, given = order.offset_m, order.distance_m
    if isinstance(given, tuple):
        if len(given) != len(anchors):
            raise OrderError(f"distance_m has {len(given)} distances for {len(anchors)} edges")
        return list(given)
    if given is not None:
        return [given] * len(anchors)
    if place is not None:
        return [dist(place, anchor) for anchor in anchors]
    if plan.edges:
        return [sum(plan.edges.values()) / len(plan.edges)] * len(anchors)
    raise OrderError(f"where robot {order.robot} is to be is not known: give offset_m or distance_m")


def _refuse_by_ear(order: OrderSection, plan: Plan, heard: Collection[int]) -> None:
    """Raises an `OrderError` for the body of a robot that is there, and a place for one that is not."""
    named = must_be_known(order, plan)
    loud = [robot for robot in named if robot in heard]
    if order.kind == "remove" and loud:
        who = f"agents of robots {_listed(loud)} are" if len(loud) > 1 else f"agent of robot {loud[0]} is"
        raise OrderError(f"the {who} heard: only the body of one whose agent is silent can be removed")
    if order.kind != "remove" and named and not loud:
        raise OrderError(f"robot {named[0]} has been removed, and is not heard: start its agent again first")


def _removed(order: OrderSection, before: Mission, now_ns: int) -> tuple[Removed, ...]:
    """The rows of bodies that are gone, after an order that is given now.

    One who gets a place again is there. Agents take the latest time of a robot, so a later order has a later
    one, whoever's clock it is by.
    """
    known = dict(before.removed)
    if order.kind == "remove":
        known |= {robot: max(now_ns, known.get(robot, 0) + 1) for robot in order.robots or ()}
    return tuple(Removed(robot, since) for robot, since in sorted(known.items()) if robot != _newcomer(order))


def _leave(order: OrderSection, plan: Plan, fleet: Fleet) -> _Change:
    robot = order.robot
    assert robot is not None
    _refuse_stranger(robot, plan, fleet)
    if len(plan.members) == 1:
        raise OrderError(f"robot {robot} is the last one in the formation: stop the fleet instead")
    return _without([robot], f"robot {robot} leaves", plan)


def _remove(order: OrderSection, plan: Plan, fleet: Fleet) -> _Change:
    robots = order.robots
    assert robots is not None
    if not robots:
        raise OrderError("remove names no robot")
    for robot in robots:
        _refuse_unknown(robot, fleet)
    who = f"robots {_listed(robots)}" if len(robots) > 1 else f"robot {robots[0]}"
    if set(plan.members) <= set(robots):
        raise OrderError(
            f"without {who} nobody is left in the formation: let another take a place first (replace, join), "
            "or stop the fleet instead"
        )
    return _without(robots, f"{who} {'have' if len(robots) > 1 else 'has'} been removed", plan)


def _without(robots: Sequence[int], note: str, plan: Plan) -> _Change:
    """The formation without these robots, as far as they are in it."""
    offsets = {other: place for other, place in plan.offsets.items() if other not in robots}
    edges = [
        (i, j, distance) for (i, j), distance in plan.edges.items() if i not in robots and j not in robots
    ]
    parts = _parts(offsets, edges)
    if parts > _parts(plan.offsets, mission_parts(plan)[1]):
        note += f"; the formation graph falls into {parts} parts"
    return _Change(offsets=offsets, edges=edges, note=note)


def _parts(offsets: Mapping[int, Vector], edges: Sequence[tuple[int, int, float]]) -> int:
    row = {robot: k for k, robot in enumerate(offsets)}
    return len(components(len(row), [(row[i], row[j]) for i, j, _ in edges]))


def _replace(order: OrderSection, plan: Plan, fleet: Fleet) -> _Change:
    robot, by = order.robot, order.by
    assert robot is not None
    assert by is not None
    _refuse_stranger(robot, plan, fleet)
    _refuse_newcomer(by, plan, fleet)
    new = {robot: by}
    return _Change(
        offsets={new.get(other, other): place for other, place in plan.offsets.items()},
        edges=[(new.get(i, i), new.get(j, j), distance) for (i, j), distance in plan.edges.items()],
        note=f"robot {by} takes the place of robot {robot}",
    )


def _reshape(order: OrderSection, plan: Plan, fleet: Fleet) -> _Change:
    shape, scale = order.formation or ShapeSection(), order.scale
    offsets, news = dict(plan.offsets), []
    if shape.offsets is not None:
        if len(shape.offsets) != len(plan.members):
            raise OrderError(
                f"formation.offsets has {len(shape.offsets)} places for {len(plan.members)} robots: "
                f"one each for {_listed(plan.members)}"
            )
        offsets = dict(zip(plan.members, shape.offsets, strict=True))
        news.append("places")
    if shape.edges is not None:
        news.append("edges")
    if shape.distance_m is not None:
        news.append("distances")
    edges = _distances(shape, plan, fleet, offsets)
    if shape.distance_m is not None and shape.offsets is None:
        offsets = _found(offsets, edges, fleet.formation.safe_distance_m)
    if scale is not None:
        offsets = {robot: (scale * x, scale * y) for robot, (x, y) in offsets.items()}
        edges = {edge: scale * distance for edge, distance in edges.items()}
        news.append(f"{scale:g} times the size")
    if order.trajectory is not None:
        news.append(f"trajectory ({order.trajectory.kind})")
    if not news:
        raise OrderError("reshape changes nothing: give formation, scale or trajectory")
    return _Change(
        offsets=offsets,
        edges=[(i, j, distance) for (i, j), distance in edges.items()],
        note=f"new {_listed(news)}" if scale is None else f"reshaped: {_listed(news)}",
        trajectory=order.trajectory,
    )


def _distances(shape: ShapeSection, plan: Plan, fleet: Fleet, offsets: Mapping[int, Vector]) -> Edges:
    """The edges after a reshaping, in the order in which they are given, with their distances."""
    given = tuple(plan.edges) if shape.edges is None else shape.edges
    wanted = shape.distance_m
    if isinstance(wanted, tuple) and len(wanted) != len(given):
        raise OrderError(f"formation.distance_m has {len(wanted)} distances for {len(given)} edges")
    if wanted is not None and not given:
        raise OrderError("formation.distance_m is given, but the formation has no edges")
    edges: Edges = {}
    for k, (i, j) in enumerate(given):
        for robot in (i, j):
            _refuse_stranger(robot, plan, fleet)
        edge = min(i, j), max(i, j)
        if i == j or edge in edges:
            wrong = "joins a robot to itself" if i == j else "is given twice"
            raise OrderError(f"the edge [{i}, {j}] {wrong}")
        if wanted is not None:
            edges[edge] = wanted[k] if isinstance(wanted, tuple) else wanted
        elif shape.offsets is None and edge in plan.edges:
            edges[edge] = plan.edges[edge]
        else:
            edges[edge] = dist(offsets[i], offsets[j])
    return edges


def _found(offsets: Mapping[int, Vector], edges: Edges, safe: float) -> dict[int, Vector]:
    """Places that meet the edges' distances, near those that are."""
    row = {robot: k for k, robot in enumerate(offsets)}
    wanted = np.array(list(edges.values()))
    try:
        shape = realise_near(list(offsets.values()), [(row[i], row[j]) for i, j in edges], wanted, safe)
    except FormationError as error:
        raise OrderError(f"{error}: give formation.offsets") from None
    worst = worst_edge(shape, wanted)
    if abs(shape.error[worst]) > DISTANCE_TOLERANCE * wanted[worst]:
        i, j = list(edges)[worst]
        raise OrderError(
            f"found no places that meet all {len(edges)} distances: in the nearest [{i}, {j}] is "
            f"{wanted[worst] + shape.error[worst]:.4g} m long, not {wanted[worst]:.4g} m"
        )
    return {robot: (float(x), float(y)) for robot, (x, y) in zip(offsets, shape.offsets, strict=True)}


def _from_there(
    section: TrajectorySection, plan: Plan, fleet: Fleet, from_ns: int, blend_ns: int
) -> TrajectorySection:
    """A line or hold counts from where the motion before has the reference in the middle of the blend; others
    are where they are.

    The velocity before then goes over to that after by a sixth more than their difference at most; by four
    fifths more where they meet as the blend begins.
    """
    if section.kind not in _FROM_THERE:
        return section
    x, y = reference_at(plan, from_ns + blend_ns // 2, fleet)
    vx, vy = section.velocity_mps or (0.0, 0.0)
    half_s = 0.5 * blend_ns / NS_PER_S
    return replace(
        section, start_m=(x - vx * half_s + section.start_m[0], y - vy * half_s + section.start_m[1])
    )


def _refuse_stranger(robot: int, plan: Plan, fleet: Fleet) -> None:
    _refuse_unknown(robot, fleet)
    if robot not in plan.offsets:
        raise OrderError(f"robot {robot} has no place in the formation: members are {_listed(plan.members)}")


def _refuse_newcomer(robot: int, plan: Plan, fleet: Fleet) -> None:
    _refuse_unknown(robot, fleet)
    if robot in plan.offsets:
        raise OrderError(f"robot {robot} has a place in the formation already")


def _refuse_unknown(robot: int, fleet: Fleet) -> None:
    if robot not in fleet.ids:
        raise OrderError(f"robot {robot} is not in the fleet: its ids are {show(fleet.ids, 80)[1:-1]}")


def _point(place: Vector) -> str:
    return f"[{place[0]:.4g}, {place[1]:.4g}]"


def _listed(items: Sequence[object]) -> str:
    """1, 2 and 3"""
    words = [str(item) for item in items]
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


_KINDS: Final[Mapping[str, Callable[[OrderSection, Plan, Fleet], _Change]]] = {
    "join": _join,
    "leave": _leave,
    "replace": _replace,
    "remove": _remove,
    "reshape": _reshape,
}
