"""Metrics against runs whose numbers are known by hand."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import sqrt
from pathlib import Path
from typing import Any

import pytest

from agent.fleet.fault_rules import FaultsSection, Rule
from agent.fleet.model import Fleet
from agent.fleet.orders import OrderSection
from agent.fleet.safety import AvoidanceSection
from agent.formation.geometry import resolve
from agent.messages import key_expressions
from agent.messages.types import Message, Mission, PlantState, Status, Stop
from deploy.console.wording import robots
from deploy.recording.collector import RunData
from deploy.recording.recorder import RecordingError
from deploy.recording.recording import Recording
from deploy.verdict.metrics import compute, write
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    Sent,
    in_formation,
    make_fleet,
    messages,
    standing,
    triangle,
)
from tests.unit.deploy.synthetic_run import Path as Way

PAIR = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)])
NAME = PAIR.fleet.name


def recorded(fleet: Fleet, sent: Iterable[Sent], **known: Any) -> Recording:
    data = RunData(fleet)
    for each in sent:
        data.feed(*each)
    return data.recording(**known)


def judged(
    fleet: Fleet, sent: Iterable[Sent], *, mode: str = "run", reasons: Sequence[str] = ()
) -> dict[str, Any]:
    return compute(recorded(fleet, sent), fleet, resolve(fleet), mode=mode, seed=3, reasons=reasons)


def driven(fleet: Fleet, *hands: Way, **options: Any) -> dict[str, Any]:
    """Metrics of a run whose hand points are on these paths (headings are zero)."""
    bodies = [_body(hand, robot.hand_offset_m) for hand, robot in zip(hands, fleet.robots, strict=True)]
    return judged(fleet, messages(fleet, bodies), **options)


def _body(hand: Way, offset: float) -> Way:
    return lambda t: (hand(t)[0] - offset, hand(t)[1], 0.0)


def test_a_perfect_run() -> None:
    found = driven(PAIR, standing(0, 0), standing(1, 0))
    assert list(found) == [
        "fleet", "law", "seed", "mode", "robots", "edges", "rate_hz", "duration_s", "min_distance_m",
        "settling_time_s", "changes", "final_distance_error_m", "final_tracking_error_m",
        "rms_distance_error_m", "messages", "age_of_information_ms", "tick", "links", "injected",
        "links_audit", "clock_offsets",
        "oracles", "verdict", "messages_rejected_by_reason",
    ]  # fmt: skip
    assert {name: found[name] for name in ("fleet", "law", "seed", "mode", "robots", "edges")} == {
        "fleet": "made-up", "law": "joint", "seed": 3, "mode": "run", "robots": 2, "edges": 1,
    }  # fmt: skip
    assert (found["rate_hz"], found["duration_s"]) == (50.0, 2.0)
    assert found["min_distance_m"] == {"edge": 1.0, "any": 1.0}
    assert found["settling_time_s"] == 0.0
    assert found["final_distance_error_m"] == found["final_tracking_error_m"] == 0.0
    assert found["rms_distance_error_m"] == 0.0
    assert found["verdict"] == {"passed": True, "reasons": [], "warnings": []}
    assert found["links"] == []
    assert found["injected"]["decided"] == found["links_audit"]["decided"] == 0


def test_settling_time_is_the_last_time_that_an_edge_was_off() -> None:
    """Robot 2 jumps from 1.2 m to 1 m between the ticks at 0.98 s and 1 s."""
    found = driven(PAIR, standing(0, 0), lambda t: (1.2 if t < 0.99 else 1.0, 0.0, 0.0))
    assert found["settling_time_s"] == 0.98
    assert found["rms_distance_error_m"] == pytest.approx(0.2 * sqrt(50 / 101), abs=1e-6)
    assert found["verdict"]["passed"]


@pytest.mark.parametrize(
    ("distance", "settles"), [(1.0499, True), (1.0501, False), (0.9501, True), (0.9499, False)]
)
def test_five_percent_is_the_limit(distance: float, settles: bool) -> None:
    found = driven(PAIR, standing(0, 0), standing(distance, 0))
    assert found["settling_time_s"] == (0.0 if settles else None)
    assert found["verdict"]["passed"] is settles
    assert found["final_distance_error_m"] == pytest.approx(abs(distance - 1), abs=1e-6)


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
    assert found["verdict"]["passed"]  # the bare law promises nothing for them
    assert found["verdict"]["warnings"] == [f"{sentence} The law keeps apart only robots that share an edge."]


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
    rule = Rule(robot=1, speed_noise_mps=0.1, at=2.0, duration=1.0)
    fleet = replace(base, faults=FaultsSection(rules=(rule,)))
    found = driven(fleet, standing(0, 0), lambda t: (1.2 if t > 2 else 1.0, 0.0, 0.0))
    assert found["oracles"]["recovery"]["violations"] == 1
    (reason,) = found["verdict"]["reasons"]
    assert reason.startswith("The formation had not settled at the end")
    found = driven(fleet, standing(0, 0), lambda t: (1.2 if 2 < t < 25 else 1.0, 0.0, 0.0))
    assert found["verdict"]["reasons"] == [found["oracles"]["recovery"]["first"]]


def test_tracking_error_is_against_the_robots_own_place() -> None:
    fleet = make_fleet([(0, 0), (1, 0)], [(1, 2)], velocity=(0.5, 0.0))
    found = driven(fleet, lambda t: (0.5 * t, 0.03, 0.0), lambda t: (1 + 0.5 * t, 0.04, 0.0))
    assert found["final_tracking_error_m"] == pytest.approx(0.04, abs=1e-6)
    assert found["final_distance_error_m"] == pytest.approx(sqrt(1 + 0.01**2) - 1, abs=1e-6)


def test_a_robot_that_its_operator_has_is_not_off_its_place() -> None:
    paths = [_body(standing(0, 0), 0.1), _body(lambda t: (1.0, 3.0 if t > 1 else 0.0, 0.0), 0.1)]

    def told(message: Message) -> Message:
        taken = type(message) is Status and message.robot == 2 and message.time_ns > EPOCH_NS + 9 * 10**8
        return message._replace(state="released") if taken and type(message) is Status else message

    found = judged(PAIR, [(t, key, told(message)) for t, key, message in messages(PAIR, paths)])
    assert found["final_tracking_error_m"] == 0.0
    assert found["final_distance_error_m"] is None


def test_each_edge_has_its_own_distance() -> None:
    fleet = make_fleet([(0, 0), (1, 0), (1, 3)], [(1, 2), (2, 3)])
    found = driven(fleet, standing(0, 0), standing(1, 0), standing(1, 2.9))
    assert found["final_distance_error_m"] == pytest.approx(0.1)
    assert found["settling_time_s"] == 0.0  # 0.1 m is less than 5 % of 3 m


def test_counters_are_the_last_ones_of_every_robot() -> None:
    found = driven(PAIR, standing(0, 0), standing(1, 0))
    # The last status comes at 2 s, sequence 110; synthetic_run says what it holds.
    assert found["messages"] == {
        "sent": 220, "received": 440, "lost": 1 + 2, "delayed": 6, "duplicated": 2, "corrupted": 0,
        "rejected": 4,
    }  # fmt: skip
    assert found["messages_rejected_by_reason"] == {"stale": 4}
    assert found["tick"]["overruns"] == 2


def test_counters_of_an_agent_that_started_again_are_added() -> None:
    sent = with_statuses(
        status(1, 0.5, counters=(("sent", 30), ("received", 10))),
        status(1, 1.0, counters=(("sent", 50), ("received", 40))),
        status(1, 1.5, counters=(("sent", 8), ("received", 7), ("lost", 1))),
        status(1, 1.9, counters=(("sent", 9), ("received", 9), ("lost", 1))),
        status(2, 1.9, counters=(("sent", 100),)),
    )
    messages_of_all = judged(PAIR, sent)["messages"]
    assert (messages_of_all["sent"], messages_of_all["received"], messages_of_all["lost"]) == (159, 49, 1)


def with_statuses(*statuses: Status) -> list[Sent]:
    """A run of PAIR in formation, with these statuses instead of its own."""
    sent = [each for each in messages(PAIR, in_formation(PAIR)) if type(each[2]) is not Status]
    return sent + [
        (status.time_ns, key_expressions.status(NAME, status.robot), status) for status in statuses
    ]


def status(robot: int, t: float, **fields: Any) -> Status:
    base = Status(robot, 0, EPOCH_NS + round(t * 1e9), "running", "epoch", "", 1, 0, (), (), (), ())
    return base._replace(**fields)


def test_tick_times_and_ages() -> None:
    sent = with_statuses(
        status(1, 1.0, tick_us=(100, 101, 102), ages_us=(1000, 2000)),
        status(2, 1.0, tick_us=(103, 104), ages_us=(3000,)),
        status(2, 2.0, ages_us=(4000, 5000)),
        status(2, 9.0, ages_us=(9_000_000,)),  # long after the end, when others are gone
    )
    found = judged(PAIR, sent)
    assert found["tick"] == {"p50_us": 102.0, "p99_us": 103.96, "overruns": 0}
    assert found["age_of_information_ms"] == {"p50": 3.0, "p99": 4.96, "max": 5.0}
    assert "messages_rejected_by_reason" not in found
    assert judged(PAIR, sent, mode="simulate")["tick"] == {"p50_us": None, "p99_us": None, "overruns": 0}


@pytest.mark.parametrize(
    ("state", "reason", "sentence"),
    [
        ("fault", "why", "in state fault: it braked because something of its own was wrong (why)."),
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
            "The data are incomplete: the agent of robot 2 never said a word.",
        ],
        "warnings": [],
    }


def test_a_silent_robot_makes_the_data_incomplete() -> None:
    three = make_fleet(*triangle(2))
    sent = [each for each in messages(three, in_formation(three)) if "robot/2/" not in each[1]]
    found = judged(three, sent)
    assert found["verdict"]["reasons"] == [
        "The data are incomplete: no pose of robot 2 was recorded.",
        "The data are incomplete: the agent of robot 2 never said a word.",
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
        "The data are incomplete: robot 1 sent no pose from 0.40 s to 1.20 s."
    ]


def test_poses_that_begin_late_or_end_early_are_named() -> None:
    def kept(each: Sent) -> bool:
        t = (each[2].time_ns - EPOCH_NS) / 1e9
        return not (each[1] == key_expressions.plant_state(NAME, 1) and t < 0.99) and not (
            each[1] == key_expressions.plant_state(NAME, 2) and t > 1.01
        )

    found = judged(PAIR, (each for each in messages(PAIR, in_formation(PAIR)) if kept(each)))
    assert found["verdict"]["reasons"] == [
        "The data are incomplete: robot 1 sent no pose from 0.00 s to 1.00 s.",
        "The data are incomplete: robot 2 sent no pose from 1.00 s to 2.00 s.",
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
    found = compute(early, PAIR, resolve(PAIR), mode="run", seed=0)
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


def test_nothing_at_all_is_judged_without_a_number() -> None:
    found = judged(PAIR, [])
    assert not found["verdict"]["passed"]
    assert found["min_distance_m"] == {"edge": None, "any": None}
    for name in (
        "settling_time_s",
        "final_distance_error_m",
        "final_tracking_error_m",
        "rms_distance_error_m",
    ):
        assert found[name] is None
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_one_robot_alone_needs_no_distance() -> None:
    alone = make_fleet([(0.0, 0.0)], [])
    found = driven(alone, standing(0, 0))
    assert found["verdict"]["passed"]
    assert found["min_distance_m"] == {"edge": None, "any": None}


def test_noise_does_not_count_where_the_truth_is_known() -> None:
    sent = messages(PAIR, in_formation(PAIR), truth=True)
    assert judged(PAIR, sent)["final_tracking_error_m"] == pytest.approx(0.0, abs=1e-6)


def test_the_closest_pair_is_found_among_many() -> None:
    """Against every pair, one by one."""
    many = make_fleet(*triangle(5), duration_s=1.0)
    recording = recorded(many, messages(many, in_formation(many, 0.6)))
    hands = recording.hand_positions()
    pairs = [(i, j) for i in range(15) for j in range(i)]
    least = {
        pair: float(((hands[:, pair[0]] - hands[:, pair[1]]) ** 2).sum(axis=1).min() ** 0.5) for pair in pairs
    }
    edges = {frozenset((i - 1, j - 1)) for i, j in many.formation.edges}
    found = compute(recording, many, resolve(many), mode="run", seed=0)
    assert found["min_distance_m"]["any"] == pytest.approx(min(least.values()), abs=1e-6)
    with_edge = min(value for pair, value in least.items() if frozenset(pair) in edges)
    assert found["min_distance_m"]["edge"] == pytest.approx(with_edge, abs=1e-6)


def test_slots_that_are_assigned_count() -> None:
    """Robots 1 and 2 start in each other's slots: assigned, they are in place."""
    base = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)])
    robots = (replace(base.robots[0], x_m=1.0), replace(base.robots[1], x_m=0.0))
    assigned = replace(base, robots=robots, formation=replace(base.formation, assign=True))
    assert driven(base, standing(1, 0), standing(0, 0))["final_tracking_error_m"] == 1.0
    assert driven(assigned, standing(1, 0), standing(0, 0))["final_tracking_error_m"] == 0.0


