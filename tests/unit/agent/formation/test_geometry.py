"""The formation of a fleet: slots, offsets that are given or found, and fields that do not fit together."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest

from handfast.agent.fleet.model import Fleet, FormationError
from handfast.agent.fleet.sections import (
    ControlSection,
    FleetSection,
    FormationSection,
    Robot,
    TrajectorySection,
)
from handfast.agent.formation.geometry import resolve, resolved, start_hands
from handfast.agent.formation.points import edge_lengths
from tests.unit.agent.formation.delta import DELTA, DELTA_EDGES

STARTS = ((-1.0, 1.4), (-0.7, -0.9), (-0.2, 0.3), (1.0, 2.0), (0.1, 1.0), (-0.18, 0.0))  # the paper's


def fleet(starts=STARTS, edges=DELTA_EDGES, offsets=DELTA, ids=None, **formation_fields) -> Fleet:
    numbers = ids or range(1, len(starts) + 1)
    return Fleet(
        FleetSection("test"),
        FormationSection(edges=edges, safe_distance_m=0.22, offsets=offsets, **formation_fields),
        ControlSection(),
        TrajectorySection("hold", start_m=(0.5, -0.5)),
        tuple(
            Robot(id=k, x_m=x, y_m=y, heading_rad=0.3 * k) for k, (x, y) in zip(numbers, starts, strict=True)
        ),
    )


def moved_squared(given: Fleet) -> float:
    """Total squared distance from the hand points to the places."""
    geometry = resolve(given)
    places = geometry.offsets + given.trajectory.start_m
    return float(np.sum((start_hands(given) - places) ** 2))


def test_given_offsets_are_taken_as_they_are_and_distances_from_them():
    geometry = resolve(fleet())
    assert geometry.ids == (1, 2, 3, 4, 5, 6)
    assert np.array_equal(geometry.offsets, DELTA)
    assert np.array_equal(geometry.edges, np.array(DELTA_EDGES) - 1)
    assert geometry.distances == pytest.approx(np.ones(9))


def test_assigned_slots_take_their_edges_with_them():
    # Robots start on each other's places: robot k on the place of slot order[k].
    order = [4, 2, 0, 5, 1, 3]
    given = fleet(starts=[DELTA[k] for k in order], assign=True)
    given = replace(given, trajectory=TrajectorySection("hold"))
    geometry = resolve(given)
    assert np.array_equal(geometry.offsets, np.array(DELTA)[order])
    robot_of_slot = {slot: robot for robot, slot in enumerate(order)}
    expected = [(robot_of_slot[i - 1], robot_of_slot[j - 1]) for i, j in DELTA_EDGES]
    assert geometry.edges.tolist() == [list(edge) for edge in expected]
    assert edge_lengths(geometry.offsets, geometry.edges) == pytest.approx(np.ones(9))


def test_slots_are_assigned_by_hand_points():
    # Two robots back to back: their centres are nearest to one pairing, their hands to the other.
    robots = (
        Robot(id=1, x_m=-0.1, y_m=0.0, heading_rad=0.0, hand_offset_m=1.0),
        Robot(id=2, x_m=0.1, y_m=0.0, heading_rad=pi, hand_offset_m=1.0),
    )
    given = replace(
        fleet(starts=STARTS[:2], edges=((1, 2),), offsets=((4.0, 0.0), (6.0, 0.0)), assign=True),
        robots=robots,
        trajectory=TrajectorySection("line", start_m=(-5.0, 0.0), velocity_mps=(1.0, 0.0)),
    )
    assert start_hands(given) == pytest.approx(np.array([[0.9, 0.0], [-0.9, 0.0]]))
    assert resolve(given).offsets.tolist() == [[6.0, 0.0], [4.0, 0.0]]


def test_assigned_slots_and_edges_keep_the_order_of_distances():
    each = tuple(float(d) for d in np.linspace(0.99, 1.01, 9))
    geometry = resolve(fleet(distance_m=each, assign=True))
    assert tuple(geometry.distances) == each
    slots = [int(np.flatnonzero((np.array(DELTA) == row).all(axis=1))[0]) for row in geometry.offsets]
    back = [tuple(slots[robot] + 1 for robot in edge) for edge in geometry.edges.tolist()]
    assert back == list(DELTA_EDGES)
    assert slots != list(range(6))  # else this test says nothing


def test_found_offsets_are_centred_and_turned_towards_the_starts():
    turned = [
        (0.5 + cos(1.0) * x + sin(1.0) * y, -0.5 + sin(1.0) * x - cos(1.0) * y)  # turned and mirrored
        for x, y in DELTA
    ]
    starts = [(x - 0.1 * cos(0.3 * k), y - 0.1 * sin(0.3 * k)) for k, (x, y) in enumerate(turned, 1)]
    geometry = resolve(fleet(starts=starts, offsets=None, distance_m=1.0))
    assert geometry.offsets.mean(axis=0) == pytest.approx((0.0, 0.0), abs=1e-12)
    wanted = np.array(turned) - (0.5, -0.5)
    assert geometry.offsets == pytest.approx(wanted - wanted.mean(axis=0), abs=1e-7)


def test_assigning_found_offsets_brings_them_nearer_still():
    free = fleet(offsets=None, distance_m=1.0)
    assigned = fleet(offsets=None, distance_m=1.0, assign=True)
    assert moved_squared(assigned) < 0.8 * moved_squared(free)
    geometry = resolve(assigned)
    assert edge_lengths(geometry.offsets, geometry.edges) == pytest.approx(np.ones(9))


@pytest.mark.parametrize("offsets", [DELTA, None])
def test_a_resolved_fleet_resolves_to_the_same_geometry(offsets):
    given = fleet(offsets=offsets, distance_m=1.0, assign=True)
    written = resolved(given)
    assert written.formation.assign is False
    assert written.formation.offsets is not None
    assert isinstance(written.formation.distance_m, tuple)
    assert (written.robots, written.control, written.fleet) == (given.robots, given.control, given.fleet)
    before, after = resolve(given), resolve(written)
    assert before.ids == after.ids
    for name in ("offsets", "edges", "distances"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    assert resolved(written) == written


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edges": ((1, 7),)}, r"\[1, 7\] names robot 7"),
        ({"edges": ((1, 1),)}, r"\[1, 1\] joins a robot with itself"),
        ({"edges": ((1, 2), (2, 1))}, r"\[2, 1\] is listed twice"),
        ({"offsets": DELTA[:5]}, "5 places for 6 robots"),
        ({"offsets": ((float("nan"), 0.0), *DELTA[1:])}, "offsets must be finite"),
        ({"offsets": None}, "neither is given"),
        ({"distance_m": (1.0, 1.0)}, "2 distances for 9 edges"),
        ({"distance_m": -1.0}, "above zero"),
        ({"ids": (1, 2, 3, 4, 5, 5)}, "unique"),
        ({"offsets": None, "distance_m": 1.0, "edges": ((1, 2), (3, 4))}, "4 parts"),
        (
            {"offsets": None, "distance_m": (1.0,) * 8 + (9.0,)},
            r"no places in the plane that meet all 9 distances",
        ),
    ],
)
def test_a_formation_that_is_none_says_why(changes, message):
    bad = fleet(**changes)
    if "9.0" in str(changes):  # an extra edge that closes a circle it cannot reach
        bad = fleet(edges=(*DELTA_EDGES[:8], (4, 6)), offsets=None, distance_m=(1.0,) * 8 + (9.0,))
    with pytest.raises(FormationError, match=message):
        resolve(bad)
