"""What a mission means, and which missions cannot be driven."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import PlanError, mission_parts, plan_of
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import NEIGHBOURS_MAX, Mission
from tests.unit.deploy.orders.order_fleets import EPOCH, SQUARE, S, first_plan, square

ROBOTS = ((4, 0.0, 1.0), (1, 0.0, 0.0), (7, 2.0, 0.0))
EDGES = ((4, 1, 1.0), (7, 1, 2.0))
CIRCLE = (("kind", "circle"), ("centre_m", (1, 2)), ("radius_m", 2.0), ("speed_mps", 0.4))


def mission(**parts: Any) -> Mission:
    return Mission(2, EPOCH, EPOCH, 60 * S, "digest", **parts)


def refused(**parts: Any) -> str:
    fleet = square()
    with pytest.raises(PlanError) as caught:
        plan_of(mission(**parts), fleet, resolve(fleet))
    return str(caught.value)


def test_an_empty_mission_is_the_fleet_file_from_the_epoch_on():
    plan = first_plan(square())
    assert plan.members == (1, 2, 3, 4)
    assert plan.offsets == {1: (0.0, 0.0), 2: (1.0, 0.0), 3: (1.0, 1.0), 4: (0.0, 1.0)}
    assert plan.edges == {(1, 2): 1.0, (2, 3): 1.0, (3, 4): 1.0, (1, 4): 1.0, (1, 3): pytest.approx(2**0.5)}
    assert (plan.from_ns, plan.trajectory_ns, plan.blend_ns) == (EPOCH, EPOCH, 0)
    assert plan.reference(EPOCH - S) == (5.0, 6.0, 0.0, 0.0, 0.0, 0.0)
    assert plan.reference(EPOCH + 10 * S) == pytest.approx((8.0, 7.0, 0.3, 0.1, 0.0, 0.0))


def test_a_mission_that_writes_all_out_is_what_it_says():
    fleet = square()
    given = mission(
        robots=ROBOTS,
        edges=EDGES,
        trajectory=CIRCLE,
        from_ns=EPOCH + S,
        blend_ns=2 * S,
        trajectory_ns=EPOCH + 3 * S,
    )
    plan = plan_of(given, fleet, resolve(fleet))
    assert plan.members == (1, 4, 7)  # in the file's order
    assert plan.edges == {(1, 4): 1.0, (1, 7): 2.0}
    assert (plan.from_ns, plan.blend_ns, plan.trajectory_ns) == (EPOCH + S, 2 * S, EPOCH + 3 * S)
    assert plan.reference(EPOCH + 3 * S)[:4] == pytest.approx((3.0, 2.0, 0.0, 0.4))


def test_a_mission_of_robots_without_edges_has_no_edges():
    fleet = square()
    assert plan_of(mission(robots=ROBOTS), fleet, resolve(fleet)).edges == {}
    assert plan_of(mission(), fleet, resolve(fleet)).edges != {}


def test_edges_alone_leave_places_as_in_the_file():
    fleet = square()
    plan = plan_of(mission(edges=((3, 1, 1.5),)), fleet, resolve(fleet))
    assert plan.edges == {(1, 3): 1.5}
    assert plan.members == (1, 2, 3, 4)


def test_the_parts_of_a_plan_make_the_same_plan_also_over_the_network():
    reference = "kind=waypoints", "speed_mps=1", "waypoints_m=[[0,0],[1,1]]"
    fleet = square(*(f"trajectory.{field}" for field in reference))
    plan = first_plan(fleet)
    robots, edges, trajectory = mission_parts(plan)
    sent = decode(encode(mission(robots=robots, edges=edges, trajectory=trajectory)))
    assert isinstance(sent, Mission)
    again = plan_of(sent, fleet, resolve(fleet))
    assert (again.members, again.offsets, again.edges) == (plan.members, plan.offsets, plan.edges)
    assert again.section == plan.section
    assert mission_parts(again) == (robots, edges, trajectory)


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"robots": ((9, 0.0, 0.0),)}, "robot 9 is not in the fleet: its ids are 1, 2, 3, 4, 7, 8"),
        ({"robots": ((1, 0.0, 0.0), (1, 1.0, 0.0))}, "robot 1 has two places"),
        ({"robots": ((1, 2e6, 0.0),)}, "the place of robot 1, [2000000.0, 0.0], is not within 1e+06 m"),
        ({"robots": ((1, float("nan"), 0.0),)}, "the place of robot 1, [nan, 0.0], is not within 1e+06 m"),
        (
            {"robots": ((1, 0.0, 0.0), (2, -0.05, 0.15))},
            "robots 1 and 2 would stand 0.1581 m apart, less than the safe distance of 0.2 m",
        ),
        (
            {"robots": ROBOTS, "edges": ((1, 2, 1.0),)},
            "the edge [1, 2] names robot 2, which has no place in the formation",
        ),
        ({"edges": ((1, 1, 1.0),)}, "the edge [1, 1] joins a robot to itself"),
        ({"edges": ((1, 2, 1.0), (2, 1, 1.0))}, "the edge [2, 1] is given twice"),
        (
            {"edges": ((1, 2, 0.2),)},
            "the edge [1, 2] is to be 0.2 m long: it must be longer than the safe distance of 0.2 m, and at "
            "most 1e+06 m",
        ),
        ({"edges": ((1, 2, float("nan")),)}, "the edge [1, 2] is to be nan m long"),
        (
            {"trajectory": (("kind", "spiral"),)},
            'the mission\'s trajectory.kind: must be one of "line", "waypoints", "circle", "hold", got "spi',
        ),
        ({"trajectory": (("speed", 1.0),)}, "the mission's trajectory.speed: unknown field"),
        (
            {"trajectory": (*CIRCLE[:3], ("speed_mps", -1.0))},
            "the mission's trajectory.speed_mps: must be more",
        ),
        (
            {"trajectory": (*CIRCLE[:3], ("speed_mps", True))},
            "the mission's trajectory.speed_mps: must be a num",
        ),
        ({"trajectory": CIRCLE[:3]}, "the mission's trajectory.speed_mps: is missing"),
        ({"trajectory": (*CIRCLE, ("start_m", (0.0, 0.0)))}, "the mission's trajectory.start_m: is used by"),
        ({"trajectory": (*CIRCLE, ("radius_m", 1.0))}, "the mission gives a field of its trajectory twice"),
        (
            {
                "trajectory": (
                    ("kind", "waypoints"),
                    ("speed_mps", 1.0),
                    ("waypoints_m", ((0.0, 0.0), (1.0,))),
                )
            },
            "the mission's trajectory.waypoints_m[2]: must be an array of 2 numbers (m), got 1: [1.0]",
        ),
    ],
)
def test_what_cannot_be_driven_is_refused_with_one_sentence(parts: dict[str, Any], said: str):
    message = refused(**parts)
    assert message.startswith(said)
    assert "\n" not in message


def test_edges_of_one_robot_are_as_many_as_its_messages_hold():
    count = NEIGHBOURS_MAX + 2
    text = SQUARE + "".join(f"\n[[robot]]\nid = {100 + k}\nx_m = {k}\ny_m = 9\n" for k in range(count))
    fleet = square("formation.offsets=" + str([[k, 0] for k in range(count + 4)]), text=text)
    geometry = resolve(fleet)
    most = tuple((1, 100 + k, 1.0) for k in range(NEIGHBOURS_MAX))
    assert len(plan_of(mission(edges=most), fleet, geometry).edges) == NEIGHBOURS_MAX
    with pytest.raises(PlanError, match=f"robot 1 has {NEIGHBOURS_MAX + 1} edges: it can have"):
        plan_of(mission(edges=(*most, (1, 100 + NEIGHBOURS_MAX, 1.0))), fleet, geometry)


@pytest.mark.parametrize(("x", "y"), [(0.19, 0.0), (0.0, -0.19), (-0.14, 0.14), (-0.19, 0.01)])
def test_a_pair_is_found_in_whatever_cells_it_is(x: float, y: float):
    for at in (0.0, 0.1, 0.199, -0.2, 57.3):
        places = ((1, at, at), (2, at + 3.0, at), (3, at + x, at + y))
        assert refused(robots=places).startswith("robots 1 and 3 would stand 0.19")
