"""Where a robot is taken to be: its last message carried forward, against its equations solved finely."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, exp, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from handfast.agent.control.law import acting_error, firmness, navigation_force
from handfast.agent.control.peers.prediction import (
    BRAKING_TIME_S,
    Prediction,
    as_it_came,
    coasting,
    constraint_decay,
    following,
    transition,
)
from handfast.agent.formation.points import Floats
from handfast.agent.formation.trajectory import Sample
from handfast.agent.messages.types import HandState
from tests.values import values

C1, C2 = 0.4, 0.6
DECAY = constraint_decay(1.8, 1.0)
MOST = 1.5

Vector = tuple[float, float]


def message(
    position: Vector,
    velocity: Vector = (0.0, 0.0),
    constraint: Vector = (0.0, 0.0),
    navigation: Vector = (0.0, 0.0),
    correction: Vector = (0.0, 0.0),
) -> HandState:
    return HandState(
        2, 0, 0, True, 1, *position, *velocity, *navigation, *constraint, *correction, 0.0, (), ()
    )


def circling(t: float) -> Sample:
    """A place with an acceleration."""
    return cos(t), 2 * sin(t), -sin(t), 2 * cos(t), -cos(t), -2 * sin(t)


def straight(t: float) -> Sample:
    return 0.5 * t, 0.0, 0.5, 0.0, 0.0, 0.0


def solved(
    said: HandState,
    motion: Callable[[float], Sample],
    age: float,
    decay: float,
    most: float | None,
    speeding: float = 0.0,
) -> Prediction:
    """The robot itself: its navigation loop (21), (N1), (N2), with forces that die away."""

    def forces(t: float, y: Floats) -> tuple[Floats, Floats]:
        place = np.array(motion(t))
        e = y[:2] - place[:2]
        firm = 1.0
        if most is not None:
            error, moves = (float(e[0]), float(e[1])), (float(place[2]), float(place[3]))
            acting = acting_error(error, moves, C1, C2, most)
            firm = firmness(error, acting, moves, C1, C2, most, speeding)
            e = np.array(acting)
        navigation = navigation_force(place[4:], e, y[2:] - place[2:4], firm * C1, firm * C2)
        remains = exp(-decay * t)
        return np.asarray(navigation) + remains * np.array(said[13:15]), remains * np.array(said[11:13])

    end = np.array(said[5:9])
    if age:
        solution = solve_ivp(
            lambda t, y: np.concatenate([y[2:], sum(forces(t, y))]),
            (0.0, age), end, method="DOP853", rtol=1e-11, atol=1e-12, max_step=0.05,
        )  # fmt: skip
        end = solution.y[:, -1]
    navigation, constraint = forces(age, end)
    return Prediction(
        (end[0], end[1]), (end[2], end[3]), (navigation[0], navigation[1]), (constraint[0], constraint[1])
    )


def predicted(
    said: HandState,
    motion: Callable[[float], Sample],
    age: float,
    decay: float,
    most: float | None,
    speeding: float = 0.0,
) -> Prediction:
    step = transition(C1, C2, decay, age)
    return following(said, motion(age), motion(0.0), age, C1, C2, decay, most, speeding, step)


def gap(one: Prediction, other: Prediction) -> float:
    """How far apart the two have the robot, m."""
    return hypot(one.position[0] - other.position[0], one.position[1] - other.position[1])


# ---------------------------------------------------------------------- the exact step


@pytest.mark.parametrize("c1", [0.01, 0.4, 1.0, 25.0])
@pytest.mark.parametrize("c2", [0.01, 0.6, 2.0, 3.0, 40.0])  # c2^2 < 4 c1, = and >
@pytest.mark.parametrize("decay", [0.0, 0.05, 0.9, 7.0])
@pytest.mark.parametrize("age", [0.0, 0.001, 0.02, 0.5, 2.0, 5.0])
def test_transition_is_the_matrix_exponential(c1: float, c2: float, decay: float, age: float):
    a = np.array([[0.0, 1.0, 0.0], [-c1, -c2, 1.0], [0.0, 0.0, -decay]])  # with F_c as a third state
    expected = expm(a * age)
    a11, a12, a21, a22, b1, b2, remains = transition(c1, c2, decay, age)
    got = np.array([[a11, a12, b1], [a21, a22, b2], [0.0, 0.0, remains]])
    assert got == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("kd", "kp", "expected"), [(1.8, 1.0, 0.9), (3.0, 2.0, 1.0), (1.8, 0.0, 0.0), (0.0, 1.0, 0.0)]
)
def test_constraint_forces_die_away_as_the_edges_errors_do(kd: float, kp: float, expected: float):
    assert constraint_decay(kd, kp) == pytest.approx(expected)
    if kd > 0.0:
        assert -expected == pytest.approx(max(np.roots([1.0, kd, kp]).real))


@pytest.mark.parametrize(("c1", "c2", "age"), [(0.4, 1000.0, 2.0), (1.0, 30.0, 60.0), (1e4, 1e4, 60.0)])
def test_strong_damping_does_not_overflow(c1: float, c2: float, age: float):
    """Gains and horizons that the fleet file allows: cosh(omega T) alone would leave the floats."""
    step = transition(c1, c2, 0.0, age)
    assert np.isfinite(step).all()
    slow = c1 / (0.5 * c2 + np.sqrt(0.25 * c2 * c2 - c1))  # the slow pole
    assert step[0] == pytest.approx(exp(-slow * age), rel=0.05)


# ---------------------------------------------------------------------- a robot that follows


@pytest.mark.patches
@pytest.mark.parametrize("decay", [0.0, DECAY])
@pytest.mark.parametrize("age", [0.0, 0.01, 0.06, 0.5, 2.0])
def test_prediction_is_the_navigation_loop_solved(age: float, decay: float):
    """e'' = -c1 e - c2 e' + F_c exp(-decay t), by scipy; F_n follows by (21)."""
    generator = np.random.default_rng(3)
    for _ in range(3):
        position, velocity, constraint, correction = map(tuple, generator.normal(size=(4, 2)).tolist())
        said = message(position, velocity, constraint, correction=correction)
        got, expected = (find(said, circling, age, decay, None) for find in (predicted, solved))
        for vector, wanted in zip(values(got), values(expected), strict=True):
            assert vector == pytest.approx(wanted, abs=1e-9)


