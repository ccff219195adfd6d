"""Any missions, in any order: motion without a jump, and one end for all."""

from __future__ import annotations

from math import hypot
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import Plan, mission_parts, plan_of, trajectory_parts
from handfast.agent.formation.reference import WITHIN_MAX, Reference
from handfast.agent.formation.trajectory import TrajectorySection
from handfast.agent.messages.types import Mission
from handfast.deploy.orders.blend_time import blend_ns_for
from tests.unit.deploy.orders.order_fleets import EPOCH, S, first_plan, square

FLEET = square("control.max_speed_mps=2.0")
GEOMETRY = resolve(FLEET)
FIRST = first_plan(FLEET)

COORDINATE = st.floats(-4.0, 4.0)
POINT = st.tuples(COORDINATE, COORDINATE)
TRAJECTORIES = st.one_of(
    st.builds(TrajectorySection, st.just("hold"), start_m=POINT),
    st.builds(
        TrajectorySection,
        st.just("line"),
        start_m=POINT,
        velocity_mps=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)),
    ),
    st.builds(
        TrajectorySection,
        st.just("circle"),
        centre_m=POINT,
        radius_m=st.floats(1.0, 4.0),
        speed_mps=st.floats(0.05, 0.5),
    ),
)
# Places in a grid of 1 m, so that no two robots have the same.
PLACES = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=6, max_size=6, unique=True)


@st.composite
def plans(
    draw: st.DrawFn, most: int = 3, shortest: int = 0, longest: int = 8, *, in_turn: bool = False
) -> list[Plan]:
    """The first plan and some more, ascending by version, with times of any order.

    Args:
        shortest, longest: of blends, in halves of a second.
        in_turn: each is taken over within half a second after the one before it.
    """
    made = [FIRST]
    for version in range(2, 2 + draw(st.integers(1, most))):
        members = set(FLEET.ids) - draw(st.sets(st.sampled_from(FLEET.ids), max_size=3))
        places = draw(PLACES)
        pairs = [(i, j) for i in sorted(members) for j in sorted(members) if i < j]
        edges = draw(st.sets(st.sampled_from(pairs))) if pairs else set()
        since_ns = max(made[-1].from_ns, EPOCH) if in_turn else EPOCH
        from_ns = since_ns + draw(st.integers(1, 25 if in_turn else 500)) * S // 50
        made.append(
            plan_of(
                Mission(
                    version,
                    EPOCH,
                    EPOCH,
                    100 * S,
                    "",
                    from_ns,
                    draw(st.integers(shortest, longest)) * S // 2,
                    "",
                    from_ns,
                    trajectory_parts(draw(TRAJECTORIES)),
                    tuple(
                        (robot, float(x), float(y))
                        for robot, (x, y) in zip(FLEET.ids, places, strict=True)
                        if robot in members
                    ),
                    tuple((i, j, draw(st.floats(0.5, 3.0))) for i, j in sorted(edges)),
                ),
                FLEET,
                GEOMETRY,
            )
        )
    return made


def reference(given_plans: list[Plan]) -> Reference:
    made = Reference(FLEET, GEOMETRY)
    for plan in given_plans:
        made.take(plan)
    return made


def always(made: list[Plan]) -> list[int]:
    """Robots that are members of every plan."""
    return sorted(set.intersection(*(set(plan.members) for plan in made)))


