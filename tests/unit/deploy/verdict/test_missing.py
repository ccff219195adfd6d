"""What the data of a run lack: poses, statuses, an end; and what of it fails the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import GeofenceSection, ObstacleSection
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Event, PlantState, Status, Stop
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.missing import SHARE_MAX, Missing
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, Path, in_formation, make_fleet, messages, standing

WIDE = make_fleet([(0.0, 0.0), (2.003, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=10.0)
NEAR = make_fleet([(0.0, 0.0), (0.903, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=10.0)
FAR = make_fleet([(0.0, 0.0), (90.0, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=10.0)


def lacking(
    *spans: tuple[float, float],
    ids: Sequence[int] = (2,),
    fleet: Fleet = WIDE,
    ways: list[Path] | None = None,
    kinds: tuple[type, ...] = (PlantState,),
    mode: str = "run",
    **status: Any,
) -> Recording:
    """A run without these messages of some robots in these times; `status` is what all statuses say."""
    sent = []
    for received_ns, key, message in messages(fleet, ways or in_formation(fleet)):
        t = (message.time_ns - EPOCH_NS) / 1e9
        if (
            type(message) in kinds
            and getattr(message, "robot", 0) in ids
            and any(a < t < b for a, b in spans)
        ):
            continue
        if type(message) is Status and status:
            message = message._replace(**status)
        sent.append((received_ns, key, message))
    return recorded(fleet, sent, mode)


def missing(recording: Recording, a: Analysis | None = None) -> Missing:
    return Missing(recording, a or analyse(recording, resolve(recording.fleet)))


def event(t: float, what: str, role: str = "agent") -> Event:
    return Event(2, 0, EPOCH_NS + round(t * 1e9), role, what, "crash")


# --- gaps of poses ------------------------------------------------------------------------------------


def test_a_gap_in_which_nothing_can_have_happened_is_said_and_fails_nothing() -> None:
    result = RunResult(lacking((3.05, 3.85)))
    assert result.passed
    assert result.warnings == [
        "Robot 2 sent no pose from 3.00 s to 3.90 s, in which nothing can have happened."
    ]


def test_a_gap_in_which_it_may_have_come_too_near_fails() -> None:
    result = RunResult(lacking((3.05, 3.85), fleet=NEAR))
    # 0.903 m, less 0.45 s out and back at 1.75 m/s, and the 20 ms between two looks.
    assert result.reasons == [
        "Robot 2 sent no pose from 3.00 s to 3.90 s; it may have come within 0.10 m of robot 1 (0.22 m is "
        "safe)."
    ]
    assert result.warnings == []


def test_a_robot_that_moved_further_than_it_can_fails_and_its_distances_are_no_violation() -> None:
    """Half way between the poses before and after it, robot 2 would have been where robot 1 stands."""

    def across(t: float) -> tuple[float, float, float]:
        return min(max(-2.0 + 4.0 * (t - 3.0), -2.0), 2.0), 0.0, 0.0

    result = RunResult(lacking((2.95, 4.05), ways=[body(standing(0.0, 0.0), 0.1), body(across, 0.1)]))
    assert result.metrics["oracles"]["separation"]["violations"] == 0
    assert result.metrics["min_distance_m"]["any"] > 1.9
    (said,) = [each for each in result.reasons if "sent no pose" in each]
    assert said == "Robot 2 sent no pose from 2.90 s to 4.10 s; it moved 4.00 m, further than it can."


def test_the_other_may_be_in_a_gap_too() -> None:
    """1.603 m, less 0.35 s at 1.75 m/s for each of them: alone nothing can have happened."""
    fleet = make_fleet([(0.0, 0.0), (1.203, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=10.0)
    assert missing(lacking((3.05, 3.65), fleet=fleet, mode="simulate")).reasons == []
    both = missing(lacking((3.05, 3.65), fleet=fleet, ids=(1, 2), mode="simulate"))
    assert len(both.reasons) == 2


def around(fleet: Fleet, *, released: bool = False) -> list[str]:
    """Reasons where robot 2 of a fleet, which stands at (9, 0), sends no pose for a second."""
    state = "released" if released else "running"
    ways = [body(standing(x, 0.0), 0.1) for x in (0.0, 9.0)]
    return missing(lacking((3.05, 3.95), fleet=fleet, ways=ways, state=state)).reasons


def test_obstacles_and_the_geofence_are_kept_from_too() -> None:
    pair = make_fleet([(0.0, 0.0), (9.0, 0.0)], [(1, 2)], duration_s=8.0, rate_hz=10.0)

    def rock(x: float) -> Fleet:
        return replace(pair, obstacles=(ObstacleSection("rock", (x, 0.0), 0.5),))

    def fence(x: float) -> Fleet:
        corners = ((-5.0, -5.0), (x, -5.0), (x, 5.0), (-5.0, 5.0))
        return replace(pair, geofence=GeofenceSection(points_m=corners))

    assert around(rock(11.0)) == []
    assert around(rock(10.2)) == [
        "Robot 2 sent no pose from 3.00 s to 4.00 s; it may have been 0.18 m inside rock."
    ]
    assert around(rock(9.58)) == [], "the oracle judges what is measured nearer than that"
    assert around(rock(10.2), released=True) == [], "its operator drives it"
    assert around(fence(9.6)) == [], "it may be outside as long as it brakes"


def test_a_gap_to_the_end_fails_however_far_away_it_is() -> None:
    assert missing(lacking((18.05, 99.0), fleet=FAR)).reasons[0] == (
        "Robot 2 sent no pose from 18.00 s to the end."
    )


@pytest.mark.parametrize(("count", "passed"), [(5, True), (6, False)])
def test_gaps_may_be_a_fifth_of_the_drive(count: int, passed: bool) -> None:
    """0.75 s at a time: 3.75 s of 20 s are, 4.5 s are not."""
    fleet = make_fleet([(0.0, 0.0), (5.0, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=20.0)
    found = missing(lacking(*((2.0 * k + 1.01, 2.0 * k + 1.74) for k in range(count)), fleet=fleet))
    assert SHARE_MAX == 0.2
    assert found.reasons == (
        []
        if passed
        else ["The data are incomplete: robot 2 sent no pose in 22 % of the drive, where 20 % is allowed."]
    )
    assert found.warnings[0].startswith("Robot 2 sent no pose from 1.00 s to ")
    assert ", for up to 0.8 s at a time, in which nothing can have happened." in found.warnings[0]


def test_what_a_rule_did_fails_nothing() -> None:
    events = event(3.1, "stop", "plant"), event(13.0, "continue", "plant")
    found = missing(replace(lacking((3.05, 12.95)), events=events))
    assert found.reasons == []
    assert found.warnings == ["Robot 2 sent no pose from 3.00 s to 13.00 s (rule 'crash' stopped its plant)."]


@pytest.mark.parametrize(("speed_mps", "passed"), [(0.1, True), (1.0, False)])
@pytest.mark.parametrize("cause", ["slow", "nothing"])
def test_what_a_machine_hides_is_a_warning_where_robots_hardly_moved(
    speed_mps: float, passed: bool, cause: str
) -> None:
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=20.0, velocity=(speed_mps, 0.0))
    slow = cause == "slow"
    counters = (("overruns", 900),) if slow else ()
    ids = (2,) if slow else (1, 2)
    found = missing(lacking((3.01, 4.49), fleet=fleet, ids=ids, counters=counters))
    assert (found.reasons == []) == passed
    (said,) = found.warnings if passed else found.reasons
    assert ("(the machine was too slow)" if slow else "(nothing came from the machine)") in said


def test_plants_that_hang_fail_as_one_does() -> None:
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=20.0)
    assert missing(lacking((3.01, 3.99), fleet=fleet, ids=(1, 2), state="fault")).reasons


def test_gaps_of_many_robots_are_one_sentence() -> None:
    fleet = make_fleet([(3.0 * k, 0.0) for k in range(12)], [(1, 2)], duration_s=20.0, rate_hz=10.0)
    (said,) = missing(lacking((3.05, 3.85), fleet=fleet, ids=range(1, 12), mode="simulate")).warnings
    assert said == (
        "11 robots (1-11) sent no pose from 3.00 s to 3.90 s, for up to 0.9 s at a time, in which nothing "
        "can have happened."
    )


@pytest.mark.parametrize("rate_hz", [2.0, 3.0, 10.0])
def test_a_late_tick_of_a_slow_body_is_no_missing_pose(rate_hz: float) -> None:
    """One round and most of another one are silent at 2 and 3 Hz; 0.8 s are eight at 10 Hz."""
    fleet = make_fleet([(0.0, 0.0), (9.0, 0.0)], [(1, 2)], duration_s=8.0, rate_hz=rate_hz)
    lost_s = 0.8 if rate_hz > 3 else 1.1 / rate_hz
    assert bool(missing(lacking((3.0, 3.0 + lost_s), fleet=fleet)).warnings) == (rate_hz > 3)


# --- robots that are gone ---------------------------------------------------------------------------


def without_place(recording: Recording, from_s: float) -> Analysis:
    """Robot 2 has no place from a time on."""
    a = analyse(recording, resolve(recording.fleet))
    desired = a.desired.copy()
    desired[a.grid >= from_s, 1] = np.nan
    return replace(a, desired=desired)


def test_a_member_that_is_gone_is_missed_and_one_that_left_is_not() -> None:
    recording = lacking((3.05, 99.0), kinds=(PlantState, Status))
    said = [
        "Robot 2 sent no pose from 3.00 s to the end.",
        "The agent of robot 2 sent no status after 3.0 s.",
    ]
    assert missing(recording).reasons == said
    found = missing(recording, without_place(recording, 5.0))
    assert found.reasons == []
    assert found.members == {1}
    assert found.warnings == [said[0].replace("end.", "end (it had no place in the formation)."), said[1]]


def test_what_was_missed_while_it_had_a_place_is() -> None:
    recording = lacking((3.05, 4.45), fleet=NEAR)
    (reason,) = missing(recording, without_place(recording, 6.0)).reasons
    assert "within 0.00 m of robot 1" in reason


def test_one_that_was_killed_for_good_sends_no_pose() -> None:
    """Its plant alone is another matter: an agent that has lost its body is in fault."""
    both = event(3.0, "kill"), event(3.0, "kill", "plant")
    base = lacking((3.05, 99.0), kinds=(PlantState, Status))
    found = missing(replace(base, events=both))
    assert found.reasons == []
    assert found.warnings == [
        "Robot 2 sent no pose from 3.00 s to the end (rule 'crash' stopped its plant).",
        "The agent of robot 2 was killed at 3.0 s for good.",
    ]
    for less in (
        (both[1],),
        (event(3.0, "kill"), event(3.0, "stop", "plant")),
        (*both, event(5.0, "start")),
    ):
        reasons = missing(replace(base, events=less)).reasons
        assert any("Robot 2 sent no pose from 3.00 s to the end" in each for each in reasons)


def test_where_one_that_was_killed_for_good_stands_nobody_else_may_be() -> None:
    first, second = in_formation(WIDE)
    sent = messages(WIDE, [lambda t: second(t) if t > 5.0 else first(t), second])
    kept = [each for each in sent if getattr(each[2], "robot", 0) != 2 or each[0] < EPOCH_NS + 3_050_000_000]
    events = event(3.0, "kill"), event(3.0, "kill", "plant")
    a = analyse(replace(recorded(WIDE, kept), events=events), resolve(WIDE))
    assert a.closest is not None
    assert a.closest.distance_m < 0.05


def test_many_agents_that_fall_silent_are_one_sentence() -> None:
    recording = lacking((3.05, 99.0), ids=(1, 2), kinds=(Status,), counters=(("overruns", 30),))
    assert missing(recording).reasons == [
        "The agents of robots 1 and 2 sent no status after 3.0 s (the machine was too slow)."
    ]


def test_what_was_not_said_before_the_drive_is_not_missed() -> None:
    """A Ctrl-C as it begins: agents of a large fleet had said little for seconds, as they only waited."""
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=0.1, rate_hz=10.0)
    recording = recorded(fleet, messages(fleet, in_formation(fleet)))
    recording.robots[2].status.t[:] = -2.5
    assert missing(recording).reasons == []


# --- the end --------------------------------------------------------------------------------------------


def test_a_run_ends_when_it_is_interrupted_whenever_robots_were_heard_last() -> None:
    sent = [each for each in messages(WIDE, in_formation(WIDE)) if each[0] - EPOCH_NS < 3.05 * NS_PER_S]
    stop = Stop(9, EPOCH_NS + 5 * NS_PER_S, "interrupted")
    sent.append((stop.time_ns, key_expressions.stop(WIDE.fleet.name), stop))
    recording = replace(recorded(WIDE, sent), interrupted=True)
    assert recording.end_s == pytest.approx(3.0)
    assert missing(recording).reasons == [
        "The data are incomplete: nothing came of any robot after 3.0 s.",
        "The run ended after 5.0 s of the 20.0 s that were planned: it was interrupted.",
    ]
