"""The safety filter against exhaustive search, and in closed loop: nobody comes too close."""

from __future__ import annotations

from itertools import combinations
from math import cos, dist, hypot, isfinite, pi, sin, sqrt
from random import Random
from typing import NamedTuple

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.agent.control.hand import Pose, hand
from handfast.agent.control.safety_filter import (
    BODY,
    SEPARATION,
    SPEED,
    HalfPlane,
    keep_apart,
    keep_clear,
    limit_speed,
    limit_turning,
    project,
    turning_limit,
)

MOST = 5.0
CLOSE = 1e-6

ANGLE = st.floats(0.0, 6.3)
ASKED = st.tuples(st.floats(-12.0, 12.0), st.floats(-12.0, 12.0))
RANKS = st.sampled_from((BODY, SEPARATION, SEPARATION, SPEED))


def plane(angle, least, cause, rank=SEPARATION):
    return HalfPlane(cos(angle), sin(angle), least, cause, rank)


@st.composite
def planes_any(draw):
    """Up to seven planes that need not agree; some parallel, some the same."""
    angles = draw(st.lists(st.one_of(ANGLE, st.sampled_from((0.0, pi / 2, pi, -pi / 2))), max_size=7))
    return [plane(angle, draw(st.floats(-6.0, 8.0)), str(n), draw(RANKS)) for n, angle in enumerate(angles)]


@st.composite
def planes_met(draw):
    """Up to seven planes that one acceleration meets, often just so."""
    size, turn = draw(st.floats(0.0, MOST)), draw(ANGLE)
    x, y = size * cos(turn), size * sin(turn)
    angles = draw(st.lists(ANGLE, min_size=1, max_size=7))
    room = st.one_of(st.just(0.0), st.floats(0.0, 4.0))
    return [plane(a, cos(a) * x + sin(a) * y - draw(room), str(n)) for n, a in enumerate(angles)]


def meets(x, y, limits, slack=CLOSE):
    return hypot(x, y) <= MOST + slack and all(nx * x + ny * y >= least - slack for nx, ny, least in limits)


def exhaustive(ux, uy, limits):
    """The nearest point that meets all limits, from every point that can be it; None if there is none."""
    size = hypot(ux, uy)
    found = [(ux, uy), (0.0, 0.0)]
    if size:
        found.append((ux * MOST / size, uy * MOST / size))
    for nx, ny, least in limits:
        miss = least - nx * ux - ny * uy
        found.append((ux + miss * nx, uy + miss * ny))
        half = sqrt(max(MOST**2 - least**2, 0.0))
        found += [(least * nx + s * ny, least * ny - s * nx) for s in (-half, half)]
    for (ax, ay, a), (bx, by, b) in combinations(limits, 2):
        area = ax * by - ay * bx
        if abs(area) > 1e-9:
            found.append(((a * by - b * ay) / area, (b * ax - a * bx) / area))
    met = [(x, y) for x, y in found if meets(x, y, limits)]
    return min(met, key=lambda u: hypot(u[0] - ux, u[1] - uy), default=None)


def bare(planes):
    return [(p.nx, p.ny, p.least) for p in planes]


@given(ASKED, planes_met())
def test_it_is_the_nearest_that_meets_all(asked, planes):
    u = project(*asked, planes, MOST)
    assert hypot(u.ux, u.uy) <= MOST
    assert meets(u.ux, u.uy, bare(planes), 1e-7)
    assert u.violation <= 1e-7
    best = exhaustive(*asked, bare(planes))
    assert best is not None
    # No farther than the best: what is feasible by a hair is a hair's root wide.
    assert dist(asked, u[:2]) <= dist(asked, best) + 2e-3
    if meets(*best, bare(planes), -1e-3):  # well inside
        assert dist(u[:2], asked) <= dist(best, asked) + CLOSE