def turning_points(made: list[Plan]) -> list[int]:
    """Times at which something begins or ends, and some between."""
    ends = {EPOCH + S} | {time_ns for p in made[1:] for time_ns in (p.from_ns, p.from_ns + p.blend_ns)}
    return sorted(ends | {p.from_ns + p.blend_ns * k // 5 for p in made[1:] for k in range(1, 5)})


@given(plans(shortest=2))
@settings(max_examples=100, deadline=None)
def test_motion_has_no_jump_up_to_its_acceleration_and_derivatives_agree(made: list[Plan]):
    """At every beginning and end: differences over a short time are as small as it is."""
    taken = reference(made)
    step_ns = 2_000
    step = step_ns / S
    # Third derivative of nested blends: (60 + 33 + 33 + 60) way / T^3 of two, more of three.
    jerk = 400.0 * 30.0 / min(plan.blend_ns / S for plan in made[1:]) ** 3
    for time_ns in turning_points(made):
        for robot in always(made):
            samples = [taken.motion(robot, time_ns + k * step_ns) for k in (-1, 0, 1)]
            before, here, after = (sample for sample in samples if sample is not None)
            for axis in (0, 1, 2, 3):  # position -> velocity -> acceleration
                difference = (after[axis] - before[axis]) / (2 * step)
                assert abs(difference - here[axis + 2]) <= jerk * step
            for axis in (4, 5):
                assert abs(after[axis] - before[axis]) <= 2 * jerk * step


@pytest.mark.slow
@given(plans(most=2 * WITHIN_MAX, shortest=4, longest=60, in_turn=True))
@settings(max_examples=100, deadline=None)
def test_however_many_plans_meet_each_one_goes_on_from_the_motion_before_it(made: list[Plan]):
    """Each is compared, when it is taken over, with what would be without it."""
    taken = reference(made[:1])
    for plan in made[1:]:
        without = taken.frozen()
        taken.take(plan)
        last = without.plan
        assert last is not None
        for robot in set(plan.members) & set(last.members):
            was, now = without.motion(robot, plan.from_ns), taken.motion(robot, plan.from_ns)
            assert now == pytest.approx(was, rel=1e-9, abs=1e-9)
            before, after = (
                {edge.other: (edge.distance, edge.weight) for edge in each.edges(robot, plan.from_ns)}
                for each in (without, taken)
            )
            assert after.keys() == before.keys()
            for other, edge in before.items():
                if (
                    other in last.members or other not in plan.members
                ):  # one that is back is at its place at once
                    assert after[other] == pytest.approx(edge, abs=1e-9)


@given(plans(), st.permutations(range(4)), st.data())
@settings(max_examples=100, deadline=None)
def test_missions_in_any_order_and_repeated_end_in_the_same(made: list[Plan], order: Any, data: Any):
    shuffled = [made[k] for k in order if k < len(made)]
    repeated = shuffled + data.draw(st.lists(st.sampled_from(made), max_size=4))
    one, other, latest_only = reference(made), reference(repeated), reference(made[-1:])
    last = made[-1]
    assert one.plan is other.plan is latest_only.plan is last
    for time_ns in (last.from_ns + last.blend_ns, last.from_ns + last.blend_ns + 7 * S // 3):
        for robot in FLEET.ids:
            wanted = one.motion(robot, time_ns)
            assert wanted == other.motion(robot, time_ns) == latest_only.motion(robot, time_ns)
            if robot in last.offsets:
                x, y, *rest = last.reference(time_ns)
                assert wanted == (x + last.offsets[robot][0], y + last.offsets[robot][1], *rest)
            edges = one.edges(robot, time_ns)
            assert edges == other.edges(robot, time_ns) == latest_only.edges(robot, time_ns)
            assert {(min(robot, e.other), max(robot, e.other)) for e in edges} == {
                pair for pair in last.edges if robot in pair
            }
            assert all(edge.weight == 1.0 for edge in edges)


@given(plans())
@settings(max_examples=100, deadline=None)
def test_edges_come_and_go_without_a_jump_and_are_the_same_from_both_ends(made: list[Plan]):
    taken = reference(made)
    step_ns = 20_000
    jumps = [plan.from_ns for plan in made[1:] if plan.blend_ns == 0]
    for time_ns in turning_points(made):
        if any(abs(time_ns - jump) <= step_ns for jump in jumps):
            continue
        stay = always(made)
        for robot in stay:
            before, here, after = (
                {edge.other: edge for edge in taken.edges(robot, time_ns + k * step_ns)} for k in (-1, 0, 1)
            )
            for other in before.keys() | here.keys() | after.keys():
                weights = [edges[other].weight if other in edges else 0.0 for edges in (before, here, after)]
                assert all(0.0 <= weight <= 1.0 for weight in weights)
                # A weight moves by S' = 15/8 a blend at most, three blends of 0.5 s at once.
                assert max(weights) - min(weights) <= 2 * 3 * 15 / 8 * step_ns / (S / 2)
                if other in stay and other in here:
                    mirrored = {edge.other: edge for edge in taken.edges(other, time_ns)}[robot]
                    assert mirrored[1:] == here[other][1:]
            assert list(here) == sorted(here)


@given(plans(most=1), st.booleans())
@settings(max_examples=150, deadline=None)
def test_a_blend_of_the_length_that_is_found_keeps_the_limits(made: list[Plan], same_course: bool):
    wanted = made[1]
    if same_course:  # only places change: nothing has to be caught up with
        trajectory = mission_parts(FIRST)[2]
        wanted = plan_of(wanted.mission._replace(trajectory=trajectory, trajectory_ns=EPOCH), FLEET, GEOMETRY)
    blend_ns = blend_ns_for(FIRST, lambda _: wanted, FLEET)
    assert blend_ns >= S
    plan = plan_of(wanted.mission._replace(blend_ns=blend_ns), FLEET, GEOMETRY)
    taken = reference([FIRST, plan])
    own = max(hypot(*p.reference(wanted.from_ns + S)[4:]) for p in (FIRST, plan))
    for robot in set(FIRST.members) & set(plan.members):
        for k in range(1, 400):
            sample = taken.motion(robot, plan.from_ns + blend_ns * k // 400)
            assert sample is not None
            assert hypot(sample[4], sample[5]) <= own + FLEET.control.max_acceleration / 3 * 1.01
            if same_course:
                assert hypot(sample[2], sample[3]) <= FLEET.control.max_speed_mps * 1.01
