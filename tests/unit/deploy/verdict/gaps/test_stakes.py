"""How near a robot can have come to anything while nobody knew where it was."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import GeofenceSection, ObstacleSection
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.types import PlantState, Status
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.analysis.gaps import pose_gaps
from handfast.deploy.verdict.gaps.stakes import FENCE, Stake, Stakes
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, make_fleet, messages, standing

PAIR = make_fleet([(0.0, 0.0), (9.0, 0.0)], [(1, 2)], duration_s=8.0, rate_hz=10.0)
V = 1.75
"""m/s, by which the verdict lets hands drive: 1.1 times 1.5 m/s, and 0.1 m/s."""


def nearest(fleet: Fleet, *, fast: float = 0.1, released: bool = False) -> Stake | None:
    """Of robot 2, which stands at (9, 0) and sends no pose from 3 s to 4 s."""
    sent = []
    for received_ns, key, message in messages(fleet, [body(standing(x, 0.0), 0.1) for x in (0.0, 9.0)]):
        if type(message) is PlantState and message.robot == 2:
            if 3.05 < (message.time_ns - EPOCH_NS) / 1e9 < 3.95:
                continue
            message = message._replace(speed=fast)
        if type(message) is Status and message.robot == 2 and released:
            message = message._replace(state="released")
        sent.append((received_ns, key, message))
    recording = recorded(fleet, sent)
    stakes = Stakes(recording, analyse(recording, resolve(fleet)))
    (gap,) = pose_gaps(recording)
    assert stakes.too_far_m(gap) < 0.0
    return stakes.nearest(gap)


def rock(x: float) -> Fleet:
    return replace(PAIR, obstacles=(ObstacleSection("rock", (x, 0.0), 0.5),))


def test_to_another_robot() -> None:
    found = nearest(PAIR)
    assert found is not None
    assert (found.what, found.safe_m) == ("robot 1", 0.22)
    assert found.least_m == pytest.approx(9.0 - 0.5 * V, abs=0.04)
    assert found.least_m <= 9.0 - 0.5 * V
    assert not found.may_be_broken


def test_to_an_obstacle() -> None:
    found = nearest(rock(11.0))
    assert found is not None
    assert found.what == "rock"
    assert found.least_m == pytest.approx(1.5 - 0.5 * V)
    found = nearest(rock(10.2))
    assert found is not None
    assert found.may_be_broken
    assert found.words == "may have been up to 0.18 m inside rock"
    # What is measured nearer than that is the oracle's, and what its operator does is his.
    for other in (nearest(rock(9.58)), nearest(rock(10.2), released=True)):
        assert other is not None
        assert other.what == "robot 1"


def test_to_the_geofence() -> None:
    corners = ((-5.0, -5.0), (9.6, -5.0), (9.6, 5.0), (-5.0, 5.0))
    fleet = replace(PAIR, geofence=GeofenceSection(points_m=corners))
    found = nearest(fleet)
    assert found is not None
    assert found.what == FENCE
    assert found.least_m == pytest.approx(0.6 - 0.5 * V)
    assert not found.may_be_broken  # it may be outside as long as it brakes
    assert Stake(FENCE, -1.25, -1.0).words == "may have been up to 1.25 m outside the geofence"


def test_who_was_measured_faster_than_it_may_be_can_have_been_further_away() -> None:
    found = nearest(PAIR, fast=4.0)
    assert found is not None
    assert found.least_m == pytest.approx(9.0 - 0.5 * 4.0, abs=0.08)


def test_words_of_a_distance() -> None:
    assert (
        Stake("robot 2", 0.312, 0.66).words == "may have come within 0.31 m of robot 2 (safe distance 0.66 m)"
    )
    assert Stake("rock", 0.1, 0.3).words == "may have come within 0.10 m of rock (at least 0.30 m)"
