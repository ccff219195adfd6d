"""Orders of an operator made into missions: what they change, and which cannot be carried out."""

from __future__ import annotations

from dataclasses import replace
from math import dist, sqrt
from typing import Any

import pytest

from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection, ShapeSection
from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.mission_plan import Plan, mission_parts
from handfast.agent.messages.codec import decode, encode, newer
from handfast.agent.messages.types import Removed
from handfast.deploy.orders.blend_time import BLEND_MAX_S
from handfast.deploy.orders.mission_editing import LEAD_NS, OrderError, first_mission, must_be_known, ordered
from tests.unit.deploy.orders.order_fleets import EPOCH, S, after, first_plan, order, square

FLEET = square()
FIRST = first_plan(FLEET)


def plan_after(what: OrderSection, plan: Plan = FIRST, fleet: Fleet = FLEET, **rest: Any) -> Plan:
    return after(what, plan, fleet, **rest)[1]


def refused(what: OrderSection, plan: Plan = FIRST, fleet: Fleet = FLEET) -> str:
    with pytest.raises(OrderError) as caught:
        ordered(what, plan, fleet, EPOCH + 10 * S, 2)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_first_mission_is_the_fleet_file():
    mission = first_mission(FLEET, 5, EPOCH - S, EPOCH, 60 * S)
    assert mission[:5] == (5, EPOCH - S, EPOCH, 60 * S, digest(FLEET))
    assert not any(mission[5:])


def test_what_is_not_ordered_stays():
    mission, plan = after(order("join", robot=7, edges=(2, 3), distance_m=1.0), FIRST, FLEET)
    assert mission[:5] == (2, EPOCH + 10 * S, *FIRST.mission[2:5])
    assert newer(mission, FIRST.mission)
    assert decode(encode(mission)) == mission
    assert plan.section == FIRST.section
    assert plan.trajectory_ns == FIRST.trajectory_ns
    assert {r: plan.offsets[r] for r in FIRST.members} == FIRST.offsets
    assert {e: plan.edges[e] for e in FIRST.edges} == FIRST.edges


# --- times ------------------------------------------------------------------------------------


@pytest.mark.parametrize("at_s", [10.0, 10.001, 10.019, 10.02, 37.5])
def test_an_order_is_taken_over_on_the_first_tick_after_the_lead(at_s: float):
    mission, _ = after(order("leave", robot=2), FIRST, FLEET, at_s=at_s)
    assert mission.from_ns % FLEET.period_ns == 0
    assert 0 < mission.from_ns - mission.time_ns - LEAD_NS <= FLEET.period_ns


def test_an_order_waits_for_the_one_before_it():
    """Two at once: the second begins after the first, so that no robot jumps over what was between."""
    first = plan_after(order("leave", robot=2))
    second, _ = after(order("leave", robot=4), first, FLEET)
    assert second.from_ns == first.from_ns + FLEET.period_ns
    assert second.version == 3


def test_an_order_before_the_drive_holds_from_its_begin():
    for at_s in (-30.0, -1.02):
        mission, _ = after(order("leave", robot=2, over_s=5.0), FIRST, FLEET, at_s=at_s)
        assert (mission.from_ns, mission.blend_ns) == (EPOCH, 0)
    again, plan = after(order("leave", robot=4), plan_after(order("leave", robot=2), at_s=-5), FLEET, at_s=-4)
    assert (again.from_ns, plan.members) == (EPOCH, (1, 3))
    assert after(order("leave", robot=2), FIRST, FLEET, at_s=-0.9)[0].from_ns > EPOCH


def test_over_s_is_the_blend():
    assert plan_after(order("leave", robot=2, over_s=2.5)).blend_ns == 2.5 * S
    assert plan_after(order("leave", robot=2)).blend_ns == S


# --- join -------------------------------------------------------------------------------------


