"""What would go wrong with a fleet file's orders: they are given in turn, to nobody."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.limits import speed_max
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.mission_plan import Plan
from handfast.agent.formation.points import components
from handfast.deploy.check.finding import Finding
from handfast.deploy.console.wording import some
from handfast.deploy.orders.blend_time import blend_ns_for, peaks_of
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.orders.operator import Operator

OVER_MAX: Final = 1.25
"""Places that move by so much faster than robots do are worth a word: for a moment they catch up."""
_EPOCH_NS: Final = 1_000 * NS_PER_S


def check_orders(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Everything worth saying about them, by the code that carries them out in a drive."""
    end_s = fleet.fleet.duration_s
    operator = Operator(fleet, geometry)
    operator.begin(_EPOCH_NS - NS_PER_S, _EPOCH_NS, round(end_s * NS_PER_S))
    parts = _parts(operator.plan)
    latest = operator.plan
    for number, order in sorted(enumerate(fleet.orders, 1), key=lambda row: row[1].at):
        place = f"order[{number}]"
        try:
            operator.give(order, _EPOCH_NS + round(order.at * NS_PER_S))
        except OrderError as error:
            yield Finding("error", place, f"at {order.at:g} s, {order.kind}: {error}")
            continue
        if order.at >= end_s:
            yield Finding(
                "warning",
                f"{place}.at",
                f"{order.at:g} s is not before the run's end at {end_s:g} s: it is never given",
            )
            continue
        plan = operator.plan
        if order.kind in ("stop", "resume") or plan is None:
            continue
        if order.over_s is not None and latest is not None:
            yield from _too_soon(f"{place}.over_s", order, latest, plan, fleet)
        latest = plan
        done_s = (plan.from_ns + plan.blend_ns - _EPOCH_NS) / NS_PER_S
        if done_s > end_s:
            yield Finding(
                "warning",
                f"{place}.at",
                f"what is ordered at {order.at:g} s is done at {done_s:.4g} s, after the run's end at "
                f"{end_s:g} s: order it earlier, give it less time (over_s) or let the run last longer "
                "(fleet.duration_s)",
            )
        before, parts = parts, _parts(plan)
        if len(parts) > max(len(before), 1):
            shown = ", ".join("{" + some(part) + "}" for part in parts)
            yield Finding(
                "warning",
                place,
                f"after it the graph is in {len(parts)} parts, {shown}: robots of different parts only "
                "keep out of each other's way",
            )


def _too_soon(place: str, order: OrderSection, before: Plan, plan: Plan, fleet: Fleet) -> Iterator[Finding]:
    """That places move as robots cannot, by how long a change is to take."""
    if plan.from_ns <= plan.mission.epoch_ns or not plan.blend_ns:
        return
    control, peaks = fleet.control, peaks_of(before, plan, plan.blend_ns, fleet)
    least_ns = blend_ns_for(before, lambda _: plan, fleet)
    if least_ns is None:
        return
    speed = max(speed_max(fleet), peaks_of(before, plan, least_ns, fleet).speed)
    if peaks.speed > OVER_MAX * speed or peaks.acceleration > control.max_acceleration:
        yield Finding(
            "warning",
            place,
            f"{order.over_s:g} s are so few that places move at {peaks.speed:.3g} m/s and "
            f"{peaks.acceleration:.3g} m/s2, and robots at {speed_max(fleet):g} m/s (control.max_speed_mps) "
            f"and {control.max_acceleration:g} m/s2 (control.max_acceleration): they fall behind, out of "
            "formation; "
            f"{least_ns / NS_PER_S:.2g} s are enough",
        )


def _parts(plan: Plan | None) -> list[list[int]]:
    """The members' ids by connected part of the graph."""
    if plan is None:
        return []
    row = {robot: k for k, robot in enumerate(plan.members)}
    found = components(len(row), [(row[i], row[j]) for i, j in plan.edges])
    return [[plan.members[k] for k in part] for part in found]