def test_the_file_is_the_same_bytes_each_time(tmp_path: Path) -> None:
    found = driven(PAIR, standing(0, 0), standing(1, 0))
    for name in ("a.json", "b.json"):
        write(tmp_path / name, driven(PAIR, standing(0, 0), standing(1, 0)))
    content = (tmp_path / "a.json").read_bytes()
    assert content == (tmp_path / "b.json").read_bytes()
    assert content.endswith(b"}\n")
    assert json.loads(content) == found
    with pytest.raises(RecordingError, match=r"^cannot write .*missing/m\.json: No such file or directory$"):
        write(tmp_path / "missing" / "m.json", found)


def test_names_of_robots_read_as_text() -> None:
    assert robots([3]) == "robot 3"
    assert robots([1, 2, 5]) == "robots 1, 2 and 5"
    assert robots(range(1, 13)) == "robots 1, 2, 3, 4, 5, 6, 7, 8 and 4 more"


def test_poses_of_a_robot_are_not_mixed_up_with_those_of_another() -> None:
    """One message each is enough to tell."""
    sent: list[tuple[int, str, Message]] = [
        (EPOCH_NS, key_expressions.mission(NAME), Mission(1, EPOCH_NS, EPOCH_NS, 10**8, ""))
    ]
    for robot, x in ((1, -0.1), (2, 0.6)):
        state = PlantState(robot, 0, EPOCH_NS + 10**8, x, 0.0, *(0.0,) * 5, True, True, True, "")
        sent.append((EPOCH_NS, key_expressions.plant_state(NAME, robot), state))
    assert judged(PAIR, sent)["min_distance_m"]["edge"] == 0.7


