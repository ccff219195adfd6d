"""What is said to be missing of recordings; `test_merge.py` has the rest."""

from __future__ import annotations

from pathlib import Path

from handfast.agent.common.time import NS_PER_S
from handfast.agent.recorder.segments import About
from handfast.deploy.merging.missing import VERSION_MAX, Window, missing, times
from handfast.deploy.merging.robot_recording import Damage, SegmentFile
from tests.unit.deploy.synthetic_run import make_fleet, triangle

FLEET = make_fleet(*triangle(2))
WINDOW = Window(0, 100 * NS_PER_S, 10 * NS_PER_S)


def recorded(robot: int, *stretches_s: tuple[float, float], version: str = "0.1.0") -> SegmentFile:
    about = About("made-up", "", robot, version, "", 1, 0, "")
    stretches = [(round(first * NS_PER_S), round(last * NS_PER_S)) for first, last in stretches_s]
    return SegmentFile(Path(), about, 1, stretches)


def said(*taken: SegmentFile) -> list[str]:
    return missing(taken, (), Damage(), FLEET, WINDOW)


def test_one_recording_does_not_say_how_long_the_others_should_be() -> None:
    honest = [recorded(robot, (10.0, 20.0)) for robot in (1, 3)]
    assert said(*honest, recorded(2, (10.0, 20.0))) == []
    assert said(*honest, recorded(2, (1.0, 90.0))) == []
    assert said(*honest, recorded(2, (1.0, 2.0), (80.0, 90.0))) == [
        "nothing was recorded of robot 2 from 0.0 s to 10.0 s"
    ]
    late = [recorded(1, (15.0, 18.0)), recorded(2, (10.0, 20.0)), recorded(3, (10.0, 20.0))]
    assert said(*late) == ["nothing was recorded of robot 1 from 0.0 s to 5.0 s, 8.0 s to 10.0 s"]


def test_versions_are_shown_as_far_as_they_are_text() -> None:
    hostile = "\x1b[2J" + "x" * 10_000
    (line,) = said(
        recorded(1, (10.0, 20.0)), recorded(2, (10.0, 20.0), version=hostile), recorded(3, (10.0, 20.0))
    )
    assert line.isprintable()
    assert len(line) < 100 + VERSION_MAX


def test_times_in_words() -> None:
    assert times(0, 2**62) == "at all"
    assert times(0, NS_PER_S) == "until 1970-01-01 00:00:01 UTC"
    assert times(2**61, 2**62).startswith("from 2043-")
