"""Separation under silence, (S3) to (S5): of the standing, of who has the right of way, of lanes."""

from __future__ import annotations

from itertools import combinations
from math import cos, hypot, pi, sin
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.constraint_assembly import only_braking
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.beliefs import Lane, growth, said_doubt, stood_on
from handfast.agent.control.right_of_way import RightOfWay
from handfast.agent.control.safety_filter import keep_apart, limit_speed, project

MOST, RATE, SAFE, MARGIN, SPEED_MOST, PERIOD = 5.0, 3.0, 0.22, 0.05, 1.5, 0.02
SEEDS = st.integers(0, 2**32)

# ---------------------------------------------------------------------- the standing (S3)


@given(SEEDS, st.sampled_from((0.25, 1.0, 5.0)))
def test_who_stands_on_its_way_is_kept_from_whatever_the_other_wants(seed: int, age: float):
    """One robot that has not been heard for `age` s and is not, and one that is driven at it, or anywhere."""
    draw = Random(seed)
    heading, speed = draw.uniform(-pi, pi), draw.uniform(0.0, 1.0)
    bend = draw.uniform(-0.5, 0.5)
    way = [(0.0, 0.0, 0.0)]
    for k in range(50):
        t, x, y = way[-1]
        angle = heading + bend * t
        way.append((0.1 * (k + 1), x + 0.1 * speed * cos(angle), y + 0.1 * speed * sin(angle)))
    belief = stood_on(way, 0.0)
    _, bx, by = draw.choice(way)  # where it stands
    # It begins where every stretch admits it.
    while True:
        x, y, angle = draw.uniform(-4.0, 4.0), draw.uniform(-4.0, 4.0), draw.uniform(-pi, pi)
        fast = draw.uniform(0.0, SPEED_MOST)
        vx, vy = fast * cos(angle), fast * sin(angle)
        room = min(d.distance(x, y) - d.radius - SAFE - MARGIN for d in belief.stretches)
        if room > fast / RATE + 0.15 / RATE + 0.3:
            break
    closest, kept = 9.0, SAFE + MARGIN + said_doubt(age)  # what it grows by later may be lost, (S4)
    for tick in range(400):
        if tick % 15 == 0:
            aim = draw.choice((None, (bx, by)))
            wanted = draw.uniform(-9.0, 9.0), draw.uniform(-9.0, 9.0)
        asked = wanted if aim is None else (9.0 * (aim[0] - x), 9.0 * (aim[1] - y))
        own = Hand(x, y, vx, vy)
        planes = list(limit_speed(vx, vy, SPEED_MOST, RATE))
        for each in belief.stretches:  # all count from the start: (S3) is of those that do when admissible
            ox, oy, at_end = each.offset(x, y)
            plane = keep_apart(
                "ghost",
                (ox, oy),
                (vx, vy),
                (0.0, 0.0),
                SAFE + MARGIN + each.radius_at(age),
                RATE,
                straight=not at_end,
                growth=growth(age),
                alone=True,
            )
            planes.append(only_braking(plane, own))
        u = project(*asked, planes, MOST)
        half = 0.5 * PERIOD * PERIOD
        x, y, vx, vy = (
            x + PERIOD * vx + half * u.ux,
            y + PERIOD * vy + half * u.uy,
            vx + PERIOD * u.ux,
            vy + PERIOD * u.uy,
        )
        age += PERIOD
        closest = min(closest, hypot(x - bx, y - by))
    assert closest > kept - 0.1 * MARGIN


# ---------------------------------------------------------------------- right of way (S4)


def has_way(robot: int, heard: dict[tuple[int, int], bool], ids: list[int], gone: set[int]) -> bool:
    """What the code says, for the robots that `robot` hears and that hear it."""
    peers = [
        SimpleNamespace(
            robot=other,
            is_gone=other in gone,
            time_ns=0,
            clock=SimpleNamespace(used_ns=0),
            deaf=not heard[robot, other],
            direct_late_ns=lambda now_ns, hears=heard[other, robot]: 0 if hears else 10**12,
        )
        for other in ids
        if other != robot
    ]
    made: Any = object.__new__(RightOfWay)
    made._robot, made._peers = robot, SimpleNamespace(known=peers, is_seldom=lambda _: False)
    made._horizon_ns, made._gained_ns = 10**9, 0
    lost = [each for each in peers if not heard[each.robot, robot] and not each.is_gone]
    return bool(made._has_way(10**10, lost, []))


@pytest.mark.patches
@given(st.integers(2, 8), st.randoms(use_true_random=False), st.floats(0.0, 1.0))
def test_two_who_do_not_hear_each_other_and_have_the_right_of_way_share_one_who_tells(
    count: int, draw: Any, share: float
):
    """Whoever hears whom, one way or both."""
    ids = list(range(1, count + 1))
    gone = {robot for robot in ids if draw.random() < 0.15}
    heard = {(a, b): draw.random() < share for a in ids for b in ids}
    """(a, b): b hears a."""
    for i, j in combinations([robot for robot in ids if robot not in gone], 2):
        if heard[i, j] or heard[j, i]:
            continue
        if has_way(i, heard, ids, gone) and has_way(j, heard, ids, gone):
            assert any(
                all(heard[k, robot] and heard[robot, k] for robot in (i, j)) for k in ids if k not in gone
            )


# ---------------------------------------------------------------------- lanes (S5)

POINT = st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))


@given(st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=1, max_size=9), POINT, POINT)
def test_who_is_within_its_tube_and_who_keeps_out_of_it_are_apart(
    points: list[tuple[int, int]], one: tuple[float, float], other: tuple[float, float]
):
    """The distance to a lane changes by no more than one moves: R and R + r_s + m make r_s + m."""
    lane = Lane([(float(x), float(y)) for x, y in points])
    moved = hypot(one[0] - other[0], one[1] - other[1])
    assert abs(lane.distance(*one) - lane.distance(*other)) <= moved + 1e-9