def test_at_once_it_accelerates_as_it_was_told_to():
    """One that the safety filter holds back accelerates by less than it would like to."""
    held = message((1.4, 0.2), (0.3, 1.8), (0.1, -0.1), correction=(-0.5, 0.75))
    free = held._replace(correction_x=0.0, correction_y=0.0)
    now, likes = (predicted(each, circling, 0.0, DECAY, None) for each in (held, free))
    gained = [a - b for a, b in zip(now.navigation, likes.navigation, strict=True)]
    assert gained == pytest.approx((-0.5, 0.75))
    assert (now.position, now.velocity, now.constraint) == (likes.position, likes.velocity, likes.constraint)


@pytest.mark.patches
@pytest.mark.parametrize("age", [0.02, 0.2, 0.5, 1.0])
@pytest.mark.parametrize("away", [5.0, 10.0, 40.0])
def test_a_robot_far_behind_on_a_straight_way_is_predicted_exactly(away: float, age: float):
    """Its pull keeps its direction and its size: (N1) is solved in closed form."""
    said = message((-away, 0.0), (1.1, 0.0), (0.2, 0.0), correction=(-0.3, 0.0))
    got, expected = (find(said, straight, age, DECAY, MOST) for find in (predicted, solved))
    for vector, wanted in zip(values(got), values(expected), strict=True):
        assert vector == pytest.approx(wanted, abs=1e-8)
    assert gap(predicted(said, straight, age, DECAY, None), expected) > 0.4 * age * age * (0.4 * away - 1.0)


@pytest.mark.patches
@pytest.mark.parametrize("age", [0.02, 0.2, 0.5, 1.0])
def test_one_that_is_pulled_firmly_is_predicted_so(age: float):
    """Far out it is as firm as the loop carries all the while (N2)."""
    said = message((-40.0, 0.0), (0.1, 0.0), (0.2, 0.0), correction=(-0.3, 0.0))
    got, expected = (find(said, straight, age, DECAY, MOST, 3.0) for find in (predicted, solved))
    for vector, wanted in zip(values(got), values(expected), strict=True):
        assert vector == pytest.approx(wanted, abs=1e-8)
    softly = predicted(said, straight, age, DECAY, MOST)
    assert got.velocity[0] > softly.velocity[0] + 0.3 * min(age, 0.5)


@pytest.mark.patches
@settings(max_examples=60)
@given(
    away=st.floats(4.0, 30.0),
    direction=st.floats(0.0, 2 * pi),
    speed=st.floats(0.0, MOST),
    heading=st.floats(0.0, 2 * pi),
    age=st.floats(0.02, 1.0),
    push=st.floats(0.0, 1.0),
)
def test_a_robot_far_from_its_place_is_predicted_to_a_small_error(
    away: float, direction: float, speed: float, heading: float, age: float, push: float
):
    """What is left out is how its pull turns meanwhile, and with it the speed that it may have: at most
    c2 v age |edot| / |e| each, twice integrated."""
    said = message(
        (away * cos(direction), away * sin(direction)),
        (speed * cos(heading), speed * sin(heading)),
        (push * sin(heading), push * cos(heading)),
    )
    got, expected = (find(said, straight, age, DECAY, MOST) for find in (predicted, solved))
    rate = speed + 0.5 + push * age
    turned = C2 * (MOST + 0.5) * rate * age / (away - rate * age)
    assert gap(got, expected) <= 2.0 * turned * age * age / 6.0 + 1e-9
    assert got.constraint == pytest.approx(expected.constraint)


# ---------------------------------------------------------------------- one that does not


def test_a_braking_robot_coasts_to_a_stop():
    said = message((1.0, 2.0), (0.5, -0.3), (9.0, 9.0))
    for age in (0.0, 0.1, 0.4, 2.0):
        found = coasting(said, age)
        remains = exp(-age / BRAKING_TIME_S)
        way = BRAKING_TIME_S * (1.0 - remains)
        assert found.velocity == pytest.approx((0.5 * remains, -0.3 * remains))
        assert found.position == pytest.approx((1.0 + 0.5 * way, 2.0 - 0.3 * way))
        assert found.constraint == (0.0, 0.0)
        before, after = (coasting(said, age + step).velocity for step in (0.0, 1e-6))
        braking = ((after[0] - before[0]) / 1e-6, (after[1] - before[1]) / 1e-6)
        assert found.navigation == pytest.approx(braking, rel=1e-4)


def test_as_it_came():
    said = message((1.0, 2.0), (0.5, -0.3), (0.1, 0.2), (0.5, 0.75), correction=(0.25, -1.0))
    assert values(as_it_came(said)) == ((1.0, 2.0), (0.5, -0.3), (0.75, -0.25), (0.1, 0.2))
    braking = said._replace(following=False)
    assert values(as_it_came(braking)) == values(coasting(braking, 0.0))
