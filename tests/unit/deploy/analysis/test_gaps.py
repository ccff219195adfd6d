"""Times without a pose of a robot, and what an analysis does not know then."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.types import Event, PlantState
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.analysis.presence import is_lost, kept_through, pose_gaps, unknown
from handfast.deploy.recording.recording import Damage, Recording
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, Path, make_fleet, messages, standing

FLEET = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=8.0, rate_hz=10.0)


def lacking(robot: int, from_s: float, until_s: float, *hands: Path) -> Recording:
    """A run of two whose hands are on these ways, without the poses of one in a time."""
    bodies = [body(hand, 0.1) for hand in hands or (standing(0.0, 0.0), standing(1.0, 0.0))]
    return recorded(
        FLEET,
        [
            each
            for each in messages(FLEET, bodies)
            if not (
                type(each[2]) is PlantState
                and each[2].robot == robot
                and from_s < (each[2].time_ns - EPOCH_NS) / 1e9 < until_s
            )
        ],
    )


def analysed(recording: Recording) -> Analysis:
    return analyse(recording, resolve(recording.fleet))


def test_a_gap_is_between_two_poses() -> None:
    (gap,) = pose_gaps(lacking(2, 3.05, 3.85))
    assert (gap.robot, gap.lasts, gap.rule, gap.is_lost, gap.is_hidden) == (2, False, "", False, True)
    assert (gap.start_s, gap.end_s) == (gap.since_s, gap.until_s) == pytest.approx((3.0, 3.9))
    assert gap.lasts_s == pytest.approx(0.9)
    assert pose_gaps(lacking(2, 3.05, 3.45)) == []


def test_a_gap_at_either_end_of_the_drive_has_one_pose() -> None:
    (gap,) = pose_gaps(lacking(2, -9.0, 1.95))
    assert (gap.start_s, gap.since_s, gap.before, gap.after) == (0.0, -inf, -1, 0)
    (gap,) = pose_gaps(lacking(2, 6.05, 99.0))
    assert (gap.end_s, gap.until_s, gap.lasts) == (8.0, inf, True)


def test_where_a_simulated_body_is_that_a_rule_stopped_is_known() -> None:
    stopped = Event(2, 0, EPOCH_NS + 3_100_000_000, "plant", "stop", "freeze")
    went_on = Event(2, 1, EPOCH_NS + 4_900_000_000, "plant", "continue", "freeze")
    recording = replace(lacking(2, 3.05, 4.95), events=(stopped, went_on))
    (gap,) = pose_gaps(recording)
    assert (gap.rule, gap.is_hidden) == ("freeze", False)
    assert not analysed(recording).unknown.any()
    (gap,) = pose_gaps(replace(recording, events=(stopped,)))  # nobody knows for how long
    assert (gap.rule, gap.is_hidden) == ("freeze", True)


def test_where_a_rover_rolled_to_in_virtual_time_is_known_though_it_told_nothing() -> None:
    """What its bridge did not tell is a gap all the same; of a real run nobody knows it."""
    killed = Event(2, 0, EPOCH_NS + 3_010_000_000, "plant", "kill", "lost")
    again = Event(2, 1, EPOCH_NS + 4_010_000_000, "plant", "start", "lost")
    rovers = replace(FLEET, robots=tuple(replace(robot, plant="mavlink") for robot in FLEET.robots))
    whole, short = (replace(lacking(2, 3.05, until_s), fleet=rovers) for until_s in (0.0, 4.95))
    simulated = replace(whole, mode="simulate", events=(killed, again))
    (gap,) = pose_gaps(simulated)
    assert (gap.rule, gap.is_hidden) == ("lost", False)
    assert (gap.start_s, gap.end_s) == pytest.approx((3.0, 4.1))
    assert (gap.before, gap.after) == tuple(np.searchsorted(simulated.robots[2].body.t, (3.0, 4.05)))
    assert not analysed(simulated).unknown.any()
    (gap,) = pose_gaps(replace(short, events=(killed, again)))
    assert gap.is_hidden
    assert pose_gaps(replace(whole, events=(killed, again))) == []


def test_what_a_file_has_lost_is_no_matter_of_the_robot() -> None:
    recording = replace(lacking(2, 3.05, 3.85), damage=(Damage("run.mcap", 3.06, 3.84),))
    assert [gap.is_lost for gap in pose_gaps(recording)] == [True]
    assert not is_lost(recording, 3.0, 6.0)
    assert not is_lost(lacking(2, 3.05, 3.85), 3.0, 3.9)


def test_within_a_gap_no_place_and_no_distance_is_known() -> None:
    recording = lacking(2, 3.05, 3.85)
    a = analysed(recording)
    within = (a.grid > 3.01) & (a.grid < 3.89)
    assert (np.isnan(a.hands[:, 1, 0]) == within).all()
    assert (np.isnan(a.distances[:, 0]) == within).all()
    assert (a.counts[:, 0] == ~within).all()
    assert (unknown(pose_gaps(recording), a.ids, a.grid) == a.unknown).all()
    assert not np.isnan(a.hands[:, 0]).any()


def test_a_distance_that_was_taken_from_before_and_after_is_no_violation() -> None:
    """Robot 1 goes past robot 2's place while robot 2 is on its way round it: nobody saw how near."""

    def crossing(t: float) -> tuple[float, float, float]:
        return min(max(2.5 * (t - 3.0), 0.0), 2.0), 0.0, 0.0

    def round_it(t: float) -> tuple[float, float, float]:
        return 1.0, 0.6 if 3.1 <= t <= 3.8 else 0.0, 0.0

    assert not analysed(lacking(9, 0, 0, crossing, round_it)).with_edge.unsafe
    a = analysed(lacking(2, 3.05, 3.85, crossing, round_it))
    assert not a.with_edge.unsafe
    assert a.closest is not None
    assert a.closest.distance_m > 0.5


def test_a_gap_does_not_settle_a_formation() -> None:
    """An edge is off until the gap, and right after it: it was off all the while, not until half way."""

    def late(t: float) -> tuple[float, float, float]:
        return 1.2 if t < 3.05 else 1.0, 0.0, 0.0

    assert analysed(lacking(2, 3.05, 4.95, standing(0.0, 0.0), late)).settling_s == pytest.approx(4.9)
    assert analysed(lacking(2, 3.15, 4.95, standing(0.0, 0.0), late)).settling_s == pytest.approx(3.0)
    assert analysed(lacking(2, 6.05, 99.0)).settling_s is None


def test_what_was_so_at_either_end_may_have_been_so_all_the_while() -> None:
    def kept(flags: str, hidden: str) -> str:
        both = (np.array([[each == "1" for each in text] for text in (flags, hidden)]).T)[:, :, None]
        return "".join("01"[int(each)] for each in kept_through(both[:, 0], both[:, 1])[:, 0])

    assert kept("1000", "0110") == "1110"
    assert kept("0001", "0110") == "0111"
    assert kept("0000", "0110") == "0000"
    assert kept("1000", "0111") == "1111"
    assert kept("0001", "1110") == "1111"
    assert kept("0100", "0000") == "0100"
