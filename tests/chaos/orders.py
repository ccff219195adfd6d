"""Random orders of an operator. Times in s from the start of the drive, lengths in m, frame W.

Each order is tried on the fleet as it is then, as an operator's command would be. One that cannot be carried
out is not part of the scenario.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, dist, hypot, pi, sin
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.formation.mission_plan import Plan
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.orders.operator import Operator
from tests.chaos.dice import Dice, Tables
from tests.chaos.layout import (
    APART_FACTOR,
    SHAPES,
    apart_m,
    draw_course,
    nearest_slots,
    turned,
)  # fmt: skip
from tests.chaos.scene import Scene
from tests.chaos.text import scenario_text

_LAST_S: Final = 1.5
"""Minimum time from the last order to the end of the trouble: it takes effect a second later."""
_COUNTS: Final = ((1, 3.0), (2, 3.0), (3, 2.0), (5, 1.5), (8, 0.7))
_KINDS: Final = (
    ("join", 3.0), ("leave", 2.0), ("replace", 2.0), ("shape", 2.0), ("scale", 1.0), ("edges", 1.0),
    ("course", 2.5), ("stop", 2.5),
)  # fmt: skip
_STEP_S: Final = 0.5
_TRIES: Final = 30
_EPOCH_NS: Final = 3600 * NS_PER_S


def draw_swaps(scene: Scene) -> None:
    """Order all to the other side or to each other's places, once or twice, about when links are cut."""
    dice, places = scene.dice, dict(scene.shape.offsets)
    cut_s = max((rule["at"] for rule in scene.rules if "at" in rule), default=0.0)
    times = [round(max(0.0, cut_s + dice.between(-0.5, 12.0)), 2) for _ in range(dice.whole(1, 2))]
    for at in sorted(times):
        kind = dice.weighted((("mirror", 3.0), ("turn", 1.0), ("shuffle", 1.0)))
        if kind == "shuffle":
            step, given = dice.whole(1, max(1, len(places) - 1)), list(places.values())
            places = dict(zip(places, given[step:] + given[:step], strict=True))
        else:
            angle = pi if kind == "mirror" else dice.between(0.5 * pi, 1.5 * pi)
            places = {robot: turned(place, angle) for robot, place in places.items()}
        offsets = [[round(x, 3), round(y, 3)] for x, y in places.values()]
        scene.add_order({"at": at, "kind": "reshape", "formation": {"offsets": offsets}})


def draw_orders(scene: Scene, tables: Tables) -> list[Vector]:
    """Add orders of all kinds until the trouble ends; return corners of boxes that hold places and starts.

    Args:
        tables: the fleet file so far.
    """
    drawing, dice, times = _Drawing(scene, tables), scene.dice, list[float]()
    latest_s = scene.trouble_s - _LAST_S
    for _ in range(dice.weighted(_COUNTS) if dice.chance(scene.preset.orders["any"]) else 0):
        soon = bool(times) and dice.chance(0.3)  # right after one another
        times.append(round(times[-1] + dice.between(0.0, 0.4), 2) if soon else dice.between(0.0, latest_s, 2))
    for at in sorted(min(at, latest_s) for at in times):
        drawing.add(at)
    scene.orders += drawing.finish()
    return drawing.extent()


