"""What a robot knows of its neighbours: which messages it takes, and where it expects them to be."""

from __future__ import annotations

from math import cos, exp, sin

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from agent.messages import HandState
from agent.neighbours import BRAKING_TIME_S, FUTURE_NS_MAX, Neighbours, constraint_decay, transition

PERIOD = 20_000_000
S = 1_000_000_000
C1, C2 = 0.4, 0.6
T0 = 1000 * S  # an epoch
OFFSETS = {5: (1.0, 0.0), 2: (0.0, -0.5), 9: (-1.0, 0.7)}


def message(
    robot: int = 2,
    sequence: int = 0,
    time_ns: int = T0,
    following: bool = True,
    position: tuple[float, float] = (0.0, 0.0),
    velocity: tuple[float, float] = (0.0, 0.0),
    constraint: tuple[float, float] = (0.0, 0.0),
    multipliers: tuple[tuple[int, float], ...] = (),
    navigation: tuple[float, float] = (0.0, 0.0),
    heard: tuple[tuple[int, int], ...] = (),
) -> HandState:
    forces = (*navigation, *constraint)
    return HandState(robot, sequence, time_ns, following, *position, *velocity, *forces, multipliers, heard)


def neighbours() -> Neighbours:
    return Neighbours(1, OFFSETS, C1, C2, PERIOD)


def circling(time_ns: int) -> tuple[float, float, float, float, float, float]:
    """A reference with an acceleration."""
    t = (time_ns - T0) / S
    return cos(t), 2 * sin(t), -sin(t), 2 * cos(t), -cos(t), -2 * sin(t)


def standing(_time_ns: int) -> tuple[float, float, float, float, float, float]:
    return 3.0, 4.0, 0.0, 0.0, 0.0, 0.0


def heard(known: Neighbours, *messages: HandState, now_ns: int = T0 + PERIOD) -> Neighbours:
    for one in messages:
        assert known.accept(one, now_ns) is None
    return known


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


@pytest.mark.parametrize(("c1", "c2", "decay"), [(0.4, 1.3, 0.5), (0.4, 1.3, 0.8), (1.0, 2.0, 1.0)])
@pytest.mark.parametrize("off", [0.0, 1e-12, -1e-9, 1e-6])
def test_a_decay_like_the_loops_own_is_no_exception(c1: float, c2: float, decay: float, off: float):
    """There c1 - c2 decay + decay^2 = 0, and the particular solution has another form."""
    decay *= 1.0 + off
    expected = expm(np.array([[0.0, 1.0, 0.0], [-c1, -c2, 1.0], [0.0, 0.0, -decay]]) * 1.5)
    got = transition(c1, c2, decay, 1.5)
    assert [got[4], got[5]] == pytest.approx(expected[:2, 2], rel=1e-4)


@pytest.mark.parametrize(
    ("kd", "kp", "expected"), [(1.8, 1.0, 0.9), (3.0, 2.0, 1.0), (1.8, 0.0, 0.0), (0.0, 1.0, 0.0)]
)
def test_constraint_forces_die_away_as_the_edges_errors_do(kd: float, kp: float, expected: float):
    assert constraint_decay(kd, kp) == pytest.approx(expected)
    if kd > 0.0:
        assert -expected == pytest.approx(max(np.roots([1.0, kd, kp]).real))


@pytest.mark.parametrize(
    "c2", [2.0, 2.0 * (1 + 1e-15), 2.0 * (1 - 1e-15), 2.0 * (1 + 1e-9), 2.0 * (1 - 1e-9)]
)
def test_transition_near_critical_damping(c2: float):
    expected = expm(np.array([[0.0, 1.0, 0.0], [-1.0, -c2, 1.0], [0.0, 0.0, 0.0]]) * 0.7)
    a11, a12, a21, a22, b1, b2, _ = transition(1.0, c2, 0.0, 0.7)
    assert np.array([[a11, a12, b1], [a21, a22, b2]]) == pytest.approx(expected[:2], rel=1e-7)


