"""Robots that something holds away from their places: they say what it is, and arrive."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.console.arguments import fleet_path, fleet_text
from handfast.deploy.recording.recording import Recording
from handfast.deploy.sweep import run
from handfast.deploy.sweep.plan import Question, make_plan
from tests.benchmarks.arrival import drive
from tests.benchmarks.crowd import ACROSS, SIDE_M, field
from tests.benchmarks.swaps import swap

SAFE = 0.22
THERE_M = 0.1

SCENE = """
fleet = {{ name = "scene", duration_s = {duration_s} }}
formation = {{ edges = [{edges}], offsets = [{places}], safe_distance_m = 0.22 }}
trajectory = {{ kind = "line", start_m = [0.0, 0.0], velocity_mps = [{speed}, 0.0] }}
faults.rule = [{faults}]
robot = [{robots}]
"""


def scene(starts, places, edges="", *, faults="", speed=0.0, duration_s=40, reserve=()) -> Fleet:
    """Robots whose hand points start at `starts`."""
    rest = dict.fromkeys(reserve, ", reserve = true")
    text = SCENE.format(
        duration_s=duration_s,
        edges=edges,
        places=", ".join(f"[{x}, {y}]" for x, y in places),
        speed=speed,
        faults=faults,
        robots=", ".join(
            f"{{ id = {n}, x_m = {x - 0.1}, y_m = {y}{rest.get(n, '')} }}"
            for n, (x, y) in enumerate(starts, 1)
        ),
    )
    return resolved(parse_fleet(text, source="scene.toml"))


def driven(fleet: Fleet) -> tuple[Recording, Analysis]:
    recording = run.drive(fleet)
    return recording, analyse(recording, resolve(fleet))


def away(a: Analysis) -> np.ndarray:
    """How far the robots are off their places at the end, m."""
    return np.hypot(*(a.hands[-1] - a.desired[-1]).T)


def closest(a: Analysis) -> float:
    pairs = combinations(range(len(a.ids)), 2)
    return min(float(np.nanmin(np.hypot(*(a.hands[:, i] - a.hands[:, j]).T))) for i, j in pairs)


def reasons(recording: Recording, robot: int) -> list[str]:
    """Reasons that a robot gave for being degraded, in turn."""
    found: list[str] = []
    for t in np.arange(0.0, recording.end_s, 0.25):
        state, reason = recording.robots[robot].status.at(float(t)) or ("", "")
        if state == "degraded" and reason not in found[-1:]:
            found.append(reason)
    return found


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_two_neighbours_in_each_others_places_say_so_and_exchange_them(speed: float):
    recording, a = driven(scene([(0.5, 0.0), (-0.5, 0.0)], [(-0.5, 0.0), (0.5, 0.0)], "[1, 2]", speed=speed))
    assert (away(a) < THERE_M).all()
    assert closest(a) > SAFE
    if speed == 0.0:
        assert reasons(recording, 1)[0] == "on its way out of a wrong rest point with robot 2"


@pytest.mark.parametrize("edges", ["[1, 3], [2, 3]", "[1, 2], [2, 3], [1, 3]"])
def test_a_dead_body_straight_on_the_way_is_driven_round(edges: str):
    """Its agent is killed where it stands, for good."""
    fleet = scene(
        [(0.0, 0.0), (-2.5, 0.0), (-2.5, 1.0)],
        [(0.0, 0.0), (1.5, 0.0), (1.5, 1.0)],
        edges,
        faults='{ robot = 1, kill = "agent", at = "0.5s" }',
    )
    recording, a = driven(fleet)
    assert (away(a)[1:] < THERE_M).all()
    assert closest(a) > SAFE
    assert any("on its way round robot 1" in reason for reason in reasons(recording, 2))


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("run", [6, 7])
def test_a_crowd_whose_ways_cross_comes_through_ten_obstacles(run: int):
    """Starts of which some robots were still on their way after two minutes, or at rest in others' places."""
    path = fleet_path("lattice45")
    overrides = (*ACROSS, "fleet.rate_hz=25", "fleet.duration_s=90")
    question = Question(str(path), fleet_text(path) + field(), "joint", overrides, (), run + 1, SIDE_M)
    went = drive(make_plan(question).fleet(run))
    assert went.seconds is not None
    assert went.pair_m > SAFE


@pytest.mark.slow
def test_twenty_robots_swap_across_a_circle():
    went = drive(swap(20, 4.0, 90.0, True, 0))
    assert went.seconds is not None
    assert went.pair_m > SAFE


@pytest.mark.parametrize(("beside", "arrives"), [(0.41, True), (0.3, True), (0.1, False)])
def test_a_body_that_stays_beside_a_place_does_not_push_its_robot_off_it(beside: float, arrives: bool):
    """A robot in reserve, nearer than robots without an edge push each other apart; nearer than the safe
    distance and the margin it has the place."""
    starts = [(3.0, 0.6), (2.4, -0.3), (3.6, -0.3), (-0.6, beside - 0.3)]
    places = [(0.0, 0.6), (-0.6, -0.3), (0.6, -0.3)]
    recording, a = driven(scene(starts, places, "[1, 2], [2, 3], [1, 3]", reserve=(4,)))
    assert closest(a) > SAFE
    assert (away(a)[:3] < THERE_M).all() == arrives
    assert ("its place is taken by robot 4 (does not follow)" in reasons(recording, 2)) is not arrives
