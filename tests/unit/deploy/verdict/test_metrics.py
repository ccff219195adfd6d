"""Metrics against runs whose numbers are known by hand."""

from __future__ import annotations

import json
from math import sqrt
from pathlib import Path

import pytest

from handfast.agent.messages.types import Message, PlantState, Status
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.verdict.metrics import write
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import PAIR, body, driven, judged, recorded, status, with_statuses
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    Sent,
    in_formation,
    make_fleet,
    messages,
    standing,
    triangle,
)


def test_a_perfect_run() -> None:
    found = driven(PAIR, standing(0, 0), standing(1, 0))
    assert list(found) == [
        "fleet", "law", "seed", "mode", "robots", "edges", "rate_hz", "duration_s", "min_distance_m",
        "settling_time_s", "tracking_settling_time_s", "changes", "final_distance_error_m",
        "final_tracking_error_m",
        "rms_distance_error_m", "messages", "age_of_information_ms", "tick", "machine", "links", "injected",
        "clock_offsets",
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
    assert found["machine"] == {"late_robots": []}
    assert found["links"] == []
    assert found["injected"]["decided"] == 0


def test_settling_time_is_the_last_time_that_an_edge_was_off() -> None:
    """Robot 2 jumps from 1.2 m to 1 m between the ticks at 0.98 s and 1 s."""
    found = driven(PAIR, standing(0, 0), lambda t: (1.2 if t < 0.99 else 1.0, 0.0, 0.0))
    assert found["settling_time_s"] == 0.98
    assert found["rms_distance_error_m"] == pytest.approx(0.2 * sqrt(50 / 101), abs=1e-6)
    assert found["verdict"]["passed"]


def test_tracking_error_is_against_the_robots_own_place() -> None:
    fleet = make_fleet([(0, 0), (1, 0)], [(1, 2)], velocity=(0.5, 0.0))
    found = driven(fleet, lambda t: (0.5 * t, 0.03, 0.0), lambda t: (1 + 0.5 * t, 0.04, 0.0))
    assert found["final_tracking_error_m"] == pytest.approx(0.04, abs=1e-6)
    assert found["final_distance_error_m"] == pytest.approx(sqrt(1 + 0.01**2) - 1, abs=1e-6)


def test_a_robot_that_its_operator_has_is_not_off_its_place() -> None:
    paths = [body(standing(0, 0), 0.1), body(lambda t: (1.0, 3.0 if t > 1 else 0.0, 0.0), 0.1)]

    def told(message: Message) -> Message:
        taken = type(message) is Status and message.robot == 2 and message.time_ns > EPOCH_NS + 9 * 10**8
        return message._replace(state="released") if taken and type(message) is Status else message

    found = judged(PAIR, [(t, key, told(message)) for t, key, message in messages(PAIR, paths)])
    assert found["final_tracking_error_m"] == 0.0
    assert found["final_distance_error_m"] is None


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
    found = RunResult(recording).metrics
    assert found["min_distance_m"]["any"] == pytest.approx(min(least.values()), abs=1e-6)
    with_edge = min(value for pair, value in least.items() if frozenset(pair) in edges)
    assert found["min_distance_m"]["edge"] == pytest.approx(with_edge, abs=1e-6)


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


# --- robots that their operators took ------------------------------------------------------------


def test_poses_that_are_not_to_be_used_are_not() -> None:
    """A bridge that starts again is somewhere at first, and says that it does not know."""

    def lost(each: Sent) -> Sent:
        received, key, message = each
        if type(message) is PlantState and message.robot == 2 and 0.5 < (received - EPOCH_NS) / 1e9 < 0.9:
            message = message._replace(x=0.0, y=0.0, healthy=False)
        return received, key, message

    sent = [lost(each) for each in messages(PAIR, [body(standing(x, 0), 0.1) for x in (0, 1)])]
    found = judged(PAIR, sent)
    assert found["min_distance_m"]["edge"] == 1.0
    assert found["verdict"]["passed"]
