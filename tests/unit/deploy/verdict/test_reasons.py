"""What verdicts say, against runs of which it is known by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.fault_rules import FaultsSection, Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.fleet.safety import AvoidanceSection
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Message, Mission, PlantState, Status, Stop
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import NAME, PAIR, body, driven, judged, recorded, status, with_statuses
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    Sent,
    in_formation,
    make_fleet,
    messages,
    standing,
    triangle,
)


def test_a_run_that_does_not_settle_says_how_far_off_it_is() -> None:
    found = driven(PAIR, standing(0, 0), lambda t: (1.0 if t < 1 else 1.25, 0.0, 0.0))
    assert found["settling_time_s"] is None
    assert found["verdict"]["reasons"] == [
        "The formation had not settled at the end (2.0 s): robots 1 and 2 were 1.250 m apart instead of "
        "1.000 m, 25 % off where 5 % is allowed."
    ]


def test_an_edge_below_the_safe_distance() -> None:
    found = driven(PAIR, standing(0, 0), lambda t: (0.2 if abs(t - 0.5) < 0.001 else 1.0, 0.0, 0.0))
    assert found["min_distance_m"] == {"edge": 0.2, "any": 0.2}
    assert found["verdict"]["reasons"] == [
        "Robots 1 and 2, which share an edge, came within 0.200 m of each other at 0.50 s; "
        "the safe distance is 0.220 m."
    ]


def test_a_pair_without_an_edge_below_the_safe_distance() -> None:
    """Robot 3 passes robot 1; only 1-2 and 2-3 are edges."""
    line = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)])
    found = driven(line, standing(0, 0), standing(1, 0), lambda t: (0 if abs(t - 1) < 0.001 else 2, 0.1, 0.0))
    assert found["min_distance_m"] == {"edge": pytest.approx(1.0), "any": 0.1}
    sentence = (
        "Robots 1 and 3, which share no edge, came within 0.100 m of each other at 1.00 s; "
        "the safe distance is 0.220 m."
    )
    assert found["verdict"] == {"passed": False, "reasons": [sentence], "warnings": []}
    bare = replace(line, avoidance=AvoidanceSection(enabled=False))
    paths = standing(0, 0), standing(1, 0), lambda t: (0 if abs(t - 1) < 0.001 else 2, 0.1, 0.0)
    found = driven(bare, *paths)
    said = f"{sentence} With avoidance.enabled = false nothing keeps such pairs apart."
    assert found["verdict"] == {"passed": False, "reasons": [said], "warnings": []}


def test_every_unsafe_pair_is_counted() -> None:
    three = make_fleet(*triangle(2))
    found = driven(three, *(standing(x, 0) for x in (0.0, 0.1, 0.3)))
    (first, second) = found["verdict"]["reasons"]
    assert first.startswith(
        "Robots 1 and 2, which share an edge, came within 0.100 m of each other at 0.00 s;"
    )
    assert first.endswith(" One other such pair came too close as well.")
    assert second.endswith(
        "were 0.100 m apart instead of 1.000 m, 90 % off where 5 % is allowed. "
        "2 other edges were off as well."
    )


def test_what_oracles_say_of_the_end_is_said_once() -> None:
    """Robot 2 is off its distance from the fault on: not recovered, and not settled at the end."""
    base = make_fleet([(0, 0), (1, 0)], [(1, 2)], duration_s=30.0, rate_hz=10.0)
    rule = Rule(robot=1, jump_m=0.1, at=2.0, duration=1.0)
    fleet = replace(base, faults=FaultsSection(rules=(rule,)))
    found = driven(fleet, standing(0, 0), lambda t: (1.2 if t > 2 else 1.0, 0.0, 0.0))
    assert found["oracles"]["recovery"]["violations"] == 1
    (reason,) = found["verdict"]["reasons"]
    assert reason.startswith("The formation had not settled at the end")
    found = driven(fleet, standing(0, 0), lambda t: (1.2 if 2 < t < 25 else 1.0, 0.0, 0.0))
    assert found["verdict"]["reasons"] == [found["oracles"]["recovery"]["first"]]


@pytest.mark.parametrize(
    ("state", "reason", "sentence"),
    [
        ("fault", "why", "in state fault: it did not drive on, as something of its own was wrong (why)."),
        ("holding", "", "in state holding: it braked, and waited until it might drive again."),
        ("waiting", "no mission", "in state waiting: it did not drive (no mission)."),
        ("running", "", None),
        ("stopping", "", None),
    ],
)  # fmt: skip
def test_the_state_at_the_end_of_the_drive_counts(state: str, reason: str, sentence: str | None) -> None:
    sent = with_statuses(
        status(1, 1.9), status(2, 1.9, state=state, reason=reason), status(2, 2.5, state="stopped")
    )
    assert judged(PAIR, sent)["verdict"]["reasons"] == (
        [f"Robot 2 ended the drive {sentence}"] if sentence else []
    )


def test_what_the_operator_knows_comes_first() -> None:
    found = judged(PAIR, with_statuses(status(1, 1.9)), reasons=["Robot 2's agent died."])
    assert found["verdict"] == {
        "passed": False,
        "reasons": [
            "Robot 2's agent died.",
            "The data are incomplete: no status of robot 2 was recorded.",
        ],
        "warnings": [],
    }


def test_a_silent_robot_makes_the_data_incomplete() -> None:
    three = make_fleet(*triangle(2))
    sent = [each for each in messages(three, in_formation(three)) if "robot/2/" not in each[1]]
    found = judged(three, sent)
    assert found["verdict"]["reasons"] == [
        "The data are incomplete: no pose of robot 2 was recorded.",
        "The data are incomplete: no status of robot 2 was recorded.",
    ]
    assert found["min_distance_m"]["edge"] == pytest.approx(1.0)  # that of robots 1 and 3


def test_a_gap_in_the_poses_is_named() -> None:
    def within(each: Sent) -> bool:
        return (
            each[1] == key_expressions.plant_state(NAME, 1)
            and 0.4 < (each[2].time_ns - EPOCH_NS) / 1e9 < 1.19
        )

    found = judged(PAIR, (each for each in messages(PAIR, in_formation(PAIR)) if not within(each)))
    assert found["verdict"]["reasons"] == [
        "The data are incomplete: robot 1 sent no pose in 40 % of the drive, where 20 % is allowed."
    ]


def test_poses_that_begin_late_or_end_early_are_named() -> None:
    def kept(each: Sent) -> bool:
        t = (each[2].time_ns - EPOCH_NS) / 1e9
        return not (each[1] == key_expressions.plant_state(NAME, 1) and t < 0.99) and not (
            each[1] == key_expressions.plant_state(NAME, 2) and t > 1.01
        )

    found = judged(PAIR, (each for each in messages(PAIR, in_formation(PAIR)) if kept(each)))
    assert found["verdict"]["reasons"] == [
        "Robot 1 sent no pose from 0.00 s to 1.00 s; it may have come within 0.00 m of robot 2 (0.22 m is "
        "safe).",
        "Robot 2 sent no pose from 1.00 s to the end.",
    ]


def test_a_run_that_was_cut_short_says_so() -> None:
    sent = list(messages(PAIR, in_formation(PAIR)))
    at_ns = EPOCH_NS + 1_200_000_000
    stop: Sent = (at_ns, key_expressions.stop(NAME), Stop(1, at_ns, "enough"))
    braked = [
        (t, key, m._replace(driving=False, speed=0.0) if type(m) is PlantState and t > at_ns else m)
        for t, key, m in sent
    ]
    assert judged(PAIR, [*braked, stop])["verdict"]["reasons"] == [
        "The run ended after 1.2 s of the 2.0 s that were planned: it was stopped."
    ]
    ordered = replace(PAIR, orders=(OrderSection(at=1.2, kind="stop"),))
    assert judged(ordered, [*braked, stop])["verdict"]["reasons"] == []  # as its file says
    early = recorded(PAIR, (each for each in sent if each[0] < at_ns), interrupted=True)
    found = RunResult(early).metrics
    assert found["duration_s"] == 1.18
    assert found["verdict"]["reasons"] == [
        "The run ended after 1.2 s of the 2.0 s that were planned: it was interrupted."
    ]


def test_a_fleet_that_never_started() -> None:
    sent = [
        each for each in messages(PAIR, in_formation(PAIR), state="waiting") if type(each[2]) is not Mission
    ]
    reasons = judged(PAIR, sent)["verdict"]["reasons"]
    assert reasons[0] == "No mission was recorded: the fleet was never told to start, so it did not drive."


def taken(*periods: tuple[float, float]) -> dict[str, Any]:
    """A perfect run in which the statuses of robot 2 say `released` in these periods, s."""

    def told(message: Message) -> Message:
        if type(message) is Status and message.robot == 2:
            t = (message.time_ns - EPOCH_NS) / 1e9
            if any(begin <= t < end for begin, end in periods):
                return message._replace(state="released", reason="mode MANUAL")
        return message

    ways = [body(standing(x, 0), 0.1) for x in (0, 1)]
    return judged(PAIR, [(received, key, told(each)) for received, key, each in messages(PAIR, ways)])


def test_a_release_is_a_warning_with_its_time() -> None:
    verdict = taken((0.5, 1.1), (1.5, 1.7))["verdict"]
    assert verdict["passed"]
    assert verdict["warnings"] == [
        "Robot 2 was released to its operator from 0.6 s to 1.2 s (mode MANUAL).",
        "Robot 2 was released to its operator from 1.6 s to 1.8 s (mode MANUAL).",
    ]


def test_a_robot_that_is_still_its_operators_at_the_end_is_a_warning_too() -> None:
    verdict = taken((1.0, 99.0))["verdict"]
    assert (verdict["passed"], verdict["reasons"]) == (True, [])
    assert "from 1.0 s to the end" in verdict["warnings"][0]


def test_a_release_after_the_drive_is_none_of_it() -> None:
    assert taken((2.0, 99.0))["verdict"]["warnings"] == []


def test_a_plant_of_others_is_named_whose_body_says_nothing() -> None:
    silent = with_statuses(status(1, 1.0), status(2, 1.0, state="fault", reason="plant silent for 1.50 s"))
    own = replace(PAIR, robots=tuple(replace(each, plant="my:Plant") for each in PAIR.robots))
    hint = " Its plant, my:Plant, may hang."

    def told(fleet: Fleet) -> list[str]:
        return [each for each in judged(fleet, silent)["verdict"]["reasons"] if "in state fault" in each]

    assert told(own) == [f"{sentence}{hint}" for sentence in told(PAIR)]
    assert len(told(own)) == 1


@pytest.mark.parametrize(
    ("tick_us", "skipped", "named"), [(19_000, 9, True), (300, 9, False), (19_000, 0, False)]
)
def test_a_law_of_others_is_named_where_ticks_are_skipped(tick_us: int, skipped: int, named: bool) -> None:
    counters = (("overruns", skipped),)
    slow = with_statuses(status(1, 1.0, tick_us=(tick_us,) * 20, counters=counters), status(2, 1.0))
    own = replace(PAIR, control=replace(PAIR.control, law="my:Law"))
    expected = "Robot 1 skipped 9 ticks: there one takes 19 ms, of 20 ms; the law my:Law may be too slow."
    assert (expected in judged(own, slow)["verdict"]["warnings"]) == named
    assert expected not in judged(PAIR, slow)["verdict"]["warnings"]
    assert (
        expected not in judged(own, with_statuses(status(1, 1.0, counters=counters)))["verdict"]["warnings"]
    )


def test_a_law_that_becomes_slow_is_named_though_most_ticks_were_quick() -> None:
    """Each slow one skips many: they are few."""
    counters = (("overruns", 20),)
    slow = with_statuses(status(1, 1.0, tick_us=(*[300] * 60, *[100_000] * 5), counters=counters))
    own = replace(PAIR, control=replace(PAIR.control, law="my:Law"))
    expected = "Robot 1 skipped 20 ticks: there one takes 100 ms, of 20 ms; the law my:Law may be too slow."
    assert expected in judged(own, slow)["verdict"]["warnings"]
    others = with_statuses(status(1, 1.0, tick_us=(*[300] * 60, 100_000), counters=counters))
    assert expected not in judged(own, others)["verdict"]["warnings"], "most of the time something else ran"


def test_an_agent_that_falls_silent_for_good_is_named() -> None:
    """It may hang: the neighbours brake, and nothing else says so."""
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=6.0)
    sent = list(messages(fleet, in_formation(fleet)))

    def reasons(last_s: float) -> list[str]:
        heard = [
            each
            for each in sent
            if type(each[2]) is not Status or each[2].robot == 1 or each[0] <= EPOCH_NS + round(last_s * 1e9)
        ]
        found: list[str] = judged(fleet, heard)["verdict"]["reasons"]
        return found

    assert reasons(6.0) == reasons(4.5) == []
    (silent,) = reasons(3.0)
    assert silent == "The agent of robot 2 sent no status after 2.8 s."


def faulted(at_s: float, *ids: int) -> list[Sent]:
    """A run of PAIR of which these robots' plants say nothing more from a time on, and their agents why."""

    def said(message: Message) -> Message:
        late = (message.time_ns - EPOCH_NS) / 1e9 >= at_s  # type: ignore[union-attr]
        if late and type(message) is Status and message.robot in ids:
            return message._replace(state="fault", reason="plant unhealthy: plant my:Plant: late")
        return message

    return [
        (received, key, said(each))
        for received, key, each in messages(PAIR, in_formation(PAIR))
        if not (type(each) is PlantState and each.robot in ids and received > EPOCH_NS + at_s * 1e9)
    ]


