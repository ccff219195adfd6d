"""When a robot says where it is, and that others always know it well enough."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from math import cos, hypot, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_MS, NS_PER_S
from handfast.agent.control.peers.beliefs import said_doubt
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Beacon, Silent
from handfast.agent.supervision import beacon_schedule
from handfast.agent.supervision.beacon_schedule import (
    HURRIES_HZ,
    ONWARD,
    RELAY_NS,
    SURE_M,
    WAY_M,
    BeaconSchedule,
    Onward,
)

T0 = 1000 * NS_PER_S
MARKS = (3, 7, -1, -1)


def fleet(robots: int = 6, rate_hz: float = 10.0, **avoidance: float) -> Fleet:
    lines = ["[fleet]", 'name = "row"', f"rate_hz = {rate_hz}", "[formation]", "edges = [[1, 2]]"]
    lines += [f"offsets = {[[2 * k, 0] for k in range(robots)]}", "safe_distance_m = 0.3", "[avoidance]"]
    lines += [f"{key} = {value}" for key, value in avoidance.items()]
    for k in range(robots):
        lines += ["[[robot]]", f"id = {k + 1}", f"x_m = {2 * k}", "y_m = 0"]
    return parse_fleet("\n".join(lines), source="here")


def beacon(
    now_ns: int,
    place: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    robot: int = 2,
    marks: tuple[int, int, int, int] = MARKS,
    silent: tuple[Silent, ...] = (),
    unheard: tuple[int, ...] = (),
    follows: bool = True,
    overload: int = 0,
) -> Beacon:
    return Beacon(robot, 0, now_ns, follows, *place, 0.0, *marks, silent, unheard, overload=overload)


class Bench:
    """Robot 2 of a fleet that says seldom where it is: at 10 Hz every other tick is a turn."""

    def __init__(
        self, made: Fleet | None = None, onward: Onward | None = None, *, loses: bool = True
    ) -> None:
        self.fleet = made or fleet(beacon_interval_max_s=1.6)
        self.schedule = BeaconSchedule(self.fleet, 2, self.fleet.period_ns // 2, onward)
        self.schedule.loses = loses
        self.now_ns = T0 + self.fleet.period_ns // 2
        self.said: list[tuple[float, Beacon]] = []

    def run(self, duration_s: float, **fields: object) -> list[float]:
        """When (s) something is said meanwhile, if all goes on as it is."""
        since = len(self.said)
        for _ in range(round(duration_s * self.fleet.fleet.rate_hz)):
            if self.schedule.is_turn(self.now_ns):
                made = self.schedule.timed(beacon(self.now_ns, **fields))  # type: ignore[arg-type]
                if made is not None:
                    self.said.append(((self.now_ns - T0) / NS_PER_S, made))
            self.now_ns += self.fleet.period_ns
        return [round(at - 0.05, 1) for at, _ in self.said[since:]]

    def later_s(self) -> list[float]:
        return [made.next_ms / 1e3 for _, made in self.said]


@pytest.fixture(autouse=True)
def _alone(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """One robot's times, without its share of the fleet's."""
    if "spread" not in request.fixturenames:
        monkeypatch.setattr(beacon_schedule, "APART", (0.0, 0.0))


@pytest.mark.parametrize("spread", [True])
def test_robots_that_begin_together_do_not_speak_together_for_ever(spread: bool) -> None:
    made = fleet(robots=60)
    schedules = [BeaconSchedule(made, robot, 0) for robot in made.ids]
    said: Counter[int] = Counter()
    for tick in range(200):
        now_ns = T0 + tick * made.period_ns
        for schedule, robot in zip(schedules, made.ids, strict=True):
            if schedule.is_turn(now_ns) and schedule.timed(beacon(now_ns, robot=robot)) is not None:
                said[tick] += 1
    assert max(said[tick] for tick in range(3)) >= 30, "news are told at once"
    longest = made.beacon_rounds_max
    for first in range(60, 200 - longest, longest):
        each = [said[tick] for tick in range(first, first + longest)]
        assert sum(each) == 60
        assert max(each) <= 9, each


@pytest.mark.patches
def test_who_lacks_an_order_says_so_soon_and_once_more() -> None:
    for marks in ((4, 0, -1, -1), (3, 9, -1, -1), (3, 7, 5, -1), (3, 7, -1, 6), (2, 9, 5, -1)):
        bench = quiet(loses=False)
        bench.schedule.heard(beacon(T0, robot=5, marks=marks), MARKS)
        assert bench.run(1.2) == [5.0, 6.0], marks
        bench.schedule.heard(beacon(T0, robot=5, marks=marks), MARKS)  # the same again: that it has said
        assert bench.run(1.5) == [7.6]


@pytest.mark.parametrize("spread", [True])
@pytest.mark.parametrize(("robots", "most_hz", "told_s"), [(60, 100, 0.9), (100, 100, 1.3), (200, 50, 4.2)])
def test_what_all_lack_no_more_of_them_say_in_a_second_than_all_can_hear(
    robots: int, most_hz: int, told_s: float, spread: bool
) -> None:
    """It is one of them that who has it needs to hear."""
    made = fleet(robots=robots)
    told: Counter[int] = Counter()
    last_ns = 0
    later = (MARKS[0] + 1, *MARKS[1:])
    for robot in range(1, robots + 1):
        schedule, has_said = BeaconSchedule(made, robot, 0), False
        for k in range(160):  # it comes after 8 s
            now_ns = T0 + k * made.period_ns
            if k == 80:
                schedule.heard(beacon(T0, robot=robots + 1, marks=later), MARKS)
            if schedule.is_turn(now_ns) and schedule.timed(beacon(now_ns, robot=robot)):
                if k >= 80 and not has_said:
                    told[k // 5] += 1
                    last_ns = max(last_ns, now_ns - T0 - 8 * NS_PER_S)
                has_said = k >= 80
    assert sum(told.values()) == robots
    assert max(told.values()) <= 0.5 * most_hz + 30, "with those that were due anyway"
    assert last_ns <= told_s * NS_PER_S


def test_a_small_fleet_says_it_at_every_turn_and_nothing_of_it() -> None:
    bench = Bench(fleet())
    assert not bench.schedule.is_seldom
    assert bench.run(1.0) == [0.0, 0.2, 0.4, 0.6, 0.8]
    assert bench.later_s() == [0.0] * 5


def test_robots_take_turns() -> None:
    made = fleet()
    turns = []
    for robot in (1, 2, 3):
        schedule = BeaconSchedule(made, robot, 0)
        turns.append([k for k in range(10) if schedule.is_turn(T0 + k * made.period_ns)])
    assert turns == [[1, 3, 5, 7, 9], [0, 2, 4, 6, 8], [1, 3, 5, 7, 9]]


@pytest.mark.patches
def test_while_nothing_is_new_it_is_said_ever_more_seldom() -> None:
    bench = Bench()
    assert bench.schedule.is_seldom
    assert bench.run(6.4) == [0.0, 0.2, 0.6, 1.4, 3.0, 4.6, 6.2]
    assert bench.later_s() == [0.0, 0.4, 0.8, 1.6, 1.6, 1.6, 1.6]


def quiet(*, loses: bool = True) -> Bench:
    bench = Bench(loses=loses)
    bench.run(5.0)
    return bench


@pytest.mark.patches
def test_where_links_lose_nothing_what_is_new_is_said_once_more_and_then_as_seldom_as_ever() -> None:
    bench = quiet(loses=False)
    assert bench.run(4.0, follows=False) == [5.0, 5.2, 6.8, 8.4]


def test_others_carry_it_on_at_the_mean_velocity_by_the_law() -> None:
    asked: list[int] = []

    def onward(here: Beacon, for_ns: int) -> tuple[float, float]:
        asked.append(for_ns)
        return 0.25, -0.5

    bench = Bench(onward=onward, loses=False)
    bench.run(0.2, place=(0.0, 0.0, 0.1, 0.0))
    bench.run(0.2, place=(0.05, -0.1, 0.1, 0.0))
    assert [made.place for _, made in bench.said] == [(0.0, 0.0, 0.25, -0.5), (0.05, -0.1, 0.25, -0.5)]
    assert asked == [round(ONWARD * 1.6 * NS_PER_S)] * 2
    stands = Bench(onward=onward)
    stands.run(0.2, place=(0.0, 0.0, 0.1, 0.0), follows=False)
    assert stands.said[0][1].place == (0.0, 0.0, 0.1, 0.0)
    assert len(asked) == 2
    nowhere = Bench(onward=lambda here, for_ns: None)
    nowhere.run(0.2, place=(0.0, 0.0, 0.1, 0.0))
    assert nowhere.said[0][1].place == (0.0, 0.0, 0.1, 0.0)


def test_one_that_is_held_up_tells_the_velocity_that_it_has_until_the_law_is_right_again() -> None:
    """Else others would look for it further on all the time, and it would say each time where it is."""
    bench = Bench(onward=lambda here, for_ns: (0.3, 0.0), loses=False)
    bench.run(20.0)
    at_first = [(at, made.vx) for at, made in bench.said]
    assert at_first[0] == (pytest.approx(0.05), 0.3)
    assert all(vx == 0.0 for _, vx in at_first[2:])
    assert len(at_first) < 20.0 / 1.6 + 4
    since, began_ns = len(bench.said), bench.now_ns
    for _ in range(100):
        bench.run(0.1, place=(0.3 * (bench.now_ns - began_ns) / NS_PER_S, 0.0, 0.3, 0.0))
    assert all(made.vx == 0.3 for _, made in bench.said[since:])
    assert len(bench.said) - since < 10.0 / 1.6 + 4


@pytest.mark.patches
def test_what_is_new_is_said_at_the_next_turn_and_again() -> None:
    row = Silent(4, T0, True, 1.0, 2.0, 0.0, 0.0, 1.0, 2.0, 0.0)
    for fields in (
        {"place": (0.5, 0.0, 0.0, 0.0)},
        {"follows": False},
        {"unheard": (4,)},
        {"silent": (row,)},
    ):
        bench = quiet()
        assert bench.run(2.0, **fields) == [5.0, 5.2, 5.6, 6.4]
        assert bench.said[-4][1].next_ms == 0


@pytest.mark.patches
def test_who_moves_as_it_said_has_nothing_new_to_say() -> None:
    bench = Bench()
    for _ in range(40):
        x = 0.3 * (bench.now_ns - T0) / NS_PER_S
        bench.run(0.1, place=(x, 0.0, 0.3, 0.0))
    assert len(bench.said) == 5


def test_on_its_way_it_says_where_it_is_before_it_has_gone_far() -> None:
    for speed, most_s in ((0.3, 1.6), (1.0, 1.2), (2.0, 0.6), (8.0, 0.2)):
        bench = Bench()
        for _ in range(80):
            x = speed * (bench.now_ns - T0) / NS_PER_S
            bench.run(0.1, place=(x, 0.0, speed, 0.0))
        times = [at for at, _ in bench.said]
        assert max(b - a for a, b in pairwise(times)) == pytest.approx(most_s)
        assert max(speed * max(0.2, later) for later in bench.later_s()) <= max(WAY_M, 0.2 * speed) + 1e-9


def test_a_silent_robot_is_told_of_again_where_there_is_news_of_it() -> None:
    row = Silent(4, T0, True, 1.0, 2.0, 0.0, 0.0, 1.0, 2.0, 0.0)
    bench = Bench()
    bench.run(5.0, silent=(row,))
    assert bench.run(1.0, silent=(row._replace(x=1.5, time_ns=T0 + NS_PER_S),)) == [5.0, 5.2, 5.6]


def test_of_more_silent_robots_than_there_is_room_for_it_tells_in_turn_and_hurries_for_none_twice() -> None:
    rows = [Silent(k, T0, True, float(k), 2.0, 0.0, 0.0, float(k), 2.0, 0.0) for k in range(3, 43)]
    bench = Bench()
    for turn in range(200):
        first = 16 * turn % 40
        bench.run(0.1, silent=tuple((rows + rows)[first : first + 16]))
    times = [at for at, _ in bench.said]
    assert {row.robot for _, made in bench.said[:8] for row in made.silent} == set(range(3, 43))
    assert sum(at > 10.0 for at in times) <= 7, "all have been told of, and nothing is new"


def test_who_is_heard_here_and_not_elsewhere_is_told_of_at_least_every_second() -> None:
    bench = Bench()
    for _ in range(100):
        bench.run(0.1, silent=(Silent(4, bench.now_ns, True, 1.0, 2.0, 0.0, 0.0, 1.0, 2.0, 0.0),))
    times = [at for at, _ in bench.said]
    assert max(b - a for a, b in pairwise(times)) < RELAY_NS / NS_PER_S + 0.01
    assert len(times) < 15


@pytest.mark.patches
def test_who_does_not_hear_it_hears_it_soon() -> None:
    bench = quiet()
    bench.schedule.heard(beacon(T0, robot=5, unheard=(2,)), MARKS)
    assert bench.run(1.0) == [5.0, 5.2, 5.6]
    bench.schedule.heard(beacon(T0, robot=5, unheard=(2,)), MARKS)  # it says the same: nobody hurries for it
    assert bench.run(1.0) == [6.4]


def test_of_another_its_first_beacon_is_news_and_one_with_other_orders_or_another_word_of_this_robot() -> (
    None
):
    schedule = quiet().schedule
    first = beacon(T0, robot=5)
    assert schedule.is_news(first)
    schedule.heard(first, MARKS)
    assert not schedule.is_news(beacon(T0 + 1, robot=5))
    assert not schedule.is_news(beacon(T0 + 1, robot=5, unheard=(3,)))
    assert schedule.is_news(beacon(T0 + 1, robot=5, unheard=(2,)))
    assert schedule.is_news(beacon(T0 + 1, robot=5, marks=(MARKS[0] + 1, *MARKS[1:])))
    assert schedule.is_news(beacon(T0 + 1, robot=6))


@pytest.mark.parametrize(("spread", "quiet_s"), [(True, 0), (True, 20)])
def test_what_all_hurried_for_at_once_they_do_not_hurry_for_at_once_again(spread: bool, quiet_s: int) -> None:
    """Each has its share of what hurries; if all had it back in one tick, all would speak in that. Nor do all
    have it in the tick in which a fleet that has just started begins to miss each other."""
    made = fleet(robots=60, beacon_interval_max_s=1.6)
    hurried: Counter[int] = Counter()
    for robot in range(1, 61):
        schedule = BeaconSchedule(made, robot, 0)
        for k in range(-10 * quiet_s, 0):
            if schedule.is_turn(T0 + k * made.period_ns):
                schedule.timed(beacon(T0 + k * made.period_ns, robot=robot))
        for k in range(400):
            now_ns = T0 + k * made.period_ns
            if schedule.is_turn(now_ns):
                before = schedule._hurried_ns if schedule._said is not None else None
                # That nobody is heard any more, and who that is changes all the time.
                schedule.timed(beacon(now_ns, robot=robot, unheard=(100 + k % 7,)))
                hurried[k // 10] += before is not None and schedule._hurried_ns != before
    assert hurried[0] == 60 if quiet_s else hurried[0] <= 2 * HURRIES_HZ
    assert max(hurried[second] for second in range(1, 40)) <= 2 * HURRIES_HZ
    assert sum(hurried[second] for second in range(1, 40)) <= 1.5 * 39 * HURRIES_HZ


def test_while_no_mission_is_near_it_is_news_only_of_those_that_it_minds() -> None:
    for minds, news in ((None, True), ((3,), False), ((4,), True)):
        bench = quiet()
        bench.schedule.minds = minds
        times = bench.run(1.0, unheard=(4,))
        assert (len(times) >= 2) is news, minds
        bench = quiet()
        bench.schedule.minds = minds
        bench.schedule.heard(beacon(T0, robot=4, unheard=(2,)), MARKS)
        assert (len(bench.run(1.0)) >= 2) is news, minds


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.integers(1, 12)), min_size=1, max_size=12
    ),
    st.floats(0.0, 6.3),
)
def test_others_always_know_where_it_is(motions: list[tuple[float, float, int]], angle: float) -> None:
    """Whatever it does: by (U2), give or take what it does between two turns."""
    bench = Bench()
    x, y, vx, vy = 0.0, 0.0, 0.3 * cos(angle), 0.3 * sin(angle)
    said: Beacon | None = None
    for ax, ay, rounds in motions:
        for _ in range(rounds):
            turn_ns = bench.now_ns
            bench.run(0.1, place=(x, y, vx, vy))
            if bench.said:
                said = bench.said[-1][1]
                age_s = (turn_ns - said.time_ns) / NS_PER_S
                off = hypot(x - said.x - age_s * said.vx, y - said.y - age_s * said.vy)
                assert off <= said_doubt(age_s) + SURE_M + 0.1 * hypot(vx - said.vx, vy - said.vy) + 0.02
                promised_ns = (said.next_ms or 200) * NS_PER_MS
                assert turn_ns - said.time_ns < promised_ns
            x, y, vx, vy = x + 0.1 * vx, y + 0.1 * vy, vx + 0.1 * ax, vy + 0.1 * ay
