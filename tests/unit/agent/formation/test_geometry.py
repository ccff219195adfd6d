"""Formation: graph, rigidity, slots, and offsets found from distances."""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, pi, sin, sqrt
from time import perf_counter

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from agent.fleet.fleet import Fleet
from agent.fleet.sections import ControlSection, FleetSection, FormationSection, Robot, TrajectorySection
from agent.formation.geometry import (
    FormationError,
    assign_slots,
    components,
    connected,
    edge_lengths,
    is_collinear,
    is_rigid,
    loose,
    realise,
    resolve,
    resolved,
    rigidity_rank,
    start_hands,
)

H = sqrt(3.0) / 2.0
DELTA_EDGES = ((1, 2), (1, 3), (2, 3), (2, 4), (2, 5), (3, 5), (3, 6), (4, 5), (5, 6))
DELTA = ((0.0, -2 * H), (-0.5, -H), (0.5, -H), (-1.0, 0.0), (0.0, 0.0), (1.0, 0.0))
STARTS = ((-1.0, 1.4), (-0.7, -0.9), (-0.2, 0.3), (1.0, 2.0), (0.1, 1.0), (-0.18, 0.0))  # the paper's
SQUARE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
RING = ((0, 1), (1, 2), (2, 3), (3, 0))


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


# --- graph and rigidity ---


def test_components_and_connected():
    assert components(5, [(0, 1), (3, 4), (1, 0)]) == ((0, 1), (2,), (3, 4))
    assert not connected(5, [(0, 1), (3, 4)])
    assert connected(4, [(3, 2), (2, 1), (1, 0)])
    assert connected(1, [])


def test_a_triangle_is_rigid_and_a_square_without_diagonal_is_not():
    assert rigidity_rank(DELTA, np.array(DELTA_EDGES) - 1) == 9
    assert is_rigid(DELTA, np.array(DELTA_EDGES) - 1)
    assert not is_rigid(SQUARE, RING)
    assert rigidity_rank(SQUARE, RING) == 4
    assert is_rigid(SQUARE, (*RING, (0, 2)))


def test_too_few_robots_to_bend_are_rigid():
    assert is_rigid([(0.0, 0.0)], [])
    assert is_rigid([(0.0, 0.0), (1.0, 0.0)], [(0, 1)])
    assert not is_rigid([(0.0, 0.0), (1.0, 0.0)], [])


def test_robots_in_one_line_are_not_rigid_however_many_edges():
    line = [(0.0, 0.0), (0.6, 0.8), (1.2, 1.6)]
    assert is_collinear(line)
    assert not is_collinear(SQUARE)
    assert not is_rigid(line, [(0, 1), (1, 2), (0, 2)])
    assert loose(line, [(0, 1), (1, 2), (0, 2)]) == (2,)


def test_the_smallest_singular_value_of_a_long_truss_still_counts():
    places = [(k * 0.5, H * (k % 2)) for k in range(300)]
    edges = [(k, k + step) for step in (1, 2) for k in range(300 - step)]
    assert is_rigid(places, edges)
    assert not is_rigid(places, [edge for edge in edges if edge != (150, 151)])


def test_loose_robots_are_those_outside_the_largest_rigid_part():
    arm = [(0.0, 0.0), (1.0, 0.0), (0.5, 1.0), (0.5, 2.0)]
    assert loose(arm, [(0, 1), (1, 2), (0, 2), (2, 3)]) == (3,)
    assert loose(arm, [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3)]) == ()
    # Two triangles that share robot 2; the second one is the larger part with its extra robot.
    butterfly = [(-1.0, 1.0), (-1.0, -1.0), (0.0, 0.0), (1.0, 1.0), (1.0, -1.0), (2.0, 0.0)]
    edges = [(0, 1), (0, 2), (1, 2), (2, 3), (2, 4), (3, 4), (3, 5), (4, 5)]
    assert loose(butterfly, edges) == (0, 1)


def test_without_edges_all_but_the_first_are_loose():
    assert loose(SQUARE, []) == (1, 2, 3)


# --- slots ---


@pytest.mark.parametrize("n", [1, 2, 3, 7, 20, 45])
def test_assignment_costs_what_scipys_costs(n: int):
    generator = np.random.default_rng(n)
    for _ in range(20):
        cost = generator.normal(size=(n, n)) * 10.0
        slots = assign_slots(cost)
        assert sorted(slots) == list(range(n))
        rows, columns = linear_sum_assignment(cost)
        assert cost[range(n), slots].sum() == pytest.approx(cost[rows, columns].sum(), abs=1e-9)


def test_assignment_of_equal_costs_is_the_identity_and_of_none_is_empty():
    assert assign_slots(np.ones((4, 4))) == (0, 1, 2, 3)
    assert assign_slots(np.zeros((0, 0))) == ()