@given(ASKED, planes_any())
def test_untouched_where_nothing_is_violated_else_somebody_is_named(asked, planes):
    u = project(*asked, planes, MOST)
    if meets(*asked, bare(planes), 0.0):
        assert u == (*asked, (), 0.0)
    elif not meets(*asked, bare(planes), 1e-7):
        assert u.causes
        assert set(u.causes) <= {p.cause for p in planes} | {"acceleration"}


@given(ASKED, planes_any())
def test_twice_is_once(asked, planes):
    once = project(*asked, planes, MOST)
    twice = project(once.ux, once.uy, planes, MOST)
    assert dist(once[:2], twice[:2]) < 2e-3
    if not once.violation:
        assert dist(once[:2], twice[:2]) < CLOSE


@given(ASKED, planes_any())
def test_where_not_all_can_be_met_the_largest_violation_is_least(asked, planes):
    planes = [p.ranked(SEPARATION) for p in planes]
    u = project(*asked, planes, MOST)
    assert hypot(u.ux, u.uy) <= MOST
    short = max([0.0, *(least - nx * u.ux - ny * u.uy for nx, ny, least in bare(planes))])
    assert abs(short - u.violation) < 1e-7
    relaxed = [(nx, ny, least - short) for nx, ny, least in bare(planes)]
    assert exhaustive(*asked, relaxed) is not None
    if short > 1e-4:  # any less is not to be had
        assert exhaustive(*asked, [(nx, ny, least + 1e-4) for nx, ny, least in relaxed]) is None


@given(ASKED, planes_any())
def test_what_comes_later_in_rank_costs_nothing_of_what_comes_first(asked, planes):
    def missed(x, y, rank):
        return max([0.0, *(p.least - p.nx * x - p.ny * y for p in planes if p.rank == rank)])

    body = [p for p in planes if p.rank == BODY]
    separation = [p for p in planes if p.rank != SPEED]
    first, second, all_of_it = (project(*asked, some, MOST) for some in (body, separation, planes))
    assert missed(*all_of_it[:2], BODY) <= missed(*first[:2], BODY) + CLOSE
    assert missed(*all_of_it[:2], SEPARATION) <= missed(*second[:2], SEPARATION) + CLOSE


EXTREME = st.floats(allow_nan=False, allow_infinity=False)


@given(EXTREME, EXTREME, st.lists(st.tuples(ANGLE, EXTREME, RANKS), max_size=6), st.floats(0.0, 1e3))
def test_whatever_finite_comes_in_what_goes_out_is_within_bounds(ux, uy, drawn, most):
    planes = [plane(angle, least, "x", rank) for angle, least, rank in drawn]
    u = project(ux, uy, planes, most)
    assert isfinite(u.violation)
    assert hypot(u.ux, u.uy) <= most


# In closed loop: hand points that obey u, held for a period, each with its own filter.

RATE, MARGIN, SAFE, CLEARANCE = 3.0, 0.05, 0.3, 0.1
SPEED_MOST = 1.5  # RATE * SPEED_MOST <= MOST: everybody can brake as fast as (F4) takes for granted
PERIOD = 0.02
SAMPLED = 0.05  # m/s^2: between two samples a barrier may be left by a hair, and is made for again


class Closest(NamedTuple):
    pair: float
    boundary: float
    violation: float


