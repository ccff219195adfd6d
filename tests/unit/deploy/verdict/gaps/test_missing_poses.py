"""What is said of gaps in the poses, and which of them fail the verdict."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.types import Event, PlantState
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.gaps.missing_poses import FEW_GAPS, SHARE_MAX, Gap, MissingPoses
from handfast.deploy.verdict.gaps.stakes import Stake
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, Path, in_formation, make_fleet, messages, standing

PLACES = [(0.0, 0.0), (2.003, 0.0)]
WIDE = make_fleet(PLACES, [(1, 2)], duration_s=20.0, rate_hz=10.0)


def lacking(
    robot: int, *spans: tuple[float, float], fleet: Fleet = WIDE, ways: list[Path] | None = None
) -> Recording:
    """A run without the poses of one robot in these times."""
    return recorded(
        fleet,
        [
            each
            for each in messages(fleet, ways or in_formation(fleet))
            if not (
                type(each[2]) is PlantState
                and each[2].robot == robot
                and any(a < (each[2].time_ns - EPOCH_NS) / 1e9 < b for a, b in spans)
            )
        ],
    )


def verdict(recording: Recording) -> dict[str, Any]:
    found: dict[str, Any] = RunResult(recording).metrics["verdict"]
    return found


def test_a_gap_in_which_nothing_can_have_happened_is_said_and_fails_nothing() -> None:
    found = verdict(lacking(2, (3.05, 3.85)))
    assert found["passed"], found
    # 2.003 m, less 0.45 s out and back at 1.75 m/s, and the 20 ms between two looks.
    assert found["warnings"] == [
        "Robot 2 sent no pose from 3.00 s to 3.90 s: it moved 0.01 m meanwhile, and cannot have come nearer "
        "than 1.20 m to robot 1."
    ]


def test_a_gap_in_which_it_may_have_come_too_near_fails_and_says_that_it_is_not_known() -> None:
    near = make_fleet([(0.0, 0.0), (0.903, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=10.0)
    found = verdict(lacking(2, (3.05, 3.85), fleet=near))
    assert found["reasons"] == [
        "Robot 2 sent no pose from 3.00 s to 3.90 s: it may have come within 0.10 m of robot 1 (safe "
        "distance 0.22 m)."
    ]
    assert found["warnings"] == []


def test_a_distance_in_a_gap_is_never_a_violation() -> None:
    """Half way between the poses before and after it, robot 2 would have been where robot 1 stands."""

    def across(t: float) -> tuple[float, float, float]:
        return min(max(-2.0 + 4.0 * (t - 3.0), -2.0), 2.0), 0.0, 0.0

    ways = [body(standing(0.0, 0.0), 0.1), body(across, 0.1)]
    result = RunResult(lacking(2, (2.95, 4.05), ways=ways))
    assert not result.passed
    assert result.metrics["oracles"]["separation"]["violations"] == 0
    assert result.metrics["min_distance_m"]["any"] > 1.9
    (said,) = [each for each in result.reasons if "sent no pose" in each]
    assert said == (
        "Robot 2 sent no pose from 2.90 s to 4.10 s, and had moved by 4.00 m then, further than it can: "
        "where it was meanwhile is not known."
    )


def test_the_other_may_be_in_a_gap_too() -> None:
    both = [(3.05, 3.45 + 0.2)]
    sent = messages(WIDE, in_formation(WIDE))
    recording = recorded(
        WIDE,
        [
            each
            for each in sent
            if not (
                type(each[2]) is PlantState
                and any(a < (each[2].time_ns - EPOCH_NS) / 1e9 < b for a, b in both)
            )
        ],
        "simulate",
    )
    warnings = RunResult(recording).warnings
    alone = RunResult(lacking(2, *both)).warnings
    near_m = [float(text.split("nearer than ")[1].split(" m")[0]) for text in (warnings[0], alone[0])]
    assert near_m[0] < near_m[1] - 0.3


def test_a_gap_to_the_end_fails_however_far_away_it_is() -> None:
    far = make_fleet([(0.0, 0.0), (90.0, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=10.0)
    reasons = verdict(lacking(2, (18.05, 99.0), fleet=far))["reasons"]
    assert reasons[0] == "The data are incomplete: robot 2 sent no pose from 18.00 s to 20.00 s."


@pytest.mark.parametrize(("count", "passed"), [(5, True), (6, False)])
def test_gaps_may_be_a_fifth_of_the_drive(count: int, passed: bool) -> None:
    """0.75 s at a time: 3.75 s of 20 s are, 4.5 s are not."""
    fleet = make_fleet([(0.0, 0.0), (5.0, 0.0)], [(1, 2)], duration_s=20.0, rate_hz=20.0)
    found = verdict(lacking(2, *((2.0 * k + 1.01, 2.0 * k + 1.74) for k in range(count)), fleet=fleet))
    assert SHARE_MAX == 0.2
    assert found["passed"] == passed
    if passed:
        assert found["warnings"] == [
            "5 times from 1.00 s to 9.75 s robot 2 sent no pose, for up to 0.8 s and 3.8 s together: it "
            "moved up to 0.01 m meanwhile, and cannot have come nearer than 4.31 m to robot 1."
        ]
    else:
        assert found["reasons"] == [
            "The data are incomplete: in 22 % of the drive robot 2 sent no pose, where 20 % is allowed; for "
            "longest from 1.00 s to 1.75 s."
        ]


def test_what_a_rule_did_is_no_share_of_it_and_fails_nothing() -> None:
    stopped = Event(2, 0, EPOCH_NS + 3_100_000_000, "plant", "stop", "freeze")
    back = Event(2, 1, EPOCH_NS + 13_000_000_000, "plant", "continue", "freeze")
    recording = replace(lacking(2, (3.05, 12.95)), events=(stopped, back))
    data = MissingPoses(recording, analyse(recording, resolve(WIDE)))
    assert data.reasons == []
    assert data.warnings == ["Rule 'freeze' stopped robot 2's plant: from 3.00 s to 13.00 s it sent no pose."]


def gaps_of(robots: int, **known: Any) -> tuple[list[str], list[str]]:
    """Reasons and warnings where each of so many robots sent no pose for a while, each at another time."""
    fleet = make_fleet([(float(k), 0.0) for k in range(robots)], [(1, 2)], duration_s=20.0)
    recording = recorded(fleet, messages(fleet, in_formation(fleet)))
    found = MissingPoses(recording, analyse(recording, resolve(fleet)))
    found.gaps = [Gap(k, 0.1 * k, 1.0 + 0.01 * k, **known) for k in range(1, robots + 1)]
    return found.reasons, found.warnings


def test_poses_that_many_robots_lack_are_one_sentence() -> None:
    reasons, warnings = gaps_of(12, is_late=True, moved_m=0.02)
    assert (reasons, warnings) == (
        [],
        [
            "No pose came of 12 robots (1-12) for up to 0.9 s, for a machine was too slow: they moved up to "
            "0.02 m meanwhile."
        ],
    )
    assert len(gaps_of(3, is_late=True, moved_m=0.02)[1]) == 3
    _, (unseen, _) = gaps_of(2, is_late=True, moved_m=inf)  # there was no pose before it
    assert unseen == "Robot 1 sent no pose from 0.10 s to 1.01 s, for its machine was too slow."
    _, (unseen, _) = gaps_of(2, moved_m=inf)
    assert unseen == "Robot 1 sent no pose from 0.10 s to 1.01 s."
    near = Stake("robot 7", 0.1, 0.22)
    reasons, warnings = gaps_of(12, moved_m=0.1, stake=near)
    assert (reasons, warnings) == (
        [
            "The data are incomplete: no pose came of 12 robots (1-12) for up to 0.9 s; one of them may have "
            "come within 0.10 m of robot 7 (safe distance 0.22 m)."
        ],
        [],
    )
    assert len(gaps_of(8, moved_m=0.1, stake=near)[0]) == 8
    reasons, warnings = gaps_of(12, moved_m=0.1, stake=Stake("robot 7", 0.3, 0.22))
    assert (reasons, warnings) == (
        [],
        [
            "No pose came of 12 robots (1-12) for up to 0.9 s: they moved up to 0.10 m meanwhile, and cannot "
            "have come nearer than 0.30 m to robot 7."
        ],
    )
    assert FEW_GAPS < 8 == len(gaps_of(8, moved_m=0.1)[1])


def test_what_is_worst_of_a_robot_is_said_of_it() -> None:
    near, nearer = Stake("robot 1", 0.2, 0.22), Stake("rock", -0.4, 0.1)
    recording = lacking(9)
    found = MissingPoses(recording, analyse(recording, resolve(WIDE)))
    found.gaps = [Gap(2, 1.0, 2.0, stake=near), Gap(2, 4.0, 5.0, stake=nearer)]
    assert found.reasons == [
        "Robot 2 sent no pose from 4.00 s to 5.00 s: it may have been up to 0.40 m inside rock."
    ]
    assert found.warnings == []
    found.gaps = [*found.gaps, Gap(2, 18.0, 20.0, lasts=True)]
    assert found.reasons == ["The data are incomplete: robot 2 sent no pose from 18.00 s to 20.00 s."]