@pytest.mark.parametrize(("n", "limit"), [(45, 0.05), (200, 2.0)])
def test_assignment_is_fast_enough_for_places_in_the_plane(n: int, limit: float):
    generator = np.random.default_rng(3)
    a, b = generator.random((2, n, 2))
    cost = np.sum((a[:, None] - b) ** 2, axis=2)
    spent = []
    for _ in range(3):  # the best of three: this machine may be busy
        start = perf_counter()
        assign_slots(cost)
        spent.append(perf_counter() - start)
    assert min(spent) < limit


@pytest.mark.parametrize("bad", [np.ones((2, 3)), np.ones(4), np.array([[1.0, np.nan], [0.0, 1.0]])])
def test_assignment_refuses_what_is_not_square_or_not_finite(bad):
    with pytest.raises(ValueError, match="cost must be"):
        assign_slots(bad)


# --- realisation ---


def test_the_delta_is_found_from_its_distances():
    shape = realise(6, np.array(DELTA_EDGES) - 1, np.ones(9), 0.22)
    assert np.abs(shape.error).max() < 1e-9
    assert shape.offsets.mean(axis=0) == pytest.approx((0.0, 0.0), abs=1e-12)
    # unfolded: the corners of the triangle are 2 m apart, which no edge says
    corners = shape.offsets[[0, 3, 5]]
    for a in range(3):
        assert hypot(*(corners[a] - corners[a - 1])) == pytest.approx(2.0)


def test_a_chain_spreads_out():
    shape = realise(5, [(k, k + 1) for k in range(4)], np.ones(4))
    assert np.abs(shape.error).max() < 1e-9
    assert hypot(*(shape.offsets[4] - shape.offsets[0])) > 3.5


def test_rounded_distances_of_a_square_are_met_as_nearly_as_possible():
    edges = (*RING, (0, 2), (1, 3))
    shape = realise(4, edges, [1.0, 1.0, 1.0, 1.0, 1.41, 1.41])
    assert 1e-4 < np.abs(shape.error).max() < 0.004


def test_distances_that_no_plane_has_leave_an_error():
    shape = realise(4, [(a, b) for a in range(4) for b in range(a)], np.ones(6))  # a tetrahedron
    assert np.abs(shape.error).max() > 0.1


def test_a_graph_in_parts_has_no_realisation():
    with pytest.raises(FormationError, match="2 parts"):
        realise(4, [(0, 1), (2, 3)], [1.0, 1.0])


# --- resolve ---


def test_given_offsets_are_taken_as_they_are_and_distances_from_them():
    geometry = resolve(fleet())
    assert geometry.ids == (1, 2, 3, 4, 5, 6)
    assert np.array_equal(geometry.offsets, DELTA)
    assert np.array_equal(geometry.edges, np.array(DELTA_EDGES) - 1)
    assert geometry.distances == pytest.approx(np.ones(9))


def test_given_distances_are_taken_as_they_are():
    assert np.array_equal(resolve(fleet(distance_m=1.005)).distances, np.full(9, 1.005))
    each = tuple(1.0 + 0.001 * k for k in range(9))
    assert tuple(resolve(fleet(distance_m=each)).distances) == each


def test_a_geometry_cannot_be_written_to():
    geometry = resolve(fleet())
    for array in (geometry.offsets, geometry.edges, geometry.distances):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_ids_need_not_be_in_order():
    edges = tuple((10 * i, 10 * j) for i, j in DELTA_EDGES)
    geometry = resolve(fleet(edges=edges, ids=(60, 50, 40, 30, 20, 10)))
    assert geometry.ids == (60, 50, 40, 30, 20, 10)
    assert geometry.edges[0].tolist() == [5, 4]  # [10, 20] of the file


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


def test_no_turn_of_found_offsets_would_bring_them_nearer():
    given = fleet(offsets=None, distance_m=1.0)
    found, least = resolve(given), moved_squared(given)
    for angle in (-0.1, -0.001, 0.001, 0.1, pi):
        turn = np.array([[cos(angle), sin(angle)], [-sin(angle), cos(angle)]])
        for mirror in (1.0, -1.0):
            other = replace(
                given.formation,
                offsets=tuple(map(tuple, found.offsets @ turn * (mirror, 1.0))),
                distance_m=None,
            )
            assert moved_squared(replace(given, formation=other)) > least


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


def test_one_robot_alone_stands_on_the_reference():
    geometry = resolve(fleet(starts=STARTS[:1], edges=(), offsets=None))
    assert geometry.offsets.tolist() == [[0.0, 0.0]]
    assert geometry.edges.shape == (0, 2)
    assert geometry.distances.shape == (0,)


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