def drive(seed, count, boundaries, seconds=5.0):
    """`count` robots that start admissible and are driven at each other, or anywhere."""
    draw = Random(seed)
    places: list[tuple[float, float]] = []
    while len(places) < count:
        place = draw.uniform(-1.7, 1.7), draw.uniform(-1.7, 1.7)
        free = all(dist(place, other) > SAFE + MARGIN for other in places)
        if free and all(n.distance > CLEARANCE + MARGIN for b in boundaries for n in b.near(*place, 9.0)):
            places.append(place)
    velocities = [(draw.uniform(-1.0, 1.0), draw.uniform(-1.0, 1.0)) for _ in places]
    share = 1.0  # of these velocities that every barrier admits: hdot + p h >= 0
    for i, (place, (vx, vy)) in enumerate(zip(places, velocities, strict=True)):
        for j in range(i):
            dx, dy = place[0] - places[j][0], place[1] - places[j][1]
            rho = hypot(dx, dy)
            closing = -(dx * (vx - velocities[j][0]) + dy * (vy - velocities[j][1])) / rho
            share = min(share, RATE * (rho - SAFE - MARGIN) / max(closing, 1e-9))
        for near in (n for b in boundaries for n in b.near(*place, 9.0)):
            closing = -(near.nx * vx + near.ny * vy)
            share = min(share, RATE * (near.distance - CLEARANCE - MARGIN) / max(closing, 1e-9))
    velocities = [(share * vx, share * vy) for vx, vy in velocities]
    prey = [draw.choice((None, *range(count))) for _ in places]
    asked = [(0.0, 0.0)] * count
    closest = Closest(9.0, 9.0, 0.0)
    for tick in range(round(seconds / PERIOD)):
        if tick % 20 == 0:
            asked = [(draw.uniform(-9.0, 9.0), draw.uniform(-9.0, 9.0)) for _ in places]
        given_ = []
        for i, (place, velocity) in enumerate(zip(places, velocities, strict=True)):
            planes = list(limit_speed(*velocity, SPEED_MOST, RATE))
            for j, other in enumerate(places):
                if j != i:
                    away = place[0] - other[0], place[1] - other[1]
                    planes.append(keep_apart("peer", away, velocity, velocities[j], SAFE + MARGIN, RATE))
                    closest = closest._replace(pair=min(closest.pair, hypot(*away)))
            for near in (n for each in boundaries for n in each.near(*place, 2.0)):
                b = near.distance
                planes.append(keep_clear("wall", b, near.nx, near.ny, velocity, CLEARANCE + MARGIN, RATE))
                closest = closest._replace(boundary=min(closest.boundary, b))
            target = prey[i]
            if target is not None:
                at = places[target] if target != i else (0.0, 0.0)
                asked[i] = 9.0 * (at[0] - place[0]), 9.0 * (at[1] - place[1])
            u = project(*asked[i], planes, MOST)
            closest = closest._replace(violation=max(closest.violation, u.violation))
            given_.append((u.ux, u.uy))
        for i, (ux, uy) in enumerate(given_):
            (x, y), (vx, vy) = places[i], velocities[i]
            half = 0.5 * PERIOD * PERIOD
            places[i] = x + PERIOD * vx + half * ux, y + PERIOD * vy + half * uy
            velocities[i] = vx + PERIOD * ux, vy + PERIOD * uy
    return closest


SEEDS = st.integers(0, 2**32)
COUNTS = st.sampled_from((2, 3, 5))
CIRCLE = Circle("tree", 0.3, -0.2, 0.4)
SQUARE = Polygon("fence", [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)], inside=True)


OCTAGON, ROUND = (
    Polygon(
        "fence",
        [(2.0 * cos(2.0 * pi * k / count), 2.0 * sin(2.0 * pi * k / count)) for k in range(count)],
        inside=True,
    )
    for count in (8, 20)
)


@given(SEEDS, COUNTS)
def test_robots_that_are_driven_at_each_other_keep_apart(seed, count):
    closest = drive(seed, count, ())
    assert closest.pair > SAFE + 0.5 * MARGIN
    assert closest.violation < SAMPLED  # what everybody can do by braking can always be done


@pytest.mark.slow
@given(SEEDS, COUNTS)
def test_with_a_circle_and_walls_between_them_as_well(seed, count):
    closest = drive(seed, count, (CIRCLE, SQUARE))
    assert closest.pair > SAFE + 0.5 * MARGIN
    assert closest.boundary > CLEARANCE + 0.5 * MARGIN
    assert closest.violation < SAMPLED


