"""Who is not heard, and where it is believed to be."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import Beacon, Removed, Silent
from handfast.deploy.analysis.silence import SilentBodies, in_words
from tests.unit.deploy.synthetic_run import EPOCH_NS


def ns(t: float) -> int:
    return EPOCH_NS + round(t * NS_PER_S)


def row(robot: int, t: float, x: float = 0.0, y: float = 0.0, to_x: float | None = None) -> Silent:
    return Silent(robot, ns(t), True, x, y, 0.0, 0.0, x if to_x is None else to_x, y, 0.3)


def beacon(
    robot: int, t: float, *silent: Silent, x: float = 0.0, unheard: tuple[int, ...] | None = None
) -> Beacon:
    """Of a robot that does not hear whom it names, unless others are given."""
    deaf_to = tuple(each.robot for each in silent) if unheard is None else unheard
    return Beacon(robot, 0, ns(t), True, x, 0.0, 0.0, 0.0, 0.0, 1, 0, -1, -1, silent, deaf_to)


def heard(*beacons: Beacon) -> SilentBodies:
    bodies = SilentBodies()
    for each in beacons:
        bodies.hear(each)
    return bodies


def test_a_fleet_that_hears_itself_has_none() -> None:
    assert heard().bodies() == []
    assert heard(beacon(1, 5.0), beacon(2, 5.1)).bodies() == []


def test_who_was_heard_last_says_where_it_is() -> None:
    """Robot 6 died at 4 s; robot 2 heard it a second longer than robot 1."""
    found = heard(
        beacon(6, 3.0, x=9.0),
        beacon(1, 80.0, row(6, 3.0, 1.0, 1.0)),
        beacon(2, 80.1, row(6, 4.0, 2.0, 3.0)),
    ).bodies()
    (body,) = found
    assert (body.robot, body.silent_s, body.x, body.y) == (6, pytest.approx(76.1), 2.0, 3.0)
    assert (body.told_by, body.heard) == ((1, 2), False)
    assert in_words(found) == [
        "not heard: robot 6 for 76 s (not by robots 1 and 2), believed at (2.00, 3.00), give or take 0.30 m"
    ]
    assert body.row["told_by"] == [1, 2]


def test_who_was_never_heard_is_not_silent_for_fifty_years() -> None:
    never = row(6, 0.0, 1.0, 1.0)._replace(time_ns=0)
    found = heard(beacon(1, 5.0, never), beacon(2, 5.1)).bodies()
    (body,) = found
    assert body.silent_s is None
    assert body.row["silent_s"] is None
    assert in_words(found) == [
        "not heard: robot 6 since the drive began (not by robot 1), believed at (1.00, 1.00), "
        "give or take 0.30 m"
    ]
    assert in_words(found, 0) == ["not heard: robot 6 since the drive began"]
    told = heard(beacon(1, 5.0, never), beacon(2, 5.1, row(6, 4.0, 2.0, 3.0))).bodies()
    assert [each.silent_s for each in told] == [pytest.approx(1.1)]


def test_one_that_only_some_do_not_hear_is_told_apart() -> None:
    found = heard(beacon(1, 10.0, row(2, 7.0)), beacon(2, 10.0, row(1, 7.0))).bodies()
    assert [(body.robot, body.told_by, body.heard) for body in found] == [(1, (2,), True), (2, (1,), True)]
    assert in_words(found) == ["not heard by all others: robots 1 and 2"]


def test_a_body_that_was_carried_off_is_nowhere_until_it_is_heard_again() -> None:
    bodies = heard(beacon(6, 3.0), beacon(1, 10.0, row(6, 3.0)))
    assert [body.robot for body in bodies.bodies([Removed(6, ns(2.0))])] == [6], "it was heard since"
    assert bodies.bodies([Removed(6, ns(5.0))]) == []


def test_it_is_over_when_its_sender_hears_it_again() -> None:
    bodies = heard(beacon(2, 9.9), beacon(1, 10.0, row(2, 7.0)))
    assert len(bodies.bodies()) == 1
    bodies.hear(beacon(1, 10.2))
    assert bodies.bodies() == []
    bodies.hear(beacon(1, 10.1, row(2, 7.0)))  # late
    assert bodies.bodies() == []
