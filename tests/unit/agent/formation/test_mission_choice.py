"""Which mission holds, and which nobody drives."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.loading import digest
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.formation.mission_plan import MissionChoice, MissionRefused
from handfast.agent.messages.codec import decode, encode, tag
from handfast.agent.messages.types import Mission
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


def test_robots_of_one_process_make_one_plan_of_a_message_that_they_all_hear():
    """A process of 100 bodies would else stand for a tick."""
    geometry = resolve(FLEET)
    one, other = MissionChoice(FLEET, geometry), MissionChoice(FLEET, geometry)
    assert one.take(FIRST) is other.take(FIRST)
    assert one.take(FIRST) is None
    elsewhere = square()  # another fleet's file may differ
    assert MissionChoice(elsewhere, resolve(elsewhere)).take(FIRST) is not one.plan
    alike = decode(encode(FIRST))
    assert isinstance(alike, Mission)
    assert MissionChoice(FLEET, geometry).take(alike) is not one.plan


def test_which_one_holds_is_told_by_what_is_in_it():
    made = choice()
    assert not made.holds(FIRST)
    made.take(FIRST)
    assert made.holds(FIRST)
    assert made.holds(FIRST._replace(time_ns=FIRST.time_ns + 1)), "only said once more"
    assert not made.holds(FIRST._replace(duration_ns=5 * S))
