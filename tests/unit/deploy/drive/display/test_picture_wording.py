"""A picture of a fleet in words."""

from __future__ import annotations

import pytest

from handfast.deploy.drive.display.picture_wording import (
    FAULTS_MAX,
    clock_words,
    faults_line,
    packed,
    summary,
)
from handfast.deploy.drive.watch import Picture, RobotPicture


def about(state: str, reason: str = "", clock: tuple[int, float] | None = None) -> RobotPicture:
    return RobotPicture(state, reason, None, None, None, 0, clock=clock)


def picture(*robots: RobotPicture, faults: tuple[str, ...] = ()) -> Picture:
    return Picture(1.0, 60.0, None, None, dict(enumerate(robots, 1)), list(faults))


def test_what_is_not_known_is_left_out() -> None:
    assert summary(picture()) == ""
    found = picture(about("running"), about("running"))
    assert summary(found) == "all running"
    found.worst, found.nearest, found.robots[2].age_ms = (0.25, 1, 2), (0.75, 1, 2), 19.6
    assert (
        summary(found)
        == "worst edge 0.250 m off (1-2), closest 0.750 m (1-2), oldest message 20 ms, all running"
    )


def test_who_is_released_is_named_with_why() -> None:
    found = picture(about("running"), about("released", "disarmed"))
    assert summary(found) == "running: 1, released: 2 (disarmed)"


@pytest.mark.parametrize(
    ("ahead_s", "said"), [(0.12, "clock of robot 2 120 ms ahead"), (-0.12, "clock of robot 2 120 ms behind")]
)
def test_whose_clock_is_off_and_how(ahead_s: float, said: str) -> None:
    one = about("running", clock=(2, ahead_s))
    assert clock_words(one) == said
    assert clock_words(about("running")) == ""
    # Of a pair the one that sees the other ahead says it.
    shown = summary(picture(one, about("running", clock=(1, -ahead_s))))
    whose = (
        "clock of robot 2 120 ms ahead of robot 1's"
        if ahead_s > 0
        else "clock of robot 1 120 ms ahead of robot 2's"
    )
    assert shown == f"all running, {whose}"


def test_of_many_faults_the_first_are_named() -> None:
    assert faults_line(picture()) == ""
    names = tuple(f"r{k}" for k in range(FAULTS_MAX + 2))
    assert faults_line(picture(faults=names[:FAULTS_MAX])) == "faults: r0; r1; r2; r3"
    assert faults_line(picture(faults=names)) == "faults: r0; r1; r2; r3; and 2 more"


def test_parts_of_a_summary_are_broken_where_they_end() -> None:
    assert packed(["worst edge 0.1 m", "closest 0.8 m", "all running"], 33) == [
        "worst edge 0.1 m, closest 0.8 m,",
        "all running",
    ]
    assert packed(["worst edge 0.1 m", "closest 0.8 m"], 31) == ["worst edge 0.1 m,", "closest 0.8 m"]
    assert packed(["longer than it is wide", "b"], 10) == ["longer than it is wide,", "b"]
    assert packed([], 10) == []
