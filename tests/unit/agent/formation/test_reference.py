"""The course: missions taken one after another, what each robot is to do, and who its neighbours are."""

from __future__ import annotations

from math import hypot
from typing import Any

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import Plan, mission_parts, plan_of
from handfast.agent.formation.reference import WITHIN_MAX, Edge, Reference
from handfast.agent.messages.codec import Mark, tag
from handfast.agent.messages.types import Mission
from tests.unit.deploy.orders.order_fleets import EPOCH, S, after, first_plan, order, square

FLEET = square()
GEOMETRY = resolve(FLEET)
FIRST = first_plan(FLEET)


def reference(*plans: Plan, fleet: Fleet = FLEET) -> Reference:
    made = Reference(fleet, resolve(fleet))
    for plan in plans:
        made.take(plan)
    return made


def changed(what: Any, before: Plan = FIRST, **rest: Any) -> Plan:
    return after(what, before, FLEET, **rest)[1]


def at(plan: Plan, share: float) -> int:
    """The time at which so much of the plan's blend is over."""
    return plan.from_ns + round(share * plan.blend_ns)


JOIN = order("join", robot=7, edges=(2, 3), distance_m=1.0, over_s=4.0)
LEAVE = order("leave", robot=2, over_s=4.0)
LARGER = order("reshape", scale=2.0, over_s=4.0)


def test_before_any_mission_the_formation_of_the_file_stands_where_its_trajectory_begins():
    made = reference()
    assert made.plan is None
    assert made.members(EPOCH) == (1, 2, 3, 4)
    assert made.motion(3, EPOCH) == (6.0, 7.0, 0.0, 0.0, 0.0, 0.0)
    assert made.motion(7, EPOCH) is None
    assert made.edges(1, EPOCH) == (Edge(2, 1.0, 1.0), Edge(3, pytest.approx(2**0.5), 1.0), Edge(4, 1.0, 1.0))


def test_the_first_mission_starts_the_trajectory_at_its_epoch():
    made = reference(FIRST)
    assert made.plan is made.active(0) is FIRST
    assert made.motion(2, EPOCH - S) == (6.0, 6.0, 0.0, 0.0, 0.0, 0.0)
    assert made.motion(2, EPOCH + S) == pytest.approx((6.3, 6.1, 0.3, 0.1, 0.0, 0.0))


def test_a_blend_comes_from_what_was_to_what_is():
    larger = changed(LARGER)
    made = reference(FIRST, larger)
    for share, part, rate in ((0.0, 0.0, 0.0), (0.5, 0.5, 15 / 8), (1.0, 1.0, 0.0), (3.0, 1.0, 0.0)):
        time_ns = at(larger, share)
        x, y = FIRST.reference(time_ns)[:2]
        speed = rate / 4.0  # robot 2 goes from (1, 0) to (2, 0) in 4 s
        assert made.motion(2, time_ns) == pytest.approx((x + 1 + part, y, 0.3 + speed, 0.1, 0.0, 0.0))
        apart, growing = pytest.approx(1 + part), pytest.approx(speed, abs=1e-9)
        ends = Edge(1, apart, 1.0, growing, pytest.approx(0.0, abs=1e-9))
        assert made.edges(2, time_ns) == (ends, ends._replace(other=3))
    assert made.active(larger.from_ns - 1) is FIRST
    assert made.active(larger.from_ns) is larger


def test_a_robot_that_joins_is_at_its_place_at_once_and_its_edges_come():
    join = changed(JOIN)
    made = reference(FIRST, join)
    x, y = FIRST.reference(join.from_ns)[:2]
    assert made.motion(7, join.from_ns - 1) is None
    assert not made.is_member(7, join.from_ns - 1)
    assert made.motion(7, join.from_ns) == pytest.approx((x + 1.8660, y + 0.5, 0.3, 0.1, 0, 0), abs=1e-4)
    assert made.edges(7, join.from_ns) == ()  # no weight yet
    assert made.edges(7, at(join, 0.5)) == (
        Edge(2, pytest.approx(1.0), 0.5),
        Edge(3, pytest.approx(1.0), 0.5),
    )
    assert Edge(7, pytest.approx(1.0), 0.5) in made.edges(2, at(join, 0.5))
    assert made.edges(7, at(join, 1.0)) == (Edge(2, 1.0, 1.0), Edge(3, 1.0, 1.0))
    assert made.motion(2, at(join, 0.5)) == pytest.approx(reference(FIRST).motion(2, at(join, 0.5)))