def test_who_joins_by_three_distances_has_one_place():
    wanted = (1.7, 0.4)
    ends = (1, 2, 4)
    distances = tuple(round(dist(wanted, FIRST.offsets[end]), 2) for end in ends)
    plan = plan_after(order("join", robot=8, edges=ends, distance_m=distances))
    assert dist(plan.offsets[8], wanted) < 0.02
    assert tuple(plan.edges[end, 8] for end in ends) == distances


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (
            order("join", robot=9, edges=(1,)),
            "robot 9 is not in the fleet: its ids are 1, 2, 3, 4, 7, 8",
        ),
        (order("join", robot=2, edges=(1,)), "robot 2 has a place in the formation already"),
        (
            order("join", robot=7, edges=(8,)),
            "robot 8 has no place in the formation: members are 1, 2, 3 and 4",
        ),
        (
            order("join", robot=7, edges=(7,)),
            "robot 7 has no place in the formation: members are 1, 2, 3 and 4",
        ),
        (order("join", robot=7, edges=(2, 2)), "robot 7 is to share an edge with robot 2 twice"),
        (order("join", edges=(2, 3)), "join needs robot"),
        (order("join", robot=7), "join needs edges"),
        (
            order("join", robot=7, edges=()),
            "where robot 7 is to be is not known without edges: give offset_m",
        ),
        (
            order("join", robot=7, edges=(2, 3), distance_m=(1.0,)),
            "distance_m has 1 distances for 2 edges",
        ),
        (
            order("join", robot=7, edges=(2, 4), distance_m=0.5),
            "no place for robot 7 is 0.5 m from robot 2 and 0.5 m from robot 4",
        ),
        (
            order("join", robot=7, edges=(2,), offset_m=(2.0, 0.0), distance_m=1.1),
            "robot 7 at [2, 0] would be 1 m from robot 2, not 1.1 m",
        ),
        (
            order("join", robot=7, edges=(2,), offset_m=(0.9, 1.1)),
            "robots 3 and 7 would stand 0.1414 m apart, less than the safe distance of 0.2 m",
        ),
        (
            order("join", robot=7, edges=(2,), distance_m=0.15),
            "robots 2 and 7 would stand 0.15 m apart, less than the safe distance of 0.2 m",
        ),
    ],
)
def test_who_cannot_join_is_told_why(what: OrderSection, said: str):
    assert refused(what) == said


# --- leave, replace ---------------------------------------------------------------------------


def test_who_leaves_takes_its_edges_along():
    mission, plan = after(order("leave", robot=2), FIRST, FLEET)
    assert plan.members == (1, 3, 4)
    assert set(plan.edges) == {(3, 4), (1, 4), (1, 3)}
    assert mission.note == "robot 2 leaves"


def test_a_leave_that_cuts_the_graph_says_so_once():
    cut = plan_after(order("reshape", formation=ShapeSection(edges=((1, 2), (2, 3), (3, 4)))))
    mission, plan = after(order("leave", robot=3), cut, FLEET)
    assert mission.note == "robot 3 leaves; the formation graph falls into 2 parts"
    assert after(order("leave", robot=2), plan, FLEET)[0].note == "robot 2 leaves"  # in two parts before


def test_who_has_left_can_join_again():
    left = plan_after(order("leave", robot=2))
    assert plan_after(order("join", robot=2, edges=(1, 3), distance_m=1.0), left).offsets[2] == (
        pytest.approx((1.0, 0.0))
    )


def test_the_last_one_cannot_leave():
    alone = FIRST
    for robot in (1, 2, 3):
        alone = plan_after(order("leave", robot=robot), alone)
    assert refused(order("leave", robot=4), alone) == (
        "robot 4 is the last one in the formation: stop the fleet instead"
    )
    assert refused(order("leave", robot=1), alone).startswith("robot 1 has no place in the formation")


def test_who_replaces_another_takes_its_place_and_edges():
    mission, plan = after(order("replace", robot=3, by=7), FIRST, FLEET)
    assert plan.members == (1, 2, 4, 7)
    assert plan.offsets[7] == FIRST.offsets[3]
    assert plan.edges == {(2, 7): 1.0, (4, 7): 1.0, (1, 2): 1.0, (1, 4): 1.0, (1, 7): sqrt(2)}
    assert mission.note == "robot 7 takes the place of robot 3"
    assert refused(order("replace", robot=7, by=8)).startswith("robot 7 has no place")
    assert refused(order("replace", robot=3, by=1)) == "robot 1 has a place in the formation already"
    assert refused(order("replace", robot=3, by=3)) == "robot 3 has a place in the formation already"
    assert refused(order("replace", robot=3)) == "replace needs by"


# --- remove -----------------------------------------------------------------------------------


def rows(plan: Plan) -> dict[int, float]:
    """Who has been removed, and when, s after the epoch."""
    return {robot: (time_ns - EPOCH) / S for robot, time_ns in plan.mission.removed}


def test_a_body_that_is_removed_loses_its_place_as_who_leaves_does():
    mission, plan = after(order("remove", robots=(2,)), FIRST, FLEET, at_s=10.0)
    left = plan_after(order("leave", robot=2))
    assert (plan.members, plan.offsets, plan.edges) == (left.members, left.offsets, left.edges)
    assert mission.note == "robot 2 has been removed"
    assert mission.removed == (Removed(2, EPOCH + 10 * S),)


def test_a_body_without_a_place_is_removed_and_nothing_else_changes():
    mission, plan = after(order("remove", robots=(8, 7)), FIRST, FLEET, at_s=10.0)
    assert (plan.members, plan.offsets, plan.edges) == (FIRST.members, FIRST.offsets, FIRST.edges)
    assert plan.trajectory_ns == FIRST.trajectory_ns
    assert mission.note == "robots 8 and 7 have been removed"
    assert rows(plan) == {7: 10.0, 8: 10.0}


