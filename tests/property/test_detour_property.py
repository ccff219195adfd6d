"""The law, the safety filter and detours, in closed loop: all reach their places."""

from __future__ import annotations

from math import cos, hypot, inf, pi, sin
from random import Random

import pytest

from handfast.agent.control.boundaries import obstacles_of
from handfast.agent.control.limits import clearance
from tests.property.driving_bench import circle, drive, fleet_of, polygon

SAFE = 0.22
CLEARANCE = clearance(None, SAFE)
BAND = 0.61 - SAFE
SIZE_M = 4.5
SEEDS = 4  # of each kind

BRACKET = ((0.0, 0.0), (2.5, 0.0), (2.5, 0.3), (0.3, 0.3), (0.3, 2.5), (0.0, 2.5))
CUP = ((-1.2, -1.0), (1.2, -1.0), (1.2, 1.2), (0.9, 1.2), (0.9, -0.7), (-0.9, -0.7), (-0.9, 1.2), (-1.2, 1.2))
COMB = (
    (-1.7, -1.0), (1.7, -1.0), (1.7, 0.8), (1.5, 0.8), (1.5, -0.8), (0.1, -0.8), (0.1, 0.8), (-0.1, 0.8),
    (-0.1, -0.8), (-1.5, -0.8), (-1.5, 0.8), (-1.7, 0.8),
)  # fmt: skip
TRAP = (
    (-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (0.1, 1.5), (0.1, 1.3), (1.3, 1.3), (1.3, -1.3), (-1.3, -1.3),
    (-1.3, 1.5), (-1.5, 1.5),
)  # fmt: skip
SHAPES = {"bracket": BRACKET, "cup": CUP, "comb": COMB, "trap": TRAP}


def obstacles(kind: str, draw: Random) -> list[str]:
    turn, size = draw.uniform(0.0, 2.0 * pi), draw.uniform(0.8, 1.3)
    if kind in SHAPES:
        return [polygon(SHAPES[kind], draw.uniform(-0.3, 0.3), draw.uniform(-0.3, 0.3), turn, size)]
    if kind == "circle":
        return [circle(draw.uniform(-0.3, 0.3), draw.uniform(-0.3, 0.3), 1.5 * size)]
    if kind == "convex":
        count = draw.randint(3, 8)
        corners = [(cos(2.0 * pi * k / count), sin(2.0 * pi * k / count)) for k in range(count)]
        return [polygon(corners, 0.0, 0.0, turn, 1.5 * size)]
    # Two with a gap that is wide enough for the clearance, but not for both bands.
    left, right = draw.uniform(0.3, 1.0), draw.uniform(0.3, 1.0)
    half = 0.5 * (left + right + draw.uniform(2.2 * CLEARANCE, 2.0 * (CLEARANCE + BAND)))
    return [circle(s * half * cos(turn), s * half * sin(turn), r) for s, r in ((-1.0, left), (1.0, right))]


def scene(kind: str, seed: int, moving: bool):
    """A robot on one side of obstacles and its place, which may move, on another."""
    draw = Random(f"{kind} {seed} {moving}")
    shapes = obstacles(kind, draw)
    proximity = obstacles_of(fleet_of([(0.0, 0.0)], [(0.0, 0.0)], (0.0, 0.0), shapes))
    while True:
        (sx, sy), (x, y) = ((draw.uniform(-SIZE_M, SIZE_M), draw.uniform(-SIZE_M, SIZE_M)) for _ in range(2))
        room = [min(b.near(*at, inf)[0].distance for b in proximity) for at in ((sx, sy), (x, y))]
        if room[0] > CLEARANCE + 0.07 and room[1] > CLEARANCE + BAND and hypot(sx - x, sy - y) > 2.0:
            break
    speed, way = draw.uniform(0.1, 0.4) * moving, draw.uniform(0.0, 2.0 * pi)
    velocity = speed * cos(way), speed * sin(way)
    # A place that moves is there after 15 s, and may come through an obstacle.
    place = x - 15.0 * velocity[0], y - 15.0 * velocity[1]
    return fleet_of([(sx, sy)], [place], velocity, shapes)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("kind", ["circle", "convex", "bracket", "cup", "comb", "trap", "gap"])
def test_a_robot_comes_to_its_place_behind_obstacles(kind, moving):
    for seed in range(SEEDS):
        went = drive(scene(kind, seed, moving), 120.0)
        assert went.seconds is not None, seed
        assert went.obstacle > CLEARANCE, seed


def test_two_robots_change_places_head_on():
    ends = [(0.0, 0.0), (3.0, 0.0)]
    went = drive(fleet_of(ends, ends[::-1], (0.0, 0.0), []), 60.0)
    assert went.seconds is not None
    assert went.pair > SAFE


def test_a_ring_of_eight_changes_places_through_its_middle():
    ring = [(2.0 * cos(2.0 * pi * k / 8.0), 2.0 * sin(2.0 * pi * k / 8.0)) for k in range(8)]
    went = drive(fleet_of(ring, ring[4:] + ring[:4], (0.0, 0.0), []), 120.0)
    assert went.seconds is not None
    assert went.pair > SAFE


def ring(count: int, radius: float, seed: int) -> list[tuple[float, float]]:
    """Points on a circle, about as far from one to the next."""
    draw = Random(f"ring {count} {seed}")
    first, step = draw.uniform(0.0, 2.0 * pi), 2.0 * pi / count
    angles = [first + step * (k + draw.uniform(-0.15, 0.15)) for k in range(count)]
    return [(radius * cos(angle), radius * sin(angle)) for angle in angles]


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.3, 0.1)])
def test_two_neighbours_in_each_others_places_exchange_them(velocity):
    """An edge holds them apart in balance, standing or with the formation that moves."""
    ends = [(0.0, 0.0), (1.0, 0.0)]
    went = drive(fleet_of(ends, ends[::-1], velocity, [], [(1, 2)]), 60.0)
    assert went.seconds is not None
    assert went.pair > SAFE