def test_a_later_mission_for_an_earlier_time_takes_the_place_of_the_one_before():
    leave = changed(LEAVE, at_s=20.0)
    larger = changed(LARGER, at_s=15.0)
    assert larger.from_ns < leave.from_ns
    made = reference(FIRST, leave, version(larger, 3))
    assert made.is_member(2, leave.from_ns + S)
    # the other way round it comes after it
    both = reference(FIRST, larger, version(leave, 3))
    assert both.motion(1, at(larger, 0.5)) == reference(FIRST, larger).motion(1, at(larger, 0.5))
    assert not both.is_member(2, leave.from_ns)


def version(plan: Plan, number: int) -> Plan:
    return plan_of(plan.mission._replace(version=number), FLEET, GEOMETRY)


def test_of_two_missions_of_one_version_the_same_wins_whichever_comes_first():
    a, b = changed(LARGER), changed(LEAVE)
    one, other = reference(FIRST, a, b), reference(FIRST, b, a)
    assert one.plan is other.plan


def test_who_missed_the_first_mission_supposes_the_files_until_the_next_is_taken_over():
    larger = changed(LARGER)
    made = reference(larger)
    assert made.motion(2, larger.from_ns - S) == reference(FIRST).motion(2, larger.from_ns - S)
    assert made.motion(2, at(larger, 0.3)) == reference(FIRST, larger).motion(2, at(larger, 0.3))


def test_a_mission_for_before_the_epoch_holds_from_the_beginning():
    join = changed(JOIN, at_s=-1.5)
    assert (join.from_ns, join.blend_ns) == (EPOCH, 0)
    made = reference(FIRST, join)
    assert made.members(EPOCH - 10 * S) == (1, 2, 3, 4, 7)
    assert made.edges(7, EPOCH - 10 * S) == (Edge(2, 1.0, 1.0), Edge(3, 1.0, 1.0))
    x, y = FIRST.reference(EPOCH)[:2]
    assert made.motion(7, EPOCH - S) == pytest.approx((x + 1.8660, y + 0.5, 0, 0, 0, 0), abs=1e-4)


def test_a_mission_of_another_epoch_begins_anew():
    larger = changed(LARGER)
    again = plan_of(Mission(9, EPOCH, EPOCH + 100 * S, 60 * S, "x"), FLEET, GEOMETRY)
    made = reference(FIRST, larger, again)
    assert made.motion(2, EPOCH + 90 * S) == (6.0, 6.0, 0.0, 0.0, 0.0, 0.0)
    assert made.active(EPOCH + 20 * S) is again
    larger_again = plan_of(
        larger.mission._replace(version=10, epoch_ns=EPOCH + 100 * S, from_ns=EPOCH + 120 * S),
        FLEET,
        GEOMETRY,
    )
    made = reference(FIRST, larger, larger_again)  # it missed the first mission of the new drive
    assert made.motion(2, EPOCH + 90 * S) == (6.0, 6.0, 0.0, 0.0, 0.0, 0.0)
    assert made.motion(2, EPOCH + 110 * S) == pytest.approx((9.0, 7.0, 0.3, 0.1, 0.0, 0.0))


def test_a_mission_changes_what_has_been_asked_for_before():
    larger = changed(LARGER)
    made = reference(FIRST)
    time_ns = at(larger, 0.5)
    was = made.motion(2, time_ns), made.edges(2, time_ns)
    made.take(larger)
    assert (made.motion(2, time_ns), made.edges(2, time_ns)) != was
    assert made.motion(2, time_ns) == reference(FIRST, larger).motion(2, time_ns)


def many(count: int, every_s: float, blend_s: float, before: tuple[Plan, ...] = (FIRST,)) -> list[Plan]:
    """Missions, by each of which all places are 0.1 m further east."""
    plans = list(before)
    for _ in range(count):
        robots, edges, trajectory = mission_parts(plans[-1])
        last = plans[-1].mission
        mission = last._replace(
            version=last.version + 1,
            from_ns=max(last.from_ns, EPOCH) + round(every_s * S),
            blend_ns=round(blend_s * S),
            trajectory_ns=EPOCH,
            trajectory=trajectory,
            robots=tuple((robot, x + 0.1, y) for robot, x, y in robots),
            edges=edges,
        )
        plans.append(plan_of(mission, FLEET, GEOMETRY))
    return plans