def test_a_drive_that_ends_because_every_plant_fails_says_why() -> None:
    """The poses end before the agents say what is wrong."""
    why = "(plant unhealthy: plant my:Plant: late)."
    assert judged(PAIR, faulted(1.0, 1, 2))["verdict"]["reasons"] == [
        f"Robots 1 and 2 ended the drive in state fault: they did not drive on, as something of their own "
        f"was wrong {why}",
        "The run ended after 1.0 s of the 2.0 s that were planned: no robot could drive any more.",
    ]
    stop: Sent = (at_ns := EPOCH_NS + 1_800_000_000, key_expressions.stop(NAME), Stop(1, at_ns, "enough"))
    late = judged(PAIR, [*faulted(1.0, 1, 2), stop])
    assert late["verdict"] == judged(PAIR, faulted(1.0, 1, 2))["verdict"]
    assert judged(PAIR, faulted(1.0, 2))["verdict"]["reasons"] == [
        f"Robot 2 ended the drive in state fault: it did not drive on, as something of its own "
        f"was wrong {why}",
        "Robot 2 sent no pose from 0.98 s to the end.",
    ]


def crowd(reasons: Sequence[str], skipped: int = 0) -> list[str]:
    """What is said of a fleet whose robots wait to the end, each for a reason of its own."""
    fleet = make_fleet([(float(k), 0.0) for k in range(len(reasons))], [(1, 2)])

    def said(message: Message) -> Message:
        if type(message) is not Status:
            return message
        why, counters = reasons[message.robot - 1], (("overruns", skipped),)
        return message._replace(state="waiting", reason=why, counters=counters)

    sent = [(received, key, said(each)) for received, key, each in messages(fleet, in_formation(fleet))]
    found: list[str] = judged(fleet, sent)["verdict"]["reasons"]
    return found