# --- robots that their operators took ------------------------------------------------------------


def taken(*periods: tuple[float, float]) -> dict[str, Any]:
    """A perfect run in which the statuses of robot 2 say `released` in these periods, s."""

    def told(message: Message) -> Message:
        if type(message) is Status and message.robot == 2:
            t = (message.time_ns - EPOCH_NS) / 1e9
            if any(begin <= t < end for begin, end in periods):
                return message._replace(state="released", reason="mode MANUAL")
        return message

    ways = [_body(standing(x, 0), 0.1) for x in (0, 1)]
    return judged(PAIR, [(received, key, told(each)) for received, key, each in messages(PAIR, ways)])


def test_a_release_is_a_warning_with_its_time() -> None:
    verdict = taken((0.5, 1.1), (1.5, 1.7))["verdict"]
    assert verdict["passed"]
    assert verdict["warnings"] == [
        "Robot 2 was released to its operator from 0.6 s to 1.2 s (mode MANUAL): it did not follow the law "
        "then.",
        "Robot 2 was released to its operator from 1.6 s to 1.8 s (mode MANUAL): it did not follow the law "
        "then.",
    ]


def test_a_robot_that_is_still_its_operators_at_the_end_is_a_warning_too() -> None:
    verdict = taken((1.0, 99.0))["verdict"]
    assert (verdict["passed"], verdict["reasons"]) == (True, [])
    assert "from 1.0 s to the end" in verdict["warnings"][0]


def test_a_release_after_the_drive_is_none_of_it() -> None:
    assert taken((2.0, 99.0))["verdict"]["warnings"] == []


def test_poses_that_are_not_to_be_used_are_not() -> None:
    """A bridge that starts again is somewhere at first, and says that it does not know."""

    def lost(each: Sent) -> Sent:
        received, key, message = each
        if type(message) is PlantState and message.robot == 2 and 0.5 < (received - EPOCH_NS) / 1e9 < 0.9:
            message = message._replace(x=0.0, y=0.0, healthy=False)
        return received, key, message

    sent = [lost(each) for each in messages(PAIR, [_body(standing(x, 0), 0.1) for x in (0, 1)])]
    found = judged(PAIR, sent)
    assert found["min_distance_m"]["edge"] == 1.0
    assert found["verdict"]["passed"]
