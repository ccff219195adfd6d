"""What the data of a run lack, of robots that have a place in the formation and of others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Event, PlantState, Status, Stop
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.completeness import Completeness
from tests.unit.deploy.judged_run import recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, make_fleet, messages

FLEET = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=8.0, rate_hz=10.0)


def dead(at_s: float, kinds: tuple[type, ...] = (PlantState, Status), until_s: float = 99.0) -> Recording:
    """Robot 2 sends none of these in a time."""
    sent = messages(FLEET, in_formation(FLEET))
    return recorded(
        FLEET,
        [
            each
            for each in sent
            if not (
                type(each[2]) in kinds
                and each[2].robot == 2  # type: ignore[union-attr]
                and at_s < (each[2].time_ns - EPOCH_NS) / 1e9 < until_s
            )
        ],
    )


def without_place(recording: Recording, from_s: float) -> Analysis:
    """Robot 2 has no place from a time on."""
    a = analyse(recording, resolve(recording.fleet))
    desired = a.desired.copy()
    desired[a.grid >= from_s, 1] = np.nan
    return replace(a, desired=desired)


def test_a_member_that_is_gone_is_missed() -> None:
    recording = dead(3.05)
    assert Completeness(recording, analyse(recording, resolve(FLEET))).reasons == [
        "The data are incomplete: robot 2 sent no pose from 3.00 s to 8.00 s.",
        "The agent of robot 2 said nothing more from 3.0 s on, in the last 5.0 s of the drive.",
    ]


@pytest.mark.parametrize(("end_s", "lost"), [(0.1, False), (3.0, True)])
def test_what_was_not_said_before_the_drive_is_not_missed(end_s: float, lost: bool) -> None:
    """A Ctrl-C as it begins: agents of a large fleet had said little for seconds, as they only waited."""
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=end_s, rate_hz=10.0)
    sent = messages(fleet, in_formation(fleet))
    late_ns = EPOCH_NS + 100_000_000
    recording = recorded(
        fleet, [each for each in sent if not (type(each[2]) is Status and each[2].time_ns > late_ns)]
    )
    for robot in recording.robots.values():
        assert list(robot.status.t) == [0.0]
    recording.robots[2].status.t[:] = -2.5
    recording.robots[1].status.t[:] = end_s
    reasons = Completeness(recording, analyse(recording, resolve(fleet))).reasons
    said = "The agent of robot 2 said nothing more from -2.5 s on, in the last 3.0 s of the drive."
    assert [each for each in reasons if "said nothing more" in each] == [said] * lost


def test_one_that_was_replaced_or_left_is_not() -> None:
    recording = dead(3.05)
    data = Completeness(recording, without_place(recording, 5.0))
    assert data.reasons == []
    assert data.members == {1}
    assert data.warnings == [
        "Robot 2 had no place in the formation any more: from 3.00 s to the end its place is not known.",
        "The agent of robot 2 said nothing more from 3.0 s on, in the last 5.0 s of the drive.",
    ]


def test_what_was_missed_while_it_had_a_place_is() -> None:
    recording = dead(3.05, (PlantState,), 4.45)
    (reason,) = Completeness(recording, without_place(recording, 6.0)).reasons
    assert reason == (
        "Robot 2 sent no pose from 3.00 s to 4.50 s: it may have come within 0.00 m of robot 1 (safe "
        "distance 0.22 m)."
    )


def test_many_that_fall_silent_on_a_machine_that_is_too_slow_are_one_matter() -> None:
    """Of 4 robots some are heard no more; the fourth skipped every second tick."""
    fleet = make_fleet([(float(k), 0.0) for k in range(4)], [(1, 2)], duration_s=8.0, rate_hz=10.0)
    skips = (("overruns", 40),)

    def reasons(kind: type, silent: tuple[int, ...], *, late: bool = True) -> list[str]:
        until_ns = EPOCH_NS + 3_050_000_000
        sent = [
            (at, key, each._replace(counters=skips) if late and type(each) is Status else each)
            for at, key, each in messages(fleet, in_formation(fleet))
            if type(each) is not kind or each.robot not in silent or each.time_ns < until_ns
        ]
        recording = recorded(fleet, sent)
        return Completeness(recording, analyse(recording, resolve(fleet))).reasons

    assert reasons(Status, (1, 2, 3)) == [
        "Nothing more came of the agents of robots 1, 2 and 3, of the first from 3.0 s on: their machine was "
        "too slow, for them, their router or the program that records."
    ]
    assert reasons(PlantState, (1, 3)) == [
        "The data are incomplete: no pose came of robots 1 and 3 for up to 5.0 s: their machine was too slow."
    ]
    for kind, words in ((Status, "The agent of robot 1 said nothing"), (PlantState, "robot 1 sent no pose")):
        assert len(reasons(kind, (1, 2, 3), late=False)) == 3
        (alone,) = reasons(kind, (1,))
        assert words in alone


def event(t: float, what: str, role: str = "agent") -> Any:
    return Event(2, 0, EPOCH_NS + round(t * 1e9), role, what, "crash")


def test_one_that_was_killed_for_good_sends_no_pose() -> None:
    """Its plant alone is another matter: an agent that has lost its body is in fault."""
    both = event(3.0, "kill"), event(3.0, "kill", "plant")
    recording = replace(dead(3.05), events=both)
    data = Completeness(recording, analyse(recording, resolve(FLEET)))
    assert data.reasons == []
    assert data.warnings == [
        "Rule 'crash' stopped robot 2's plant: from 3.00 s to the end it sent no pose.",
        "The agent of robot 2 was killed at 3.0 s for good, and nobody took its place.",
    ]
    missed = "The data are incomplete: robot 2 sent no pose from 3.00 s to 8.00 s."
    for less in (
        (both[1],),
        (event(3.0, "kill"), event(3.0, "stop", "plant")),
        (*both, event(5.0, "start")),
    ):
        recording = replace(dead(3.05), events=less)
        assert missed in Completeness(recording, analyse(recording, resolve(FLEET))).reasons


def test_where_one_that_was_killed_for_good_stands_nobody_else_may_be() -> None:
    """Its data are not missed, its body is there to the end: who drives into it fails the drive."""
    first, second = in_formation(FLEET)
    sent = messages(FLEET, [lambda t: second(t) if t > 5.0 else first(t), second])
    died_ns = EPOCH_NS + 3_050_000_000
    kept = [each for each in sent if getattr(each[2], "robot", 0) != 2 or each[0] < died_ns]
    events = event(3.0, "kill"), event(3.0, "kill", "plant")
    a = analyse(replace(recorded(FLEET, kept), events=events), resolve(FLEET))
    assert a.closest is not None
    assert a.closest.distance_m < 0.05
    assert a.closest.t_s > 5.0


@pytest.mark.parametrize("rate_hz", [2.0, 3.0, 10.0])
def test_a_late_tick_of_a_slow_body_is_no_missing_pose(rate_hz: float) -> None:
    """One round and most of another one are silent at 2 and 3 Hz; 0.8 s are eight at 10 Hz."""
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=8.0, rate_hz=rate_hz)
    sent = messages(fleet, in_formation(fleet))
    lost_s = 0.8 if rate_hz > 3 else 1.1 / rate_hz
    lost = range(EPOCH_NS + 3_000_000_001, EPOCH_NS + round((3.0 + lost_s) * 1e9))
    kept = [
        each
        for each in sent
        if not isinstance(each[2], PlantState) or each[2].robot == 2 or each[2].time_ns not in lost
    ]
    recording = recorded(fleet, kept)
    data = Completeness(recording, analyse(recording, resolve(fleet)))
    assert data.reasons == []
    assert bool(data.warnings) == (rate_hz > 3)


@pytest.mark.parametrize("back", [False, True])
def test_an_agent_that_is_killed_for_good_is_said(back: bool) -> None:
    events = (event(3.0, "kill"), *([event(5.0, "start")] if back else []))
    recording = replace(dead(3.05, (Status,), 5.0 if back else 99.0), events=events)
    data = Completeness(recording, analyse(recording, resolve(FLEET)))
    said = "The agent of robot 2 was killed at 3.0 s for good, and nobody took its place."
    assert data.reasons == []
    assert data.warnings == ([] if back else [said])


@pytest.mark.parametrize("topology", ["mesh", "routed"])
def test_a_run_ends_when_it_is_interrupted_whenever_robots_were_heard_last(topology: str) -> None:
    fleet = replace(FLEET, network=replace(FLEET.network, topology=topology))
    sent = [each for each in messages(fleet, in_formation(fleet)) if each[0] - EPOCH_NS < 3.05 * NS_PER_S]
    stop = Stop(9, EPOCH_NS + 5 * NS_PER_S, "interrupted")
    sent.append((stop.time_ns, key_expressions.stop(fleet.fleet.name), stop))
    recording = replace(recorded(fleet, sent), interrupted=True)
    assert recording.end_s == pytest.approx(3.0)
    why = ": its router may have stood" if topology == "routed" else ""
    assert Completeness(recording, analyse(recording, resolve(fleet))).reasons == [
        f"The data are incomplete: nothing came of any robot after 3.0 s{why}.",
        "The run ended after 5.0 s of the 8.0 s that were planned: it was interrupted.",
    ]
