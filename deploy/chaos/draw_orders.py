"""Random orders of an operator: joins, leaves, replacements, other shapes and trajectories, stops, resumes.

Each is tried on the fleet as it is then, as an operator's command would be: one that cannot be carried out
is not part of the scenario. Pure. Times in s from the start of the drive, lengths in m, W.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, dist, hypot, pi, sin
from typing import Final

import tomli_w

from agent.common.quantities import Vector
from agent.common.time import NS_PER_S
from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve, resolved
from agent.formation.mission_plan import Plan
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import APART_FACTOR, apart_m, draw_shape, near_shape
from deploy.chaos.draw_obstacles import Reach, hands
from deploy.orders.mission_editing import OrderError
from deploy.orders.operator import Operator

Draw = Callable[[Dice, Vector], Tables]
"""A trajectory that begins near a place."""

LAST_S: Final = 1.5
"""No order in so much before the trouble ends: it is taken over a second later."""
_COUNTS: Final = ((0, 2.0), (1, 3.0), (2, 3.0), (3, 2.0), (5, 1.5), (8, 0.7))
_KINDS: Final = (
    ("join", 3.0), ("leave", 2.0), ("replace", 2.0), ("shape", 2.0), ("scale", 1.0), ("edges", 1.0),
    ("course", 2.5), ("stop", 2.5),
)  # fmt: skip
_STEP_S: Final = 0.5
_TRIES: Final = 30


def draw_orders(dice: Dice, tables: Tables, trouble_s: float, way: Draw) -> tuple[list[Tables], Reach]:
    """``[[order]]`` of a scenario, all before `trouble_s`; and the box that its places and starts lie in."""
    drawing = _Drawing(dice, tables, way)
    times: list[float] = []
    for _ in range(dice.weighted(_COUNTS)):
        if times and dice.chance(0.3):  # right after one another
            times.append(round(times[-1] + dice.between(0.0, 0.4), 2))
        else:
            times.append(dice.between(0.0, trouble_s - LAST_S, 2))
    for at in sorted(min(at, trouble_s - LAST_S) for at in times):
        drawing.add(at)
    return drawing.finish(trouble_s), drawing.reach


class _Drawing:
    def __init__(self, dice: Dice, tables: Tables, way: Draw) -> None:
        self._dice, self._tables, self._way = dice, tables, way
        self._fleet: Fleet = resolved(parse_fleet(tomli_w.dumps(tables), source="scenario"))
        self._safe = self._fleet.formation.safe_distance_m
        self._operator = Operator(self._fleet, resolve(self._fleet))
        self._epoch_ns = 3600 * NS_PER_S
        duration_ns = round(self._fleet.fleet.duration_s * NS_PER_S)
        self._operator.begin(self._epoch_ns - NS_PER_S, self._epoch_ns, duration_ns)
        self._plans = [self._plan]
        self._orders: list[Tables] = []

    @property
    def _plan(self) -> Plan:
        assert self._operator.plan is not None
        return self._operator.plan

    # ------------------------------------------------------------------ one order

    def add(self, at: float) -> None:
        """Adds an order at this time, if one can be carried out."""
        kind = self._dice.weighted(_KINDS)
        if kind == "stop":
            self._stop(at)
            return
        order = getattr(self, f"_{kind}")(at)
        if order is not None:
            self._try({"at": at, **order})

    def _try(self, order: Tables) -> None:
        text = tomli_w.dumps({**self._tables, "order": [order]})
        section = parse_fleet(text, source="scenario").orders[0]
        try:
            self._operator.give(section, self._epoch_ns + round(section.at * NS_PER_S))
        except OrderError:
            return
        places = list(self._plan.offsets.values())
        assert all(dist(a, b) > self._safe for k, a in enumerate(places) for b in places[:k])
        self._orders.append(order)
        self._plans.append(self._plan)

    def _spares(self) -> list[int]:
        return [robot for robot in self._fleet.ids if robot not in self._plan.offsets]

    def _join(self, at: float) -> Tables | None:
        spares, dice = self._spares(), self._dice
        if not spares:
            return None
        members = list(self._plan.members)
        edges = dice.some(members, dice.weighted(((0, 1.0), (1, 3.0), (2, 4.0), (3, 2.0))))
        order: Tables = {"kind": "join", "robot": dice.pick(spares), "edges": edges}
        least = apart_m(self._safe)
        if len(edges) == 1 and dice.chance(0.4):
            order["distance_m"] = round(1.5 * least, 2)
            return order
        place = self._free_place(least, self._seen_from_reference(order["robot"], at))
        if place is None:
            return None
        order["offset_m"] = list(place)
        return order

    def _seen_from_reference(self, robot: int, at: float) -> Vector:
        """Where a robot that has not moved since the start is."""
        x, y = hands(self._tables)[self._fleet.index(robot)]
        cx, cy = self._plan.reference(self._epoch_ns + round(at * NS_PER_S))[:2]
        return x - cx, y - cy

    def _free_place(self, least: float, here: Vector) -> Vector | None:
        """A place beside the others and well apart from them; of some, the one that is nearest to `here`."""
        places, dice = list(self._plan.offsets.values()), self._dice
        free: list[Vector] = []
        for _ in range(_TRIES):
            (x, y), away, angle = dice.pick(places), dice.between(1.0, 2.0) * least, 2.0 * pi * dice.share()
            place = round(x + away * cos(angle), 3), round(y + away * sin(angle), 3)
            if all(dist(place, other) >= least for other in places):
                free.append(place)
        return min(free, key=lambda place: dist(place, here), default=None)

    def _leave(self, at: float) -> Tables | None:
        members = self._plan.members
        return {"kind": "leave", "robot": self._dice.pick(members)} if len(members) > 1 else None

    def _replace(self, at: float) -> Tables | None:
        spares = self._spares()
        if not spares:
            return None
        gone, by = self._dice.pick(self._plan.members), self._dice.pick(spares)
        return {"kind": "replace", "robot": gone, "by": by}

    def _shape(self, at: float) -> Tables | None:
        members = self._plan.members
        shape = near_shape(draw_shape(self._dice, members, self._safe), self._plan.offsets)
        new: Tables = {"offsets": [list(shape.offsets[robot]) for robot in members]}
        if self._dice.chance(0.6) and shape.edges:
            new["edges"] = [list(edge) for edge in shape.edges]
        return {"kind": "reshape", "formation": new}

    def _scale(self, at: float) -> Tables | None:
        places = list(self._plan.offsets.values())
        nearest = min((dist(a, b) for k, a in enumerate(places) for b in places[:k]), default=1e3)
        scale = max(self._dice.between(0.7, 1.5, 2), round(APART_FACTOR * self._safe / nearest + 0.01, 2))
        return {"kind": "reshape", "scale": scale}

    def _edges(self, at: float) -> Tables | None:
        members = self._plan.members
        if len(members) < 2:
            return None
        edges = sorted(self._plan.edges)
        pairs = [(i, j) for k, i in enumerate(members) for j in members[k + 1 :]]
        new = self._dice.pick(pairs)
        edge = min(new), max(new)
        kept = [each for each in edges if each != edge] if edge in edges else [*edges, edge]
        return {"kind": "reshape", "formation": {"edges": [list(each) for each in kept]}} if kept else None

    def _course(self, at: float) -> Tables:
        x, y = self._plan.reference(self._epoch_ns + round((at + 1.0) * NS_PER_S))[:2]
        return {"kind": "reshape", "trajectory": self._way(self._dice, (x, y))}

    # ------------------------------------------------------------------ stops

    def _stop(self, at: float) -> None:
        dice = self._dice
        self._orders.append({"at": at, "kind": "stop", "reason": f"drawn at {at:g} s"})
        leave_s = round(at + (dice.between(0.0, 0.4) if dice.chance(0.3) else dice.between(0.4, 4.0)), 2)
        if dice.chance(0.2):  # at first only for some
            some = dice.some(self._fleet.ids, dice.whole(1, len(self._fleet.ids)))
            self._orders.append({"at": leave_s, "kind": "resume", "robots": some})
            leave_s = round(leave_s + dice.between(0.1, 1.0), 2)
        self._orders.append({"at": leave_s, "kind": "resume"})

    def finish(self, trouble_s: float) -> list[Tables]:
        """All orders in their time; mostly with a resume of all after the last stop."""
        orders = sorted(self._orders, key=lambda order: float(order["at"]))
        stops = [order for order in orders if order["kind"] == "stop"]
        if stops and self._dice.chance(0.1):
            return [each for each in orders if each["kind"] != "resume" or each["at"] < stops[-1]["at"]]
        return orders

    # ------------------------------------------------------------------ where all this is

    @property
    def reach(self) -> Reach:
        """The box of all starts and places."""
        points = hands(self._tables)
        end_ns = self._epoch_ns + round(self._fleet.fleet.duration_s * NS_PER_S)
        for number, plan in enumerate(self._plans):
            until_ns = end_ns if number + 1 == len(self._plans) else self._plans[number + 1].from_ns
            until_ns += plan.blend_ns
            radius = max(hypot(*place) for place in plan.offsets.values())
            time_ns = plan.from_ns
            while time_ns < until_ns + round(_STEP_S * NS_PER_S):
                x, y = plan.reference(time_ns)[:2]
                points += [(x - radius, y - radius), (x + radius, y + radius)]
                time_ns += round(_STEP_S * NS_PER_S)
        low = min(x for x, _ in points), min(y for _, y in points)
        return Reach(low, (max(x for x, _ in points), max(y for _, y in points)))
