"""Robots that are only their control law and an exact body, among obstacles: a closed loop, tick by tick."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, dist, hypot, inf, sin
from typing import NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.controller import Controller
from handfast.agent.control.hand import Pose, advance, hand
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import plan_of
from handfast.agent.messages.types import HandState, Mission, PlantState

Point = tuple[float, float]

T0 = 1000 * NS_PER_S
REACHED_M = 0.1
STAYS_TICKS = 25
REACH = 0.1
FLEET = """
fleet.name = "bench"
formation = {{ edges = [{edges}], offsets = [{places}], safe_distance_m = 0.22, assign = false }}
trajectory = {{ kind = "line", start_m = [0.0, 0.0], velocity_mps = [{velocity[0]}, {velocity[1]}] }}
avoidance = {{ distance_m = 0.61 }}
obstacle = [{obstacles}]
robot = [{robots}]
"""


class Drive(NamedTuple):
    """How a drive went: seconds until all were at their places, None if they never were; closest pair, and
    nearest to an obstacle, m."""

    seconds: float | None
    pair: float
    obstacle: float


def fleet_of(
    starts: Sequence[Point],
    places: Sequence[Point],
    velocity: Point,
    obstacles: Sequence[str],
    edges: Sequence[tuple[int, int]] = (),
) -> Fleet:
    """Robots whose hand points start at `starts`; without `edges` they share none."""
    text = FLEET.format(
        edges=", ".join(f"[{i}, {j}]" for i, j in edges),
        places=", ".join(f"[{x!r}, {y!r}]" for x, y in places),
        velocity=velocity,
        obstacles=", ".join(obstacles),
        robots=", ".join(
            f"{{ id = {n}, x_m = {x - REACH!r}, y_m = {y!r}, hand_offset_m = {REACH} }}"
            for n, (x, y) in enumerate(starts, 1)
        ),
    )
    return parse_fleet(text, source="bench.toml")


class _Robot:
    def __init__(self, fleet: Fleet, robot: int) -> None:
        body = fleet.robot(robot)
        self.body, self.controller = body, Controller(fleet, resolve(fleet), robot)
        self.controller.plan(plan_of(Mission(1, T0, T0, 10**12, ""), fleet, resolve(fleet)))
        self.pose = Pose(body.x_m, body.y_m, body.heading_rad, 0.0, 0.0)
        self.acts = self.asked = (0.0, 0.0)

    def think(self, count: int, tick_ns: int, now_ns: int) -> HandState:
        controller, robot = self.controller, self.body.id
        state = PlantState(robot, count, tick_ns, *self.pose, *self.acts, True, True, True, "")
        here = controller.hand_at(state, now_ns)
        controller.look(now_ns)
        neighbours = {peer.robot for _, peer in controller.edges}
        for _, peer in controller.edges:
            peer.trust = 1.0 if peer.message is not None else 0.0
        controller.proximity.look(now_ns, here, neighbours)
        drive = controller.drive(state, now_ns)
        controller.sent(now_ns, (drive.force, drive.torque))
        self.asked = drive.force, drive.torque
        multipliers = controller.coupling.shared()
        return HandState(robot, count, now_ns, True, drive.degree, *here, *drive.forces, 0.0, multipliers, ())

    def move(self, period_s: float) -> None:
        self.pose = Pose(*advance(self.pose, *self.acts, self.body.mass_kg, self.body.inertia_kgm2, period_s))
        self.acts = self.asked


def drive(fleet: Fleet, seconds: float) -> Drive:
    """Drives until all robots are at their places and stay there, or for so many seconds."""
    robots = [_Robot(fleet, robot) for robot in fleet.ids]
    period_ns, period_s = fleet.period_ns, fleet.period_ns / NS_PER_S
    pair = obstacle = inf
    said: list[HandState] = []
    there = 0
    for count in range(round(seconds / period_s)):
        tick_ns = T0 + count * period_ns
        now_ns = tick_ns + period_ns // 2
        for robot in robots:
            for message in said:
                if message.robot != robot.body.id:
                    robot.controller.peers.accept(message, now_ns)
        said = [robot.think(count, tick_ns, now_ns) for robot in robots]
        hands = [hand(robot.pose, REACH)[:2] for robot in robots]
        pair = min([pair, *(dist(a, b) for n, a in enumerate(hands) for b in hands[:n])])
        proximity = robots[0].controller.proximity.obstacles
        obstacle = min(
            [obstacle, *(near.distance for at in hands for b in proximity for near in b.near(*at, 1.0))]
        )
        places = [robot.controller.reference.motion(robot.body.id, tick_ns) for robot in robots]
        away = max(
            hypot(at[0] - p[0], at[1] - p[1]) for at, p in zip(hands, places, strict=True) if p is not None
        )
        there = there + 1 if away < REACHED_M else 0
        if there >= STAYS_TICKS:
            return Drive(count * period_s, pair, obstacle)
        for robot in robots:
            robot.move(period_s)
    return Drive(None, pair, obstacle)


def polygon(points: Sequence[Point], x: float, y: float, turn: float, scale: float) -> str:
    """An obstacle of a fleet file: a shape, scaled, turned and then moved."""
    c, s = scale * cos(turn), scale * sin(turn)
    corners = ", ".join(f"[{x + c * px - s * py!r}, {y + s * px + c * py!r}]" for px, py in points)
    return f"{{ points_m = [{corners}] }}"


def circle(x: float, y: float, radius: float) -> str:
    """An obstacle of a fleet file."""
    return f"{{ centre_m = [{x!r}, {y!r}], radius_m = {radius!r} }}"