def test_transition_backwards_undoes_it():
    forth, back = (np.array(transition(C1, C2, 0.0, age)[:4]).reshape(2, 2) for age in (0.3, -0.3))
    assert forth @ back == pytest.approx(np.eye(2))


@pytest.mark.parametrize(("c1", "c2", "age"), [(0.4, 1000.0, 2.0), (1.0, 30.0, 60.0), (1e4, 1e4, 60.0)])
def test_strong_damping_does_not_overflow(c1: float, c2: float, age: float):
    """Gains and horizons that the fleet file allows: cosh(omega T) alone would leave the floats."""
    step = transition(c1, c2, 0.0, age)
    assert np.isfinite(step).all()
    slow = c1 / (0.5 * c2 + np.sqrt(0.25 * c2 * c2 - c1))  # the slow pole
    assert step[0] == pytest.approx(exp(-slow * age), rel=0.05)


# ---------------------------------------------------------------------- prediction


@pytest.mark.parametrize("age_ns", [0, PERIOD // 2, 3 * PERIOD, S // 2, 2 * S])
def test_prediction_is_the_navigation_loop_solved(age_ns: int):
    """e'' = -c1 e - c2 e' + F_c with F_c held, by scipy, each neighbour its own; F_n follows by (21)."""
    generator = np.random.default_rng(3)
    known, sent = neighbours(), {}
    stamp = T0 + 5 * PERIOD
    for robot in OFFSETS:
        position, velocity, constraint = map(tuple, generator.normal(size=(3, 2)).tolist())
        sent[robot] = message(robot, 0, stamp, True, position, velocity, constraint)
    heard(known, *sent.values(), now_ns=stamp + PERIOD)
    now = stamp + age_ns
    prediction = known.predict(now, circling, T0)
    assert known.ids == (2, 5, 9)
    x0, x1 = np.array(circling(stamp)), np.array(circling(now))
    for column, robot in enumerate(known.ids):
        said, offset = np.array(sent[robot][4:12]), np.array(OFFSETS[robot])
        held = said[6:8]
        start = np.concatenate([said[0:2] - x0[0:2] - offset, said[2:4] - x0[2:4]])
        end = start
        if age_ns:
            solution = solve_ivp(
                lambda _t, y, held=held: np.concatenate([y[2:], -C1 * y[:2] - C2 * y[2:] + held]),
                (0.0, age_ns / S),
                start,
                method="DOP853",
                rtol=1e-12,
                atol=1e-13,
            )
            end = solution.y[:, -1]
        assert prediction[column].position == pytest.approx(end[:2] + x1[0:2] + offset, abs=1e-9)
        assert prediction[column].velocity == pytest.approx(end[2:] + x1[2:4], abs=1e-9)
        expected = x1[4:6] - C1 * end[:2] - C2 * end[2:]
        assert prediction[column].navigation == pytest.approx(expected, abs=1e-9)
        assert prediction[column].constraint == tuple(held)


def test_before_the_epoch_a_neighbour_stands():
    """A message of the warm-up is of a robot at rest that begins to follow at the epoch."""
    known = neighbours()
    heard(
        known, *(message(r, 0, T0 - 5 * PERIOD, position=(3.0, 4.5)) for r in OFFSETS), now_ns=T0 - 4 * PERIOD
    )
    at_epoch = known.predict(T0, standing, T0)
    assert at_epoch[0].position == pytest.approx((3.0, 4.5))
    later = known.predict(T0 + S, standing, T0)
    column = known.ids.index(9)
    offset = np.array(OFFSETS[9])
    error = np.array((3.0, 4.5)) - (3.0, 4.0) - offset
    a11, _, a21, *_ = transition(C1, C2, 0.0, 1.0)
    assert later[column].position == pytest.approx(a11 * error + (3.0, 4.0) + offset)
    assert later[column].velocity == pytest.approx(a21 * error)


def test_a_braking_neighbour_coasts_to_a_stop():
    known = neighbours()
    heard(known, message(5), message(9))
    heard(known, message(2, 0, T0, False, (1.0, 2.0), (0.5, -0.3), (9.0, 9.0)))
    for age in (0.0, 0.1, 0.4, 2.0):
        prediction = known.predict(T0 + round(age * S), circling, T0)
        remains = exp(-age / BRAKING_TIME_S)
        assert prediction[0].velocity == pytest.approx((0.5 * remains, -0.3 * remains))
        way = BRAKING_TIME_S * (1.0 - remains)
        assert prediction[0].position == pytest.approx((1.0 + 0.5 * way, 2.0 - 0.3 * way))
        assert prediction[0].navigation == prediction[0].constraint == (0.0, 0.0)
    # Neighbours that follow are predicted as ever.
    other = heard(neighbours(), *(message(robot) for robot in OFFSETS)).predict(T0 + S, circling, T0)
    braking = known.predict(T0 + S, circling, T0)
    assert braking[1:] == other[1:]


def test_a_neighbour_that_brakes_before_the_epoch_coasts_from_its_message():
    known = neighbours()
    heard(known, message(5), message(9), message(2, 0, T0 - S, False, (1.0, 2.0), (0.5, 0.0)))
    prediction = known.predict(T0 + S, circling, T0)
    assert prediction[0].position == pytest.approx((1.1, 2.0), abs=1e-4)


# ---------------------------------------------------------------------- taken and refused


def test_reasons_of_refusal():
    known = heard(neighbours(), message(2, 4, T0))
    now = T0 + PERIOD
    before = (known.received, known.lost, known.delayed, known.ages_ns(now), known.heard())
    assert known.accept(message(3, 0, T0), now) == "stranger"
    assert known.accept(message(1, 0, T0), now) == "stranger"  # not even itself
    assert known.accept(message(2, 5, now + FUTURE_NS_MAX + 1), now) == "future"
    assert known.accept(message(2, 4, T0), now) == "duplicate"
    assert known.accept(message(2, 3, T0 - 1), now) == "out_of_order"
    assert known.accept(message(2, 9, T0 - PERIOD), now) == "out_of_order"  # the time decides
    assert (known.received, known.lost, known.delayed, known.ages_ns(now), known.heard()) == before
    assert known.duplicated == 1


def test_a_refused_message_changes_nothing():
    known = heard(neighbours(), *(message(robot, 4, T0, position=(1.0, 2.0)) for robot in OFFSETS))
    expected = known.predict(T0 + S, circling, T0)
    now = T0 + PERIOD
    wild = {"position": (9.0, 9.0), "constraint": (5.0, 5.0), "multipliers": ((1, 7.0),)}
    for refused in (
        message(3, 0, T0, **wild),
        message(2, 5, now + 2 * FUTURE_NS_MAX, **wild),
        message(2, 4, T0, following=False, **wild),
        message(2, 3, T0 - 1, **wild),
    ):
        assert known.accept(refused, now) is not None
    assert known.predict(T0 + S, circling, T0) == expected
    multipliers = np.ones(3)
    known.average(multipliers)
    assert multipliers.tolist() == [1.0, 1.0, 1.0]


def test_lost_messages_are_counted_by_the_gaps():
    known = neighbours()
    for sequence in (3, 4, 7, 8, 12):  # the first says nothing of what was before
        heard(known, message(2, sequence, T0 + sequence * PERIOD), now_ns=T0 + (sequence + 1) * PERIOD)
    assert known.received == 5
    assert known.lost == 2 + 3


def test_a_late_message_is_counted_as_delayed():
    known = neighbours()
    for sequence, age in enumerate((PERIOD, 2 * PERIOD, 2 * PERIOD + 1, 10 * PERIOD)):
        stamp = T0 + sequence * S
        heard(known, message(2, sequence, stamp), now_ns=stamp + age)
    assert known.delayed == 2


def test_duplicates_are_counted():
    known = heard(neighbours(), message(2, 0, T0), message(5, 0, T0))
    for _ in range(3):
        assert known.accept(message(2, 0, T0), T0 + PERIOD) == "duplicate"
    assert (known.received, known.duplicated, known.lost) == (2, 3, 0)


def test_a_sender_that_starts_again_is_taken_and_loses_nothing():
    known = heard(neighbours(), message(2, 500, T0))
    heard(known, message(2, 0, T0 + S), now_ns=T0 + S + PERIOD)
    assert known.ages_ns(T0 + S + PERIOD)[0] == PERIOD
    assert known.lost == 0
    heard(known, message(2, 2, T0 + S + 2 * PERIOD), now_ns=T0 + S + 3 * PERIOD)
    assert known.lost == 1


def test_ages():
    known = heard(neighbours(), message(5, 0, T0))
    assert known.ages_ns(T0 + S) == [None, S, None]
    assert known.ages_ns(T0 - 5) == [None, -5, None]  # its clock is ahead


def test_no_neighbours():
    alone = Neighbours(1, {}, C1, C2, PERIOD)
    assert alone.ids == ()
    assert alone.ages_ns(T0) == []
    assert alone.accept(message(2), T0) == "stranger"
    alone.begin(T0)


def test_numbers_that_jump_lose_nothing():
    """A mission sets them from a count to its rounds: no more is lost than there was time for."""
    known = heard(neighbours(), message(2, 7, T0))
    heard(known, message(2, 2**20, T0 + PERIOD), now_ns=T0 + 2 * PERIOD)
    assert known.lost == 0
    heard(known, message(2, 2**21, T0 + 3 * PERIOD), now_ns=T0 + 4 * PERIOD)
    assert known.lost == 1


@pytest.mark.parametrize("jitter_ns", [-PERIOD // 4, PERIOD // 4])
def test_losses_are_counted_by_stamps_that_jitter(jitter_ns: int):
    known = heard(neighbours(), message(2, 0, T0))
    heard(known, message(2, 1, T0 + PERIOD + jitter_ns), now_ns=T0 + 3 * PERIOD)
    heard(known, message(2, 4, T0 + 4 * PERIOD), now_ns=T0 + 5 * PERIOD)
    assert known.lost == 2


def test_counts_of_each_neighbour():
    known = heard(neighbours(), message(2, 0, T0), message(5, 0, T0), message(9, 0, T0))
    now = T0 + 8 * PERIOD
    heard(known, message(9, 4, T0 + 4 * PERIOD), message(5, 6, T0 + 6 * PERIOD), now_ns=now)
    assert known.accept(message(9, 4, T0 + 4 * PERIOD), now) == "duplicate"
    assert known.accept(message(2, 8, now), now) is None  # waits
    assert known.accept(message(2, 8, now), now) == "duplicate"
    assert known.ids == (2, 5, 9)
    assert known.received_by == [1, 2, 2]
    assert known.lost_by == [0, 5, 3]
    assert known.delayed_by == [0, 0, 1]
    assert known.duplicated_by == [1, 0, 1]
    assert (known.received, known.lost, known.delayed, known.duplicated) == (5, 8, 1, 2)


# ---------------------------------------------------------------------- messages of this tick


def test_a_message_of_this_tick_waits_for_the_next():
    known = heard(neighbours(), message(2, 0, T0), now_ns=T0 + PERIOD)
    now = T0 + PERIOD
    assert known.accept(message(2, 1, now), now) is None
    assert known.ages_ns(now)[0] == PERIOD
    known.begin(now)
    assert known.ages_ns(now)[0] == PERIOD  # still this tick
    known.begin(now + PERIOD)
    assert known.ages_ns(now + PERIOD)[0] == PERIOD
    assert (known.received, known.lost) == (2, 0)


def test_a_neighbour_whose_messages_always_come_in_their_own_tick_is_heard():
    """Its process always wakes a little earlier than this one: each drain then holds the message of
    this tick, before the last one's has been taken."""
    known = neighbours()
    for tick in range(50):
        now = T0 + tick * PERIOD
        assert known.accept(message(2, tick, now), now) is None  # the drain
        known.begin(now)  # the tick
        age = known.ages_ns(now)[0]
        assert age == (None if tick == 0 else PERIOD), f"tick {tick}"
    assert (known.received, known.lost) == (49, 0)


def test_early_and_late_by_turns_loses_nothing():
    known = neighbours()
    late: list[HandState] = []
    for tick in range(60):
        now = T0 + tick * PERIOD
        for one in late:
            assert known.accept(one, now) is None
        late = []
        if tick % 3:
            assert known.accept(message(2, tick, now), now) is None
        else:
            late.append(message(2, tick, now))
        known.begin(now)
        if tick:
            assert known.ages_ns(now)[0] == PERIOD, f"tick {tick}"
    assert known.lost == 0


def test_a_duplicate_of_a_waiting_message_is_a_duplicate():
    known = neighbours()
    assert known.accept(message(2, 0, T0), T0) is None
    assert known.accept(message(2, 0, T0), T0) == "duplicate"
    known.begin(T0 + PERIOD)
    assert (known.received, known.duplicated) == (1, 1)


def test_a_message_from_a_clock_ahead_is_taken_at_once():
    """More than a tick ahead and less than FUTURE_NS_MAX: it is no message of this tick."""
    known = neighbours()
    heard(known, message(2, 0, T0 + 3 * PERIOD), now_ns=T0)
    assert known.ages_ns(T0)[0] == -3 * PERIOD
    heard(known, message(5, 0, T0 + FUTURE_NS_MAX), now_ns=T0)


def test_a_message_that_waits_is_dropped_for_a_newer_one():
    """A clock that jumps ahead: what waits is of before."""
    known = heard(neighbours(), message(2, 0, T0))
    now = T0 + PERIOD
    heard(known, message(2, 1, now), message(2, 2, now + 3 * PERIOD), now_ns=now)
    known.begin(now + PERIOD)
    assert known.ages_ns(now + PERIOD)[0] == -2 * PERIOD
    assert known.received == 2


# ---------------------------------------------------------------------- multipliers


def test_multipliers_are_averaged_with_the_neighbours_copies_once():
    known = neighbours()
    heard(
        known,
        message(2, multipliers=((7, 100.0), (1, 3.0))),
        message(5, multipliers=((7, 5.0),)),  # not about this edge
        message(9, multipliers=()),
    )
    multipliers = np.array([1.0, 2.0, 3.0])
    known.average(multipliers)
    assert multipliers.tolist() == [2.0, 2.0, 3.0]
    known.average(multipliers)
    assert multipliers.tolist() == [2.0, 2.0, 3.0]
    heard(known, message(2, 1, T0 + PERIOD, multipliers=((1, -2.0),)), now_ns=T0 + 2 * PERIOD)
    known.average(multipliers)
    assert multipliers.tolist() == [0.0, 2.0, 3.0]


# ---------------------------------------------------------------------- clocks that differ


def echo(offset_ns: int) -> tuple[tuple[int, int], ...]:
    """What a neighbour whose clock is so far ahead hears of robot 1's messages, each a period old."""
    return (7, 1), (1, (PERIOD + offset_ns) // 1000), (8, 2)


def ahead(offset_ns: int, *robots: int) -> Neighbours:
    """Knows these neighbours' clocks to be ahead by a multiple of the period; last heard at T0."""
    known = neighbours()
    for tick in range(-4, 1):
        now = T0 + tick * PERIOD
        stamp = now - PERIOD + offset_ns
        heard(known, *(message(r, tick + 4, stamp, heard=echo(offset_ns)) for r in robots), now_ns=now)
    for robot in robots:
        assert known.clocks[known.ids.index(robot)].used_ns == offset_ns
    return known


@pytest.mark.parametrize("offset_ns", [5 * PERIOD, -7 * PERIOD])
def test_a_clock_that_is_off_makes_no_age(offset_ns: int):
    known = ahead(offset_ns, 2)
    assert known.ages_ns(T0 + 3 * PERIOD) == [4 * PERIOD, None, None]
    before = known.delayed  # what came before the offset was known
    for tick, age in ((1, PERIOD), (2, 2 * PERIOD), (3, 3 * PERIOD)):
        stamp = T0 + tick * PERIOD + offset_ns
        one = message(2, 4 + tick, stamp, heard=echo(offset_ns))
        heard(known, one, now_ns=stamp - offset_ns + age)
    assert known.delayed == before + 1


def test_the_messages_of_this_tick_wait_by_the_neighbours_clock():
    known = ahead(5 * PERIOD, 2, 5)
    now = T0 + PERIOD
    said = echo(5 * PERIOD)
    assert known.accept(message(2, 5, now + 5 * PERIOD - 1, heard=said), now) is None  # of the last tick
    assert known.accept(message(5, 5, now + 5 * PERIOD, heard=said), now) is None
    assert known.ages_ns(now) == [1, 2 * PERIOD, None]
    known.begin(now + PERIOD)
    assert known.ages_ns(now + PERIOD) == [PERIOD + 1, PERIOD, None]


def test_the_future_begins_by_the_neighbours_clock():
    known = ahead(5 * PERIOD, 2)
    now = T0 + PERIOD
    limit = now + 5 * PERIOD + FUTURE_NS_MAX
    assert known.accept(message(2, 5, limit + 1), now) == "future"
    assert known.accept(message(5, 5, now + FUTURE_NS_MAX + 1), now) == "future"
    assert known.accept(message(2, 5, limit), now) is None


def test_a_clock_that_was_behind_and_is_set_is_not_refused():
    """Its messages would be of the future for what it was, and nothing could unlearn that."""
    known = ahead(-40 * PERIOD, 2)
    now = T0 + PERIOD
    for tick in range(3):
        now = T0 + (1 + tick) * PERIOD
        assert known.accept(message(2, tick, now - PERIOD, heard=echo(0)), now) is None
    assert known.ages_ns(now)[0] == PERIOD
    assert known.clocks[0].used_ns == 0


def test_how_far_ahead_a_refused_clock_is():
    known = heard(neighbours(), message(2, 0, T0))
    now = T0 + PERIOD
    assert known.ahead_ns == [0, 0, 0]
    assert known.accept(message(5, 0, now + 800_000_000), now) == "future"
    assert known.accept(message(5, 1, now + 790_000_000), now) == "future"
    assert known.ahead_ns == [0, 790_000_000, 0]
    assert known.accept(message(5, 2, now - 1), now) is None  # it was set right
    assert known.ahead_ns == [0, 0, 0]


def test_what_is_echoed():
    known = heard(neighbours(), message(2, 0, T0), message(9, 0, T0))
    assert known.heard() == ()  # one message alone proves nothing
    now = T0 + 2 * PERIOD
    heard(known, message(2, 1, T0 + PERIOD), message(9, 1, now + 4 * PERIOD), now_ns=now)
    heard(known, message(9, 2, now + 5 * PERIOD), now_ns=now + PERIOD)
    said = known.heard()
    assert said == ((2, 20_000), (9, -80_000))
    heard(known, message(2, 2, T0 + 2 * PERIOD), now_ns=T0 + 3 * PERIOD)
    assert known.heard() is said  # not made anew for every message


def test_a_message_that_waits_is_echoed_by_when_it_came():
    known = neighbours()
    for tick in range(3):
        now = T0 + tick * PERIOD
        heard(known, message(2, tick, now), now_ns=now)
    assert known.heard() == ((2, 0),)


def test_a_refused_message_says_nothing_of_clocks():
    known = ahead(5 * PERIOD, 2)
    clock, now = known.clocks[0], T0 + PERIOD
    said = clock.used_ns, clock.offset_us, clock.error_us, known.heard()
    lie = ((1, 9_000_000),)
    for refused in (
        message(2, 9, now + S, heard=lie),
        message(2, 4, T0 + 4 * PERIOD, heard=lie),
        message(2, 3, T0 + 4 * PERIOD - 1, heard=lie),
    ):
        for _ in range(3):
            assert known.accept(refused, now) is not None
    assert (clock.used_ns, clock.offset_us, clock.error_us, known.heard()) == said


@pytest.mark.parametrize("following", [True, False])
@pytest.mark.parametrize("ticks", [5, -7])
def test_a_neighbour_is_carried_forward_in_its_own_clock(following: bool, ticks: int):
    """It is where one with the right clock would be that much later (or earlier) on its way."""
    offset_ns = ticks * PERIOD
    known, plain = ahead(offset_ns, 2, 5, 9), neighbours()
    vectors = (0.1, 1.0), (0.3, -0.2), (0.1, 0.2)
    for robot in OFFSETS:
        state = message(robot, 5, T0 + offset_ns, following, *vectors)
        heard(known, state._replace(heard=echo(offset_ns)), now_ns=T0 + PERIOD)
        heard(plain, state, now_ns=T0 + offset_ns + PERIOD)
    for age_ns in (PERIOD // 2, 3 * PERIOD, S):
        for epoch_ns in (T0 - S, T0 + offset_ns + 2 * PERIOD):
            shown = known.predict(T0 + age_ns, circling, epoch_ns)
            assert shown == plain.predict(T0 + offset_ns + age_ns, circling, epoch_ns)


def test_equal_clocks_change_no_bit_and_no_lookup():
    """What is known of them is no reason to reckon otherwise: runs are compared with simulations."""
    known, plain = ahead(0, 2, 5, 9), neighbours()
    assert all(clock.error_us == PERIOD // 1000 for clock in known.clocks)
    state = {"position": (0.1, 1.0), "velocity": (0.3, -0.2), "constraint": (0.1, 0.2)}
    for robot in OFFSETS:
        for one in (known, plain):
            heard(one, message(robot, 5, T0, heard=echo(0), **state), now_ns=T0 + PERIOD)
    lookups: list[list[int]] = []

    def watched(time_ns: int) -> tuple[float, float, float, float, float, float]:
        lookups[-1].append(time_ns)
        return circling(time_ns)

    results = []
    for one in (known, plain):
        lookups.append([])
        results.append(one.predict(T0 + 3 * PERIOD, watched, T0 - S))
    assert results[0] == results[1]
    assert lookups == [[T0 + 3 * PERIOD, T0, T0, T0]] * 2


# ---------------------------------------------------------------------- prediction switched off


@pytest.mark.parametrize("age_ns", [0, PERIOD, 2 * S])
def test_without_prediction_a_state_is_taken_as_it_came(age_ns: int):
    known = Neighbours(1, OFFSETS, C1, C2, PERIOD, predict=False)
    state = {"position": (1.0, 2.0), "velocity": (0.5, -0.3), "constraint": (0.1, 0.2)}
    heard(known, message(2, 0, T0, navigation=(0.7, 0.8), **state))
    heard(known, message(5, 0, T0, False, navigation=(0.7, 0.8), **state))
    heard(known, message(9, 0, T0, **state))
    assert known.ages_ns(T0 + age_ns) == [age_ns] * 3
    following, braking, _ = known.predict(T0 + age_ns, circling, T0)
    assert following == ((1.0, 2.0), (0.5, -0.3), (0.7, 0.8), (0.1, 0.2))
    assert braking == ((1.0, 2.0), (0.5, -0.3), (0.0, 0.0), (0.0, 0.0))


def test_sequence_numbers_far_apart_keep_the_counters_small():
    """Sequence numbers may be anything up to 2**62: what is sent as a counter must stay an int64."""
    known = neighbours()
    for step in range(12):
        heard(
            known,
            message(2, 0 if step % 2 else 2**62 - 1, T0 + step * PERIOD),
            now_ns=T0 + (step + 1) * PERIOD,
        )
    assert known.lost < 2**63