@pytest.mark.slow
@given(SEEDS, COUNTS, st.sampled_from((OCTAGON, ROUND)))
def test_with_walls_that_bend_towards_them(seed, count, fence):
    closest = drive(seed, count, (fence,))
    assert closest.pair > SAFE + 0.5 * MARGIN
    assert closest.boundary > CLEARANCE + 0.9 * MARGIN
    assert closest.violation < SAMPLED


@given(SEEDS)
def test_one_that_does_nothing_about_it_is_kept_away_from_by_the_other_alone(seed):
    draw = Random(seed)
    x, y, vx, vy = draw.uniform(0.5, 2.0), draw.uniform(-1.0, 1.0), 0.0, 0.0
    ox, oy, speed, turn = 0.0, 0.0, draw.uniform(0.0, 0.6), draw.uniform(-pi, pi)
    wx, wy = speed * cos(turn), speed * sin(turn)
    rho = hypot(x, y)
    assume((x * wx + y * wy) / rho <= RATE * (rho - SAFE - MARGIN))
    for _ in range(250):
        ax, ay = -wx / 0.5, -wy / 0.5  # it brakes, and says so
        plane_ = keep_apart(
            "peer",
            (x - ox, y - oy),
            (vx, vy),
            (wx, wy),
            SAFE + MARGIN,
            RATE,
            alone=True,
            other_acceleration=(ax, ay),
        )
        u = project(9.0 * (ox - x), 9.0 * (oy - y), [plane_, *limit_speed(vx, vy, SPEED_MOST, RATE)], MOST)
        half = 0.5 * PERIOD * PERIOD
        x, y, vx, vy = (
            x + PERIOD * vx + half * u.ux,
            y + PERIOD * vy + half * u.uy,
            vx + PERIOD * u.ux,
            vy + PERIOD * u.uy,
        )
        ox, oy, wx, wy = (
            ox + PERIOD * wx + half * ax,
            oy + PERIOD * wy + half * ay,
            wx + PERIOD * ax,
            wy + PERIOD * ay,
        )
        assert hypot(x - ox, y - oy) > SAFE


# ---------------------------------------------------------------------- all that the last stage has to keep


class Bodies(NamedTuple):
    """Bodies in an admissible state, by their poses; and p (1/s), L (m), V_max (m/s), W (rad/s)."""

    poses: list[Pose]
    rate: float
    reach: float
    fastest: float
    turning: float


def admissible(seed):
    """Bodies close together: as fast towards each other, and turning as fast, as (F1), (F6), (F9) admit."""
    draw = Random(seed)
    rate, reach = draw.uniform(0.5, 4.0), draw.choice((0.05, 0.1, 0.3))
    fastest, turning = draw.uniform(0.2, MOST / rate), draw.choice((1.2, 3.0, 6.0))
    places: list[tuple[float, float]] = []
    while len(places) < 5:
        place = draw.uniform(-0.7, 0.7), draw.uniform(-0.7, 0.7)
        if all(dist(place, other) > SAFE + MARGIN for other in places):
            places.append(place)
    poses = []
    for x, y in places:
        heading, speed = draw.uniform(-pi, pi), draw.choice((-1.0, 1.0)) * fastest * draw.random() ** 0.3
        limit, _ = turning_limit(speed, reach, turning, rate)
        turn = (
            min(limit, sqrt(fastest**2 - speed**2) / reach) * draw.choice((-1.0, 1.0)) * draw.random() ** 0.2
        )
        poses.append(Pose(x - reach * cos(heading), y - reach * sin(heading), heading, speed, turn))
    # The share of these speeds that every barrier admits. Slower robots may turn as fast at least.
    share = 1.0
    hands = [hand(pose, reach) for pose in poses]
    for one, other in combinations(hands, 2):
        dx, dy = one.x - other.x, one.y - other.y
        rho = hypot(dx, dy)
        closing = -(dx * (one.vx - other.vx) + dy * (one.vy - other.vy)) / rho
        share = min(share, rate * (rho - SAFE - MARGIN) / max(closing, 1e-9))
    poses = [pose._replace(speed=share * pose.speed, yaw_rate=share * pose.yaw_rate) for pose in poses]
    return Bodies(poses, rate, reach, fastest, turning)


