"""How long changes take: by the limits of motion, and by what is left of the changes before."""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, sin, sqrt, tau
from random import Random
from typing import Any

import numpy as np
import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection, ShapeSection
from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import Plan
from handfast.agent.formation.reference import Reference
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Left
from handfast.deploy.orders.blend_time import blend_ns_for
from tests.unit.deploy.orders.order_fleets import EPOCH, S, after, first_plan, order, square

FLEET = square()
FIRST = first_plan(FLEET)
HOLD = TrajectorySection("hold")


def plan_after(what: OrderSection, plan: Plan = FIRST, fleet: Fleet = FLEET, **rest: Any) -> Plan:
    return after(what, plan, fleet, **rest)[1]


def peaks(fleet: Fleet, *plans: Plan) -> tuple[float, float]:
    """Greatest speed and acceleration of any member within the last plan's blend."""
    reference = Reference(fleet, resolve(fleet))
    for plan in plans:
        reference.take(plan)
    last, speed, acceleration = plans[-1], 0.0, 0.0
    for robot in last.members:
        for k in range(1001):
            sample = reference.motion(robot, last.from_ns + last.blend_ns * k // 1000)
            assert sample is not None
            speed = max(speed, hypot(sample[2], sample[3]))
            acceleration = max(acceleration, hypot(sample[4], sample[5]))
    return speed, acceleration


@pytest.mark.parametrize("speed_max", [0.5, 1.5, 100.0])
@pytest.mark.parametrize("scale", [1.1, 3.0, 8.0])
def test_a_blend_is_as_long_as_its_limits_need_and_not_much_longer(speed_max: float, scale: float):
    fleet = square(f"control.max_speed_mps={speed_max}", "control.max_acceleration=3")
    first = first_plan(fleet)
    plan = plan_after(order("reshape", scale=scale), first, fleet)
    speed, acceleration = peaks(fleet, first, plan)
    assert speed <= speed_max * 1.01
    assert acceleration <= 1.01
    if plan.blend_ns > S:
        assert speed >= 0.85 * speed_max or acceleration >= 0.8


@pytest.mark.parametrize("at_s", [11.0, 13.0, 16.0])
def test_a_blend_into_an_unfinished_one_keeps_the_limits(at_s: float):
    first = plan_after(order("reshape", scale=5.0))
    assert first.from_ns + first.blend_ns > EPOCH + 17 * S
    second = order(
        "reshape", formation=ShapeSection(offsets=((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)))
    )
    speed, acceleration = peaks(FLEET, FIRST, first, plan_after(second, first, at_s=at_s))
    assert speed <= FLEET.control.max_speed_mps * 1.01
    assert acceleration <= FLEET.control.max_acceleration / 3 * 1.01


def test_a_course_too_fast_for_any_blend_gets_one_that_its_places_need():
    fast = TrajectorySection("line", velocity_mps=(1.4, 0.0))
    plan = plan_after(order("reshape", trajectory=fast, scale=2.0))
    seconds = plan.blend_ns / S
    assert 15 / 8 * sqrt(2) <= 0.25 * 1.5 * seconds <= 15 / 8 * sqrt(2) * 1.1


def test_who_only_comes_and_goes_needs_the_least_blend():
    alone = plan_after(order("replace", robot=1, by=7))
    assert blend_ns_for(FIRST, lambda _: alone, FLEET) == S
    nobody = plan_after(order("leave", robot=1))
    assert blend_ns_for(FIRST, lambda _: replace(nobody, members=()), FLEET) == S


# ---------------------------------------------------------------------- many in turn


def circle(*centre_m: float, speed_mps: float = 0.3) -> OrderSection:
    there = TrajectorySection("circle", centre_m=centre_m, radius_m=2.0, speed_mps=speed_mps)
    return order("reshape", trajectory=there)


def reference(*plans: Plan) -> Reference:
    made = Reference(FLEET, resolve(FLEET))
    for plan in plans:
        made.take(plan)
    return made


def off(made: Reference, plan: Plan, time_ns: int) -> np.ndarray:
    """(members, 4): how far each is from where `plan` has it, and how fast that changes."""
    x, y, vx, vy, *_ = plan.reference(time_ns)
    there = [np.array(made.motion(robot, time_ns))[:4] for robot in plan.members]
    return np.array(there) - [(x + dx, y + dy, vx, vy) for dx, dy in plan.offsets.values()]


def test_a_mission_says_what_is_left_of_the_motion_before_it() -> None:
    plans = [FIRST]
    for k, what in enumerate((circle(9.0, 3.0), circle(2.0, 8.0), order("reshape", trajectory=HOLD))):
        plans.append(plan_after(what, plans[-1], at_s=10.0 + 1.5 * k))
    made, last = reference(*plans), plans[-1]
    assert decode(encode(last.mission)) == last.mission
    for k, left in enumerate(last.mission.left):
        time_ns = last.from_ns + last.blend_ns * k // (len(last.mission.left) - 1)
        assert (left.places, left.rate) == (0.0, 0.0), "only the trajectory was another one"
        assert off(made, last, time_ns) == pytest.approx(np.tile(left[:4], (4, 1)), abs=0.01)


def test_no_place_is_further_off_than_said() -> None:
    plans = [FIRST]
    for k, scale in enumerate((2.0, 0.5, 3.0)):
        plans.append(plan_after(order("reshape", scale=scale), plans[-1], at_s=10.0 + 0.8 * k))
    made, last = reference(*plans), plans[-1]
    assert last.mission.left[0].places > 0.5
    for k, left in enumerate(last.mission.left):
        time_ns = last.from_ns + last.blend_ns * k // (len(last.mission.left) - 1)
        here = off(made, last, time_ns)
        assert left[:4] == (0.0, 0.0, 0.0, 0.0)
        assert left[4:8] == pytest.approx(here.mean(axis=0), abs=0.02)
        here -= here.mean(axis=0)
        assert np.hypot(*here[:, :2].T).max() <= left.places + 1e-6
        assert np.hypot(*here[:, 2:].T).max() <= left.rate + 1e-6


@pytest.mark.parametrize(
    ("old", "new"), [((0.0, 0.0), (1.2, 0.0)), ((0.8, 0.0), (-0.8, 0.0)), ((0.9, 0.0), (0.0, 0.9))]
)
def test_a_new_line_takes_no_more_than_a_sixth_more_than_the_change_of_velocity(old: Any, new: Any) -> None:
    """It took four fifths more as long as it began where the formation was when it was taken over."""
    before = plan_after(order("reshape", trajectory=TrajectorySection("line", velocity_mps=old)))
    plan = plan_after(
        order("reshape", trajectory=TrajectorySection("line", velocity_mps=new)), before, at_s=40.0
    )
    made = reference(FIRST, before, plan)
    times_ns = [plan.from_ns + plan.blend_ns * k // 200 for k in range(201)]
    speeds = [hypot(*(made.motion(2, time_ns) or (0.0,) * 6)[2:4]) for time_ns in times_ns]
    assert max(speeds) <= 1.5
    assert plan.blend_ns < 10 * S


def quick_orders(random: Random) -> list[Plan]:
    """Changes as somebody gives them who is in a hurry: the next one before the last is over."""
    plans, at_s, gap_s = [FIRST], 10.0, random.choice((0.02, 0.3, 1.0, 1.5, 3.0))
    for _ in range(random.choice((3, 5, 8, 12, 20))):
        angle, speed = random.uniform(0.0, tau), random.uniform(0.1, 0.8)
        size = max(hypot(*offset) for offset in plans[-1].offsets.values())
        what = random.choice(
            (
                circle(random.uniform(0.0, 12.0), random.uniform(0.0, 12.0), speed_mps=speed),
                order(
                    "reshape",
                    trajectory=TrajectorySection(
                        "line", velocity_mps=(speed * cos(angle), speed * sin(angle))
                    ),
                ),
                order("reshape", trajectory=HOLD),
                order(
                    "reshape", scale=min(max(random.choice((0.5, 0.8, 1.25, 2.0)), 0.6 / size), 3.0 / size)
                ),
            )
        )
        plans.append(plan_after(what, plans[-1], at_s=at_s))
        at_s += gap_s * random.uniform(0.5, 1.5)
    return plans


@pytest.mark.parametrize("seed", range(24))
def test_changes_in_a_hurry_are_over_soon_and_ask_for_no_more_than_robots_can(seed: int) -> None:
    """Each counted all that the one before could have left: after ten, half of them took minutes, in which
    the fleet drove on as it had before, tens of metres off; after twenty, nothing was taken any more."""
    plans = quick_orders(Random(seed))
    last = plans[-1]
    assert last.blend_ns < 75 * S
    made = Reference(FLEET, resolve(FLEET))
    fastest = hardest = 0.0
    for plan, until_ns in zip(
        plans, [*(each.from_ns for each in plans[1:]), last.from_ns + last.blend_ns], strict=True
    ):
        made.take(plan)
        for time_ns in range(max(plan.from_ns, EPOCH + 5 * S), until_ns, S // 10):
            for robot in plan.members:
                *_, vx, vy, ax, ay = made.motion(robot, time_ns) or (0.0,) * 6
                fastest, hardest = max(fastest, hypot(vx, vy)), max(hardest, hypot(ax, ay))
    assert fastest < 1.15 * FLEET.control.max_speed_mps
    assert hardest < FLEET.control.max_acceleration


def test_of_a_mission_that_does_not_say_what_is_left_the_worst_is_taken() -> None:
    """One that an older program has made."""
    first = plan_after(circle(9.0, 3.0))
    silent = replace(first, mission=first.mission._replace(left=()))
    known, unknown = (plan_after(order("reshape", scale=2.0), each, at_s=11.0) for each in (first, silent))
    assert unknown.blend_ns > known.blend_ns


def test_what_is_said_to_be_over_at_once_leaves_nothing() -> None:
    plan = plan_after(order("reshape", scale=2.0, over_s=0.0))
    assert plan.mission.left == (Left(*(0.0,) * 10, pytest.approx(sqrt(2.0))),)
    assert plan_after(order("reshape", scale=0.5), plan, at_s=10.1).blend_ns < 5 * S