@pytest.mark.parametrize(
    "what",
    [order("join", robot=2, edges=(1,), distance_m=1.0), order("replace", robot=3, by=2)],
    ids=["join", "replace"],
)
def test_who_was_removed_gets_a_place_again_once_it_is_heard(what: OrderSection):
    plan = plan_after(order("remove", robots=(8, 2)), at_s=10.0)
    with pytest.raises(OrderError) as caught:
        ordered(what, plan, FLEET, EPOCH + 20 * S, 9, heard=(1, 3, 4, 7))
    assert str(caught.value) == ("robot 2 has been removed, and is not heard: start its agent again first")
    assert must_be_known(what, plan) == (2,)
    assert must_be_known(what, FIRST) == ()
    back = ordered(what, plan, FLEET, EPOCH + 20 * S, 9, heard=(1, 2, 3, 4, 7))
    assert back.removed == (Removed(8, EPOCH + 10 * S),)
    assert ordered(what, plan, FLEET, EPOCH + 20 * S, 9).removed == back.removed  # before the drive


@pytest.mark.parametrize(
    ("robots", "said"),
    [
        ((2,), "the agent of robot 2 is heard: only the body of one whose agent is silent can be removed"),
        (
            (2, 3, 8),
            "the agents of robots 2 and 3 are heard: only the body of one whose agent is silent "
            "can be removed",
        ),
        ((8,), None),
        ((4, 7), None),
    ],
)
def test_only_the_silent_are_removed(robots: tuple[int, ...], said: str | None):
    what = order("remove", robots=robots)
    assert must_be_known(what, FIRST) == robots
    if said is None:
        assert ordered(what, FIRST, FLEET, EPOCH, 9, heard=(1, 2, 3)).removed
        return
    with pytest.raises(OrderError) as caught:
        ordered(what, FIRST, FLEET, EPOCH, 9, heard=(1, 2, 3))
    assert str(caught.value) == said


def test_others_leave_and_join_whoever_is_heard():
    for what in (order("leave", robot=2), order("join", robot=7, edges=(1,)), order("reshape", scale=2.0)):
        assert ordered(what, FIRST, FLEET, EPOCH, 9, heard=()).note


def test_who_cannot_be_removed_is_told_why():
    assert refused(order("remove", robots=(9,))) == (
        "robot 9 is not in the fleet: its ids are 1, 2, 3, 4, 7, 8"
    )
    assert refused(order("remove", robots=())) == "remove names no robot"
    assert refused(order("remove")) == "remove needs robots"
    assert refused(order("remove", robots=(1, 2, 3, 4, 7))) == (
        "without robots 1, 2, 3, 4 and 7 nobody is left in the formation: let another take a place first "
        "(replace, join), or stop the fleet instead"
    )
    alone = FIRST
    for robot in (1, 2, 3):
        alone = plan_after(order("remove", robots=(robot,)), alone)
    assert refused(order("remove", robots=(4,)), alone).startswith("without robot 4 nobody is left")
    assert plan_after(order("remove", robots=(7,)), alone).members == (4,)


def test_a_removal_that_cuts_the_graph_says_so():
    cut = plan_after(order("reshape", formation=ShapeSection(edges=((1, 2), (2, 3), (3, 4)))))
    mission, _ = after(order("remove", robots=(3,)), cut, FLEET)
    assert mission.note == "robot 3 has been removed; the formation graph falls into 2 parts"


# --- reshape ----------------------------------------------------------------------------------


def test_scale_makes_all_of_it_larger():
    mission, plan = after(order("reshape", scale=1.5), FIRST, FLEET)
    assert plan.offsets[3] == (1.5, 1.5)
    assert plan.edges[1, 3] == pytest.approx(1.5 * sqrt(2))
    assert mission.note == "reshaped: 1.5 times the size"


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (order("reshape"), "reshape changes nothing: give formation, scale or trajectory"),
        (
            order("reshape", formation=ShapeSection(offsets=((0.0, 0.0),))),
            "formation.offsets has 1 places for 4 robots: one each for 1, 2, 3 and 4",
        ),
        (
            order("reshape", formation=ShapeSection(edges=((1, 7),))),
            "robot 7 has no place in the formation: members are 1, 2, 3 and 4",
        ),
        (
            order("reshape", formation=ShapeSection(edges=((1, 2), (2, 1)))),
            "the edge [2, 1] is given twice",
        ),
        (
            order("reshape", formation=ShapeSection(edges=((1, 1),))),
            "the edge [1, 1] joins a robot to itself",
        ),
        (
            order("reshape", formation=ShapeSection(distance_m=(1.0,))),
            "formation.distance_m has 1 distances for 5 edges",
        ),
        (
            order("reshape", formation=ShapeSection(edges=(), distance_m=1.0)),
            "formation.distance_m is given, but the formation has no edges",
        ),
        (
            order("reshape", formation=ShapeSection(distance_m=(1.0, 1.0, 1.0, 1.0, 3.0))),
            "found no places that meet all 5 distances: in the nearest [1, 2] is 1.25 m long, not",
        ),
        (order("reshape", scale=0.15), "robots 1 and 2 would stand 0.15 m apart, less than the safe distan"),
        (
            order("reshape", trajectory=TrajectorySection("line")),
            "the mission's trajectory.velocity_mps: must be an array of 2 numbers (m/s), such as",
        ),
        (order("stop"), 'an order of kind "stop" does not change the mission'),
    ],
)
def test_what_cannot_be_the_new_formation_is_told_why(what: OrderSection, said: str):
    assert refused(what).startswith(said)


