"""Who is not at its place at the end of a drive, and whether that fails it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.fault_rules import FaultsSection, Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Event, Message, Status
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, Path, make_fleet, messages

OFFSETS = [(0.0, 0.0), (1.0, 0.0)]


def pair(velocity: tuple[float, float] = (0.0, 0.0), duration_s: float = 60.0, *rules: Rule) -> Fleet:
    fleet = make_fleet(OFFSETS, [(1, 2)], duration_s=duration_s, rate_hz=10.0, velocity=velocity)
    return replace(fleet, faults=FaultsSection(rules=rules))


def behind(fleet: Fleet, lag: Any) -> list[Path]:
    """Both in formation, `lag(t)` m south of where they should be."""

    def way(offset: tuple[float, float]) -> Path:
        vx, vy = fleet.trajectory.velocity_mps or (0.0, 0.0)
        return lambda t: (offset[0] + vx * max(t, 0.0), offset[1] + vy * max(t, 0.0) - lag(max(t, 0.0)), 0.0)

    return [body(way(offset), 0.1) for offset in OFFSETS]


def run(fleet: Fleet, lag: Any, state: str = "running", told: dict[str, Any] | None = None) -> Recording:
    def said(message: Message) -> Message:
        return message._replace(**told) if told and type(message) is Status else message

    sent = messages(fleet, behind(fleet, lag), state=state)
    return recorded(fleet, [(received, key, said(each)) for received, key, each in sent])


def verdict(recording: Recording) -> tuple[list[str], list[str]]:
    result = RunResult(recording)
    return list(result.reasons), [each for each in result.warnings if "place" in each]


def test_a_fleet_in_formation_far_behind_its_course_fails() -> None:
    """In formation all the time, by its edges."""
    recording = run(pair((0.0, 3.0)), lambda t: 1.5 * t)
    (reason,), warnings = verdict(recording)
    assert reason == (
        "Robots 1 and 2 were up to 90.00 m (robot 1) from their places at the end (60.0 s), where 0.25 m is "
        "allowed: places move at 3.00 m/s and the limit is control.max_speed_mps = 1.5."
    )
    assert warnings == []
    found = RunResult(recording).metrics
    assert (found["settling_time_s"], found["tracking_settling_time_s"]) == (0.0, None)


def test_who_is_off_its_place_for_no_reason_fails() -> None:
    reasons, _ = verdict(run(pair(), lambda t: 0.6 if t > 20.0 else 0.0))
    assert reasons == [
        "Robots 1 and 2 were up to 0.60 m (robot 1) from their places at the end (60.0 s), where 0.25 m is "
        "allowed: the recording does not say why."
    ]
    assert verdict(run(pair(), lambda t: 0.24)) == ([], [])
    assert verdict(run(pair(), lambda t: 0.6 if t > 58.5 else 0.0)) == ([], []), "it was there just now"


def test_a_gap_in_the_poses_puts_nobody_at_its_place() -> None:
    """They were off before it, and are after it: so they were all the while."""
    fleet = pair()

    def seen(recording: Recording) -> Recording:
        """Without all poses from 58.5 s to 59.2 s."""
        robots = {
            robot: replace(data, plant=data.plant.only((data.plant.t < 58.5) | (data.plant.t > 59.2)))
            for robot, data in recording.robots.items()
        }
        return replace(recording, robots=robots, mode="simulate")

    for lag in (lambda t: 0.6 if t > 20.0 else 0.0, lambda t: 0.0):
        whole, gappy = (RunResult(each(run(fleet, lag))) for each in (lambda recording: recording, seen))
        assert len(gappy.analysis.gaps) == 2
        about_places = [
            [each for each in result.reasons if "sent no pose" not in each] for result in (whole, gappy)
        ]
        assert about_places[0] == about_places[1]
        one, other = (result.metrics for result in (whole, gappy))
        assert one["oracles"]["formed"] == other["oracles"]["formed"]
        assert one["tracking_settling_time_s"] == other["tracking_settling_time_s"]
    there = run(fleet, lambda t: 0.6 if 20.0 < t < 58.75 else 0.0)
    times = [RunResult(each).metrics["tracking_settling_time_s"] for each in (there, seen(there))]
    assert times == [58.7, 59.2]


def test_a_formation_that_is_right_in_itself_may_be_a_little_behind() -> None:
    assert verdict(run(pair(), lambda t: 0.3 if t > 20.0 else 0.0)) == (
        [],
        [
            "Robots 1 and 2 were up to 0.30 m (robot 1) from their places at the end (60.0 s), where 0.25 m "
            "is allowed: the formation as a whole, which was right in itself."
        ],
    )


def test_what_it_says_itself_is_the_cause() -> None:
    told = {"state": "degraded", "reason": "held up by robot 6 (silent for 75 s)"}
    (reason,), _ = verdict(run(pair(), lambda t: 0.6, told=told))
    assert reason.endswith("allowed: held up by robot 6 (silent for 75 s).")


def crowd(lag: Callable[[int, float], float], end_s: float = 60.0) -> Recording:
    """Twenty robots in a row, `lag(robot, t)` m south of their places, each with a reason of its own."""
    places = [(float(k), 0.0) for k in range(20)]
    fleet = make_fleet(places, [(k, k + 1) for k in range(1, 20)], duration_s=end_s, rate_hz=10.0)
    ways = [
        body(lambda t, k=k, x=x: (x, -lag(k, max(t, 0.0)), 0.0), 0.1) for k, (x, _) in enumerate(places, 1)
    ]

    def said(message: Message) -> Message:
        return message._replace(reason=f"late by {message.robot} ms") if type(message) is Status else message

    return recorded(fleet, [(received, key, said(each)) for received, key, each in messages(fleet, ways)])


def test_of_many_reasons_those_of_who_is_farthest_off_are_told() -> None:
    """As of a machine that is too slow for two hundred robots: the others are one sentence."""
    reasons, _ = verdict(crowd(lambda robot, t: 0.5 + 0.1 * robot))
    told = [each for each in reasons if "from its place" in each or "from their places" in each]
    assert [each.partition(" was ")[0] for each in told[:-1]] == [f"Robot {k}" for k in range(20, 12, -1)]
    assert told[0].endswith(": late by 20 ms.")
    assert told[-1].startswith("12 robots (1-12) were up to 1.70 m (robot 12) from their places at the end ")
    assert told[-1].endswith(" m is allowed: for 12 more reasons like these.")


def test_a_drive_that_is_too_short_to_get_there_warns() -> None:
    far = pair(duration_s=15.0)
    assert verdict(run(far, lambda t: 30.0 - 1.5 * t)) == (
        [],
        [
            "Robots 1 and 2 were up to 7.50 m (robot 1) from their places at the end (15.0 s), where 0.25 m "
            "is allowed, and coming nearer. The drive ended too early to judge that."
        ],
    )
    assert verdict(run(far, lambda t: 30.0))[0] == [], "an orbit on the way there does not fail a short drive"
    longer = pair(duration_s=40.0)
    assert verdict(run(longer, lambda t: 75.0 - 1.5 * t))[0] == [], "it never was there, and soon will be"
    (reason,), _ = verdict(run(longer, lambda t: 300.0 - 1.5 * t))
    assert "were up to 240.00 m" in reason, "the end of that is not in sight"
    assert reason.endswith("allowed: on the way, and coming nearer.")
    (reason,), _ = verdict(run(longer, lambda t: 300.0 - 1.0 * t))
    assert reason.endswith("allowed: on the way, and coming nearer.")
    (reason,), _ = verdict(run(longer, lambda t: 30.0))
    assert "were up to 30.00 m" in reason
    assert reason.endswith("allowed: the recording does not say why.")


def test_who_has_fallen_back_and_comes_nearer_by_chance_fails() -> None:
    """A course that runs away in a circle comes back to who does not follow."""
    (reason,), _ = verdict(run(pair(), lambda t: 0.0 if t < 10.0 else 8.0 - 0.1 * t))
    assert "were up to 2.00 m" in reason


def noisy(at_s: float, for_s: float) -> Rule:
    return Rule(robot=1, jump_m=0.1, at=at_s, duration=for_s)


@pytest.mark.parametrize(
    ("rule", "excused"),
    [
        (noisy(40.0, 5.0), True),  # its effect may last for another 20 s
        (noisy(30.0, 5.0), False),
        (noisy(30.0, 30.0), True),  # it still holds
        (noisy(50.0, 5.0), False),  # they were off before
    ],
)
def test_what_follows_a_fault_may_take_its_time(rule: Rule, excused: bool) -> None:
    reasons, warnings = verdict(run(pair((0.0, 0.0), 60.0, rule), lambda t: 0.6 if t > 45.0 else 0.0))
    assert (reasons == []) == excused
    assert (len(warnings) == 1) == excused


def test_what_is_killed_for_good_is_a_fault_of_one_moment() -> None:
    """Though its rule lasts to the end."""
    kill = Rule(robot=1, kill="agent", at=20.0)
    reasons, _ = verdict(run(pair((0.0, 0.0), 60.0, kill), lambda t: 0.6 if t > 21.0 else 0.0))
    assert [each for each in reasons if "from their places" in each]


def test_a_fault_excuses_nobody_from_a_course_that_is_too_fast() -> None:
    fleet = pair((0.0, 3.0), 60.0, noisy(0.0, 60.0), noisy(45.0, 10.0))
    reasons, _ = verdict(run(fleet, lambda t: 1.5 * max(t - 46.0, 0.0)))
    assert [each for each in reasons if "places move at 3.00 m/s" in each]


@pytest.mark.parametrize("state", ["released", "fault", "holding", "stopped"])
def test_who_did_not_drive_at_the_end_is_not_judged(state: str) -> None:
    reasons, warnings = verdict(run(pair(), lambda t: 5.0, state))
    assert not [each for each in [*reasons, *warnings] if "from their places" in each]


def test_a_robot_that_is_killed_for_good_is_not_judged() -> None:
    recording = run(pair(), lambda t: 0.0 if t < 10.0 else 5.0)
    events = [Event(robot, 0, EPOCH_NS + 10**10, "agent", "kill", "crash") for robot in (1, 2)]
    reasons, warnings = verdict(replace(recording, events=tuple(events)))
    assert not [each for each in [*reasons, *warnings] if "from their places" in each]


def test_who_fell_behind_in_mid_drive_is_a_warning() -> None:
    def lag(t: float) -> float:
        return 3.0 if 20.0 < t < 35.0 else 0.0

    assert verdict(run(pair(), lag)) == (
        [],
        ["Robot 2 was off its place from 20.1 s to 34.9 s, by up to 3.00 m (so did robot 1)."],
    )
    assert verdict(run(pair((0.0, 0.0), 60.0, noisy(15.0, 1.0)), lag)) == ([], [])
    assert verdict(run(pair(), lambda t: 3.0 if 20.0 < t < 29.0 else 0.0)) == ([], [])
