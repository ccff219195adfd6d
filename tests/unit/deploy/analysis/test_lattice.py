"""The fleet file of a lattice: its places, who is tied to whom, where robots start."""

from __future__ import annotations

from math import hypot

import pytest

from handfast.agent.control.limits import steps
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolve, start_hands
from handfast.deploy.analysis.shapes import ROBOTS_MIN, SCATTER_M, SIDE_M, edges, is_rigid, lattice, places
from handfast.deploy.check.check import check


def test_a_patch_is_about_as_wide_as_high_and_its_middle_is_the_origin():
    spots = places(100)
    xs, ys = zip(*spots, strict=True)
    assert abs((max(xs) - min(xs)) - (max(ys) - min(ys))) < 1.5
    assert sum(xs) == pytest.approx(0.0, abs=0.01)
    assert sum(ys) == pytest.approx(0.0, abs=0.01)


def test_those_next_to_each_other_are_tied_and_nobody_else():
    spots = places(30)
    joined = {frozenset(edge) for edge in edges(spots)}
    for i, (x, y) in enumerate(spots, 1):
        for j, (u, v) in enumerate(spots[i:], i + 1):
            apart = hypot(x - u, y - v)
            assert apart > SIDE_M - 0.001
            assert (frozenset((i, j)) in joined) == (apart < 1.5 * SIDE_M)


@pytest.mark.parametrize("robots", [*range(ROBOTS_MIN, 64), 100])
def test_every_one_is_rigid_also_where_the_last_row_is_not_full(robots: int):
    spots = places(robots)
    assert is_rigid(spots, [(i - 1, j - 1) for i, j in edges(spots)])


@pytest.mark.parametrize("rate_hz", [4.0, 10.0, 20.0, 50.0])
def test_nothing_is_wrong_with_it_at_any_rate(rate_hz: float):
    fleet = parse_fleet(lattice("many", 30, rate_hz=rate_hz), source="many")
    assert [str(finding) for finding in check(fleet) if finding.level != "info"] == []


@pytest.mark.parametrize(
    ("rate_hz", "falls"), [(4.0, 0), (5.0, 0), (8.0, 1), (10.0, 1), (20.0, 1), (50.0, 1)]
)
def test_its_rate_can_fall_to_half_of_it_where_machines_cannot_keep_it(rate_hz: float, falls: int):
    fleet = parse_fleet(lattice("many", 30, rate_hz=rate_hz), source="many")
    assert steps(fleet) == falls


def test_robots_start_near_their_places_as_the_seed_has_it():
    fleet = parse_fleet(lattice("many", 12), source="many")
    spots = resolve(fleet).offsets
    assert all(
        abs(robot.x_m - x) <= SCATTER_M + 0.001 and abs(robot.y_m - y) <= SCATTER_M + 0.001
        for robot, (x, y) in zip(fleet.robots, spots, strict=True)
    )
    assert len(start_hands(fleet)) == 12
    assert lattice("many", 12) == lattice("many", 12)
    assert lattice("many", 12) != lattice("many", 12, seed=2)
