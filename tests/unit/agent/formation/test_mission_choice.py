"""Which mission holds, and which nobody drives."""

from __future__ import annotations

import pytest

from agent.fleet.loading import digest
from agent.formation.geometry import resolve, resolved
from agent.formation.mission_choice import MissionChoice, MissionRefused
from agent.messages.codec import tag
from agent.messages.types import Mission
from tests.unit.deploy.orders.order_fleets import EPOCH, S, square

FLEET = square()
FIRST = Mission(1, EPOCH, EPOCH, 60 * S, digest(FLEET))
UNDRIVABLE = FIRST._replace(version=9, robots=((99, 0.0, 0.0),))


def choice() -> MissionChoice:
    return MissionChoice(FLEET, resolve(FLEET))


def test_nothing_holds_before_the_first():
    made = choice()
    assert (made.mission, made.plan, made.mark) == (None, None, (0, 0))


def test_the_greatest_version_holds_and_an_older_one_changes_nothing():
    made = choice()
    later = FIRST._replace(version=2, duration_ns=5 * S)
    plan = made.take(later)
    assert plan is not None
    assert plan.mission == later
    assert made.take(FIRST) is None
    assert (made.mission, made.plan, made.mark) == (later, plan, (2, tag(later)))


def test_what_cannot_be_driven_does_not_hold_up_what_can():
    made = choice()
    with pytest.raises(MissionRefused, match="the mission cannot be driven: ") as caught:
        made.take(UNDRIVABLE)
    assert caught.value.reason == "mission"
    assert made.take(FIRST) is not None


def test_a_mission_for_another_file_is_refused_however_new():
    made = choice()
    other = FIRST._replace(version=9, digest="another")
    assert not made.is_ours(other)
    with pytest.raises(MissionRefused, match="the mission is for another fleet file") as caught:
        made.take(other)
    assert caught.value.reason == "digest"


def test_a_resolved_fleet_needs_no_geometry():
    fleet = resolved(FLEET)
    bare, full = MissionChoice(fleet, None), MissionChoice(fleet, resolve(fleet))
    mission = FIRST._replace(digest=digest(fleet))
    one, other = bare.take(mission), full.take(mission)
    assert one is not None
    assert other is not None
    assert (one.members, one.offsets, one.edges) == (other.members, other.offsets, other.edges)
