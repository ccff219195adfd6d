"""Whether a fleet that is up may be driven: by what it was ordered before, and by whom it was stopped."""

from __future__ import annotations

import time

import pytest

from handfast.agent.fleet.loading import digest
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Mission, Resume, Status, Stop
from handfast.deploy.drive.preconditions import CAME_UP, GOES_DOWN, OVER, clock, is_lifted, refusal, somebodys
from handfast.deploy.orders.operator import Operator
from tests.unit.deploy.orders.order_fleets import EPOCH, S, square

FLEET = square()
TOLD = key_expressions.relayed("square", 1)
MISSION = Mission(1, EPOCH - S, EPOCH, 60 * S, digest(FLEET))
GIVEN = EPOCH + S
"""When the drive is given: after the stops that there are."""
DURING, AFTER = EPOCH + 10 * S, EPOCH + 60 * S


def known(*orders: Mission | Stop | Resume) -> Operator:
    made = Operator(FLEET, resolve(FLEET))
    for order in orders:
        made.hear(TOLD, order)
    return made


def stop(version: int, reason: str = "a person") -> Stop:
    return Stop(version, EPOCH, reason)


def resumed(version: int, *ids: int) -> Resume:
    return Resume(version, EPOCH, ids)


def test_a_fleet_that_was_ordered_nothing_or_whose_mission_is_over_may_be_driven() -> None:
    assert refusal(known(), DURING, resume=False, given_ns=GIVEN) == ""
    assert refusal(known(MISSION), AFTER, resume=False, given_ns=GIVEN) == ""


@pytest.mark.parametrize("resume", [False, True])
def test_a_fleet_that_drives_is_left_alone(resume: bool) -> None:
    driving = known(MISSION._replace(note="robot 7 joins"), stop(2), resumed(3))
    begun, end = clock(EPOCH - S, AFTER), clock(EPOCH + 60 * S, AFTER)
    assert refusal(driving, AFTER - 1, resume=resume, given_ns=GIVEN) == (
        f"square is driving already: a mission that was given at {begun} (robot 7 joins) "
        f"and ends at {end}; wait until then, or say `handfast stop` first"
    )


def test_a_stop_that_somebody_said_stands_until_it_is_lifted_by_name() -> None:
    stopped = known(MISSION, resumed(2), stop(3))
    for now_ns in (DURING, AFTER):
        assert refusal(stopped, now_ns, resume=False, given_ns=GIVEN) == (
            f"the robots of square were told to stop at {clock(EPOCH, now_ns)}: a person; drive with "
            "--resume if they may drive again"
        )
        assert refusal(stopped, now_ns, resume=True, given_ns=GIVEN) == ""
    assert refusal(known(stop(3, "interrupted")), AFTER, resume=False, given_ns=GIVEN)
    assert refusal(known(stop(3, "")), AFTER, resume=False, given_ns=GIVEN)


def test_the_stop_at_a_drives_regular_end_is_no_obstacle() -> None:
    ended = known(MISSION, stop(3, OVER))
    assert refusal(ended, AFTER, resume=False, given_ns=GIVEN) == ""
    assert ended.stop_in_force == stop(3, OVER)


@pytest.mark.parametrize(
    ("orders", "stands"),
    [
        ([], False),
        ([stop(3)], True),
        ([stop(3), resumed(2)], True),
        ([stop(3), resumed(3)], True),  # of equal versions the stop holds
        ([stop(3), resumed(4)], False),
        ([resumed(4), stop(3)], False),
        ([stop(3), resumed(4, 1, 2)], True),  # the others stand
    ],
)
def test_which_stop_is_in_force(orders: list[Stop | Resume], stands: bool) -> None:
    assert known(*orders).stop_in_force == (stop(3) if stands else None)


def test_robots_that_read_another_file_are_not_driven_by_this_one() -> None:
    other = MISSION._replace(digest="0123456789abcdef" * 4)
    text = refusal(known(other), AFTER, resume=True, given_ns=GIVEN)
    assert text.startswith(
        "the robots of square read another fleet file: its digest is 0123456789abcdef, this"
    )
    assert digest(FLEET) in text
    made = Operator(FLEET, resolve(FLEET))
    made.hear(key_expressions.mission("square"), other)  # by an operator, whom no robot believes
    assert refusal(made, AFTER, resume=True, given_ns=GIVEN) == ""


def test_a_time_of_another_day_has_its_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    try:
        noon = 1_800_014_400 * S
        assert clock(noon, noon + 11 * 3600 * S) == "12:00:00"
        assert clock(noon, noon + 13 * 3600 * S) == "2027-01-15 12:00:00"
        assert clock(noon, noon + 366 * 24 * 3600 * S) == "2027-01-15 12:00:00"
    finally:
        monkeypatch.undo()
        time.tzset()


def test_what_robots_tell_is_safe_to_print() -> None:
    assert ": \\x1b[2Jnow; drive with" in refusal(
        known(stop(3, "\x1b[2Jnow")), AFTER, resume=False, given_ns=GIVEN
    )
    driving = known(MISSION._replace(note="\x1b[2J"))
    assert " (\\x1b[2J) and ends" in refusal(driving, DURING, resume=False, given_ns=GIVEN)


def test_no_drive_begins_by_a_clock_that_no_robot_believes() -> None:
    driver, now_ns = known(), DURING + 3 * 86_400 * S
    assert refusal(driver, now_ns, resume=False, given_ns=GIVEN) == "", "nobody is heard"
    for robot, time_ns in ((1, 0), (2, DURING)):
        status = Status(robot, 1, time_ns, "ready", "", "", 0, 0, (), (), (), ())
        driver.hear(key_expressions.status("square", robot), status)
    assert refusal(driver, now_ns, resume=True, given_ns=GIVEN).startswith(
        "set this machine's clock: it is 72 h ahead"
    )
    status = Status(3, 1, now_ns - S, "ready", "", "", 0, 0, (), (), (), ())
    driver.hear(key_expressions.status("square", 3), status)
    assert refusal(driver, now_ns, resume=False, given_ns=GIVEN) == "", "then it is theirs that is wrong"


@pytest.mark.parametrize("reason", ["a person", CAME_UP, GOES_DOWN, ""])
@pytest.mark.parametrize("resume", [False, True])
def test_no_stop_is_lifted_by_a_drive_that_was_given_before_it(reason: str, resume: bool) -> None:
    later = Stop(5, GIVEN + S, reason)
    text = refusal(known(stop(3), later), DURING, resume=resume, given_ns=GIVEN)
    assert "after this drive was given; drive again if they may" in text
    assert refusal(known(later._replace(reason=OVER)), DURING, resume=resume, given_ns=GIVEN) == ""
    assert refusal(known(later), DURING, resume=True, given_ns=GIVEN + 2 * S) == ""
    ahead = later._replace(time_ns=DURING + 60 * S)  # of a clock that is: nobody knows when it was given
    assert refusal(known(ahead), DURING, resume=True, given_ns=GIVEN) == ""


@pytest.mark.parametrize("reason", [OVER, GOES_DOWN, CAME_UP])
def test_a_person_who_gives_a_programs_reason_means_it(reason: str) -> None:
    assert is_lifted(Stop(1, 1, reason))
    assert not is_lifted(Stop(1, 1, somebodys(reason)))
    assert somebodys("lunch") == "lunch"