class _Drawing:
    def __init__(self, scene: Scene, tables: Tables) -> None:
        self._dice, self._scene, self._tables = scene.dice, scene, tables
        self._fleet = resolved(parse_fleet(scenario_text(tables), source="scenario"))
        self._operator = Operator(self._fleet, resolve(self._fleet))
        duration_ns = round(self._fleet.fleet.duration_s * NS_PER_S)
        self._operator.begin(_EPOCH_NS - NS_PER_S, _EPOCH_NS, duration_ns)
        self._plans = [self._plan]
        self._orders: list[Tables] = []
        self._draw: dict[str, Callable[[Dice, Plan, float], Tables | None]] = {
            "join": self._join, "leave": self._leave, "replace": self._replace, "shape": self._shape,
            "scale": self._scale, "edges": self._edges, "course": self._course,
        }  # fmt: skip

    @property
    def _plan(self) -> Plan:
        assert self._operator.plan is not None
        return self._operator.plan

    def add(self, at: float) -> None:
        """Add an order at this time if one of the kind that is drawn can be carried out."""
        kind = self._dice.weighted(_KINDS)
        if kind == "stop":
            self._stop(at)
        elif (drawn := self._draw[kind](self._dice, self._plan, at)) is not None:
            order = {"at": at, **drawn}
            text = scenario_text({**self._tables, "order": [order]})
            section = parse_fleet(text, source="scenario").orders[0]
            try:
                self._operator.give(section, _EPOCH_NS + round(section.at * NS_PER_S))
            except OrderError:
                return
            self._orders.append(order)
            self._plans.append(self._plan)

    def _spares(self, plan: Plan) -> list[int]:
        return [robot for robot in self._fleet.ids if robot not in plan.offsets]

    def _join(self, dice: Dice, plan: Plan, at: float) -> Tables | None:
        spares, least = self._spares(plan), apart_m(self._scene.safe_m)
        if not spares:
            return None
        edges = dice.some(list(plan.members), dice.weighted(((0, 1.0), (1, 3.0), (2, 4.0), (3, 2.0))))
        order: Tables = {"kind": "join", "robot": dice.pick(spares), "edges": edges}
        if len(edges) == 1 and dice.chance(0.4):
            return {**order, "distance_m": round(1.5 * least, 2)}
        x, y = self._scene.starts[order["robot"]]
        cx, cy = plan.reference(_EPOCH_NS + round(at * NS_PER_S))[:2]
        place = self._free_place(dice, plan, least, (x - cx, y - cy))
        return None if place is None else {**order, "offset_m": list(place)}

    def _free_place(self, dice: Dice, plan: Plan, least: float, here: Vector) -> Vector | None:
        """Return a place next to the others that is well apart from them; of some the nearest to `here`."""
        places, free = list(plan.offsets.values()), list[Vector]()
        for _ in range(_TRIES):
            (x, y), away, angle = dice.pick(places), dice.between(1.0, 2.0) * least, 2.0 * pi * dice.share()
            place = round(x + away * cos(angle), 3), round(y + away * sin(angle), 3)
            if all(dist(place, other) >= least for other in places):
                free.append(place)
        return min(free, key=lambda place: dist(place, here), default=None)

    def _leave(self, dice: Dice, plan: Plan, at: float) -> Tables | None:
        return {"kind": "leave", "robot": dice.pick(plan.members)} if len(plan.members) > 1 else None

    def _replace(self, dice: Dice, plan: Plan, at: float) -> Tables | None:
        spares = self._spares(plan)
        if not spares:
            return None
        return {"kind": "replace", "robot": dice.pick(plan.members), "by": dice.pick(spares)}

    def _shape(self, dice: Dice, plan: Plan, at: float) -> Tables | None:
        spacing = dice.between(1.0, 1.8) * apart_m(self._scene.safe_m)
        drawn = SHAPES[dice.weighted((("graph", 0.6), ("lattice", 0.4)))](dice, plan.members, spacing)
        shape = nearest_slots(drawn, plan.offsets)
        new: Tables = {"offsets": [list(shape.offsets[robot]) for robot in plan.members]}
        if dice.chance(0.6) and shape.edges:
            new["edges"] = [list(edge) for edge in shape.edges]
        return {"kind": "reshape", "formation": new}

    def _scale(self, dice: Dice, plan: Plan, at: float) -> Tables:
        places = list(plan.offsets.values())
        nearest = min((dist(a, b) for k, a in enumerate(places) for b in places[:k]), default=1e3)
        least = round(APART_FACTOR * self._scene.safe_m / nearest + 0.01, 2)
        return {"kind": "reshape", "scale": max(dice.between(0.7, 1.5, 2), least)}

    def _edges(self, dice: Dice, plan: Plan, at: float) -> Tables | None:
        if len(plan.members) < 2:
            return None
        edges, (a, b) = sorted(plan.edges), dice.some(plan.members, 2)
        edge = min(a, b), max(a, b)
        kept = [each for each in edges if each != edge] if edge in edges else [*edges, edge]
        return {"kind": "reshape", "formation": {"edges": [list(each) for each in kept]}} if kept else None

    def _course(self, dice: Dice, plan: Plan, at: float) -> Tables:
        here = plan.reference(_EPOCH_NS + round((at + 1.0) * NS_PER_S))[:2]
        speed = dice.between(0.1, 0.4) * self._scene.speed * (0.5 if self._scene.groups else 1.0)
        kind = dice.weighted((("hold", 1.0), ("line", 3.0), ("circle", 2.0), ("waypoints", 2.0)))
        course = draw_course(dice, kind, here, speed, 0.0, self._scene.shape)
        return {"kind": "reshape", "trajectory": course}

    def _stop(self, at: float) -> None:
        """Add a stop and a resume, sometimes at first only of some robots."""
        dice = self._dice
        self._orders.append({"at": at, "kind": "stop"})
        resume_s = round(at + (dice.between(0.0, 0.4) if dice.chance(0.3) else dice.between(0.4, 4.0)), 2)
        if dice.chance(0.2):
            some = dice.some(self._fleet.ids, dice.whole(1, len(self._fleet.ids)))
            self._orders.append({"at": resume_s, "kind": "resume", "robots": some})
            resume_s = round(resume_s + dice.between(0.1, 1.0), 2)
        self._orders.append({"at": resume_s, "kind": "resume"})

    def finish(self) -> list[Tables]:
        """Return all orders by time; in one of ten nobody resumes the robots after the last stop."""
        orders = sorted(self._orders, key=lambda order: float(order["at"]))
        stops = [order["at"] for order in orders if order["kind"] == "stop"]
        if stops and self._dice.chance(0.1):
            return [each for each in orders if each["kind"] != "resume" or each["at"] < stops[-1]]
        return orders

    def extent(self) -> list[Vector]:
        """Return all starts, and corners of boxes round the formation along its course."""
        points = list(self._scene.starts.values())
        end_ns = _EPOCH_NS + round(self._fleet.fleet.duration_s * NS_PER_S)
        untils_ns = [*(plan.from_ns for plan in self._plans[1:]), end_ns]
        for plan, until_ns in zip(self._plans, untils_ns, strict=True):
            radius = max(hypot(*place) for place in plan.offsets.values())
            time_ns, step_ns = plan.from_ns, round(_STEP_S * NS_PER_S)
            while time_ns < until_ns + plan.blend_ns + step_ns:
                x, y = plan.reference(time_ns)[:2]
                points += [(x - radius, y - radius), (x + radius, y + radius)]
                time_ns += step_ns
        return points