def test_a_new_line_goes_on_from_where_the_formation_is():
    """Half way through the blend: so it goes from one velocity to the other without overtaking itself."""
    line = TrajectorySection("line", velocity_mps=(0.0, -0.5))
    mission, plan = after(order("reshape", trajectory=line), FIRST, FLEET)
    assert plan.trajectory_ns == plan.from_ns
    middle_ns = plan.from_ns + plan.blend_ns // 2
    assert plan.reference(middle_ns)[:2] == pytest.approx(FIRST.reference(middle_ns)[:2])
    assert mission.note == "new trajectory (line)"
    aside = plan_after(order("reshape", trajectory=replace(line, start_m=(1.0, 2.0))))
    middle_ns = aside.from_ns + aside.blend_ns // 2
    x, y = FIRST.reference(middle_ns)[:2]
    assert aside.reference(middle_ns)[:2] == pytest.approx((x + 1.0, y + 2.0))
    at_once = plan_after(order("reshape", trajectory=line), at_s=-3.0)
    assert at_once.reference(EPOCH)[:2] == FIRST.reference(EPOCH)[:2]


def test_what_the_blend_makes_too_far_or_too_long_to_be_sent_is_refused(monkeypatch: pytest.MonkeyPatch):
    """The line, and what is left, are known only with the blend."""
    line = TrajectorySection("line", velocity_mps=(-10.0, 0.0), start_m=(1e6 - 10.0, 0.0))
    assert "start_m" in refused(order("reshape", trajectory=line, over_s=600.0))
    here, other = (TrajectorySection("line", velocity_mps=(speed, 0.0)) for speed in (0.2, 0.3))
    size = len(encode(plan_after(order("reshape", trajectory=here)).mission))
    monkeypatch.setattr("handfast.agent.messages.codec.MISSION_BYTES_MAX", size - 1)
    monkeypatch.setattr("handfast.agent.messages.codec.BYTES_MAX", size - 1)
    assert refused(order("reshape", trajectory=other)).startswith("the new mission cannot be sent: oversized")


# --- length of the blend ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "given", [{"scale": 1000.0}, {"trajectory": TrajectorySection("hold", start_m=(9e5, 0.0))}]
)
def test_what_no_blend_does_is_refused_but_where_it_is_said_how_long(given: Any):
    """Places would move faster than robots may."""
    with pytest.raises(
        OrderError, match=f"^it needs more than {BLEND_MAX_S:g} s to keep the limits of"
    ) as refused:
        plan_after(order("reshape", **given))
    assert "order it in parts" in str(refused.value)
    assert "left of the change before" not in str(refused.value)
    assert plan_after(order("reshape", **given, over_s=30.0)).blend_ns == 30 * S
    there = TrajectorySection("hold", start_m=(9e4, 0.0))
    far = plan_after(order("reshape", trajectory=there, over_s=600.0))
    with pytest.raises(OrderError, match="by what is left of the change before it: order it in parts"):
        plan_after(order("reshape", scale=0.5), far, at_s=12.0)
    assert plan_after(order("leave", robot=2), far, at_s=12.0).blend_ns == BLEND_MAX_S * S


def test_orders_one_after_another_build_on_each_other():
    plan = FIRST
    for what in (
        order("join", robot=7, edges=(2, 3), distance_m=1.0),
        order("reshape", scale=2.0),
        order("replace", robot=1, by=8),
        order("leave", robot=3),
    ):
        plan = plan_after(what, plan)
    assert plan.mission.version == 5
    assert plan.members == (2, 4, 7, 8)
    assert plan.edges == {(2, 8): 2.0, (4, 8): 2.0, (2, 7): 2.0}
    assert mission_parts(plan)[0][2] == (7, *plan.offsets[7])