def last_stage(bodies, robot):
    """The half planes of one of them, as `Controller` makes them."""
    own = hand(bodies.poses[robot], bodies.reach)
    planes = list(limit_speed(own.vx, own.vy, bodies.fastest, bodies.rate))
    planes += limit_turning(bodies.poses[robot], bodies.reach, bodies.turning, bodies.rate)
    for index, pose in enumerate(bodies.poses):
        if index != robot:
            other = hand(pose, bodies.reach)
            away = own.x - other.x, own.y - other.y
            planes.append(keep_apart("peer", away, own[2:], other[2:], SAFE + MARGIN, bodies.rate))
    return own, planes


def test_in_every_admissible_state_all_that_the_last_stage_keeps_can_be_kept():
    """By braking: u = -p v is in every half plane, whatever the robot asks for, and needs no rank."""
    states = 0
    for seed in range(2100):
        bodies = admissible(seed)
        for robot in range(len(bodies.poses)):
            states += 1
            own, planes = last_stage(bodies, robot)
            ux, uy = -bodies.rate * own.vx, -bodies.rate * own.vy
            assert hypot(ux, uy) <= MOST + 1e-9
            assert all(p.nx * ux + p.ny * uy >= p.least - 1e-6 for p in planes), (seed, robot)
            assert project(9.0, -7.0, planes, MOST).violation < 1e-6
    assert states > 10_000


def test_a_plain_limit_of_the_yaw_rate_contradicts_separation():
    """What (F9) must not be: |L wdot + 2 p L w| <= 2 p L W, whatever the speed."""
    missed = 0
    for seed in range(2100):
        bodies = admissible(seed)
        for robot, pose in enumerate(bodies.poses):
            own, planes = last_stage(bodies, robot)
            c, s = cos(pose.heading), sin(pose.heading)
            bias, most = pose.speed * pose.yaw_rate, 2.0 * bodies.rate * bodies.reach
            planes[:] = [p for p in planes if p.cause != "turning"] + [
                HalfPlane(-s, c, bias - most * (bodies.turning + pose.yaw_rate), "turning", BODY),
                HalfPlane(s, -c, -bias - most * (bodies.turning - pose.yaw_rate), "turning", BODY),
            ]
            missed += project(-bodies.rate * own.vx, -bodies.rate * own.vy, planes, MOST).violation > 1e-3
    assert missed > 5


@given(SEEDS, st.floats(0.0, 0.15))
def test_a_gap_that_grows_is_kept_up_with(seed, growth):
    """rho >= gap(t) of a robot that stands, as long as the filter finds room, (U2): h' counts the growth."""
    draw = Random(seed)
    gap, speed = SAFE + MARGIN, 0.0
    rho = gap + growth / RATE + draw.uniform(0.0, 0.5)
    closing = draw.uniform(0.0, min(SPEED_MOST, RATE * (rho - gap) - growth))  # g = h' + p h >= 0
    x, speed = rho, -closing
    for _ in range(400):
        plane_ = keep_apart("peer", (x, 0.0), (speed, 0.0), (0.0, 0.0), gap, RATE, growth=growth, alone=True)
        u = project(-9.0, 0.0, [plane_], MOST)
        assert u.violation == 0.0
        x, speed = x + PERIOD * speed + 0.5 * PERIOD * PERIOD * u.ux, speed + PERIOD * u.ux
        gap += PERIOD * growth
        assert x > gap - 0.002 - 0.1 * MARGIN  # sampled
    assert speed == pytest.approx(growth, abs=0.02)  # it is driven off as fast as the gap grows