def test_of_many_that_wait_for_many_things_it_is_said_once() -> None:
    sentence = "10 robots (1-10) ended the drive in state waiting: they did not drive "
    found = crowd([f"for its {'x' * robot}" for robot in range(1, 11)])
    assert found[0] == f"{sentence}(robot 1: for its x; the others for 9 other reasons)."
    assert len(crowd([f"for its {'x' * robot}" for robot in range(1, 9)])) > len(found)
    (same,) = (each for each in crowd(["for its plant"] * 10) if "waiting" in each)
    assert same == f"{sentence}(for its plant)."


def test_reasons_that_differ_in_numbers_alone_are_one() -> None:
    found = crowd([f"this machine ran late by 0.{robot} s, as did robot {robot}" for robot in range(1, 10)])
    assert found[0] == (
        "9 robots (1-9) ended the drive in state waiting: they did not drive (this machine ran late by 0.1 "
        "to 0.9 s, as did 9 robots (1-9))."
    )


def test_a_machine_that_was_too_slow_for_most_is_named_before_the_many_things_that_failed() -> None:
    found = crowd([f"for its {'x' * robot}" for robot in range(1, 6)], skipped=50)
    assert found[0] == (
        "Robots 1, 2, 3, 4 and 5 skipped 250 of 800 ticks though a tick takes 0.1 ms of 20 ms: the machine "
        "was too slow, or the agents were frozen. What follows may come of that alone."
    )
    assert not any("too slow" in each for each in crowd([f"for its {'x' * k}" for k in range(1, 6)]))