@pytest.mark.parametrize(("every_s", "blend_s"), [(0.2, 4.0), (2.0, 1.5), (3.0, 60.0)])
def test_however_many_changes_meet_each_other_the_motion_is_continuous(every_s: float, blend_s: float):
    """Below one that lasts for long."""
    larger = changed(order("reshape", scale=4.0, over_s=100.0))
    plans = many(WITHIN_MAX + 9, every_s, blend_s, (FIRST, larger))
    made, near_ns = reference(), 1_000
    for plan in plans:
        before = made.frozen()
        made.take(plan)
        if plan is FIRST:
            continue
        was, now = (before.motion(2, plan.from_ns), made.motion(2, plan.from_ns))
        assert now == pytest.approx(was, abs=1e-9), "position, velocity and acceleration"
        earlier, later = (made.motion(2, plan.from_ns + side * near_ns) for side in (-1, 1))
        assert later == pytest.approx(earlier, abs=1e-4)
        were, are = (
            {edge.other: (edge.distance, edge.weight) for edge in each.edges(2, plan.from_ns)}
            for each in (before, made)
        )
        assert are == {other: pytest.approx(edge, abs=1e-9) for other, edge in were.items()}
    end_ns = at(plans[-1], 1.0)
    assert made.motion(2, end_ns) == pytest.approx(reference(FIRST, plans[-1]).motion(2, end_ns))


def test_what_is_left_of_many_changes_carries_nobody_far():
    plans = [FIRST]
    for k in range(WITHIN_MAX + 4):
        x, y = ((2.0, 6.0), (-2.0, 0.0))[k % 2]
        circle = TrajectorySection("circle", centre_m=(x, y), radius_m=3.0, speed_mps=0.3)
        long_s = 300.0 if k >= WITHIN_MAX - 1 else 18.0
        plans.append(changed(order("reshape", trajectory=circle, over_s=long_s), plans[-1], at_s=10.0 + k))
    made = reference(*plans)
    samples = [made.motion(2, EPOCH + k * S // 5) for k in range(5 * 300)]
    assert max(hypot(x, y) for x, y, *_ in samples) < 20.0
    assert max(hypot(vx, vy) for _, _, vx, vy, *_ in samples) < 1.1 * FLEET.control.max_speed_mps
    assert max(hypot(ax, ay) for *_, ax, ay in samples) < 1.1 * FLEET.control.max_acceleration / 3.0


# ---------------------------------------------------------------------- ways


def test_the_way_of_a_place_goes_to_the_end_of_the_mission():
    made = reference(FIRST)
    end_ns = FIRST.mission.epoch_ns + FIRST.mission.duration_ns
    assert made.way(2, EPOCH + S) == [
        pytest.approx(made.motion(2, time_ns)[:2]) for time_ns in (EPOCH + S, end_ns)
    ]
    assert made.way(7, EPOCH + S) == []
    assert made.settled_ns == 0


def test_a_frozen_reference_heeds_no_later_mission():
    larger = changed(LARGER)
    made, without = reference(FIRST), reference(FIRST)
    frozen = made.frozen()
    made.take(larger)
    later = at(larger, 2.0)
    assert frozen.motion(2, later) == without.motion(2, later) != made.motion(2, later)
    assert frozen.plan is FIRST


def neighbours(made: Reference, robot: int, mark: Mark, time_ns: int) -> list[set[int]]:
    return [{edge.other for edge in edges} for _, edges in made.sharing(robot, made.since(mark, time_ns))]


def test_by_which_missions_a_robot_may_drive_that_has_acknowledged_one():
    left = changed(LEAVE)
    made = reference(FIRST, left)
    before, blending, after_ns = left.from_ns - 1, at(left, 0.5), at(left, 1.0)
    old, new = ((plan.mission.version, tag(plan.mission)) for plan in (FIRST, left))
    then, now = ({j for i, j in plan.edges if i == 1} for plan in (FIRST, left))
    for mark, time_ns, found in (
        (old, before, [then, now]),
        (new, before, [then, now]),  # it is not taken over yet
        (new, blending, [then, now]),
        (new, after_ns, [now]),
        (old, after_ns, [then, now]),  # it has not heard of it
        ((99, 7), after_ns, [then, now]),
        ((0, 0), after_ns, [then, now]),
    ):
        assert neighbours(made, 1, mark, time_ns) == found, (mark, time_ns)
    assert neighbours(made, 2, new, after_ns) == []  # it has no place
    assert neighbours(made, 2, old, after_ns) == [{i if j == 2 else j for i, j in FIRST.edges if 2 in (i, j)}]
