"""A resume: which robots it is for, and what became of it."""

from __future__ import annotations

from argparse import Namespace

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import PlantState, Resume, Status
from handfast.agent.supervision.orders import AWAITED
from handfast.agent.supervision.situation import NOT_SAID
from handfast.agent.supervision.state_machine import MISSION_OVER
from handfast.deploy.console.arguments import InputError, robots_named
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.orders.mission_outcome import Resuming

ROVERS = load_fleet(FLEETS / "rovers.toml")
T0 = 1_800_000_000 * NS_PER_S
VERSION = T0 // 1_000_000


def resuming_of(*robots: int) -> Resuming:
    return Resuming(ROVERS, Resume(VERSION, T0, robots))


def status(robot: int, state: str, reason: str = "", orders: int = VERSION) -> Status:
    return Status(robot, 1, T0, state, "", reason, 1, orders, (), (), (), ())


def say(
    resuming: Resuming,
    robot: int,
    state: str,
    *,
    healthy: bool = True,
    obeying: bool = True,
    driving: bool = True,
    note: str = "",
    orders: int = VERSION,
) -> None:
    plant = PlantState(robot, 1, T0, *[0.0] * 7, obeying and driving, healthy, obeying, note)
    resuming.feed(key_expressions.status("rovers", robot), status(robot, state, note, orders))
    resuming.feed(key_expressions.plant_state("rovers", robot), plant)


def test_those_that_are_meant() -> None:
    assert resuming_of(3).robots == (3,)
    assert resuming_of().robots == ROVERS.ids


def test_done_when_all_that_are_meant_run() -> None:
    resuming = resuming_of(2, 3)
    say(resuming, 2, "running")
    assert not resuming.done
    say(resuming, 3, "released", obeying=False, note="mode MANUAL, not GUIDED")
    assert not resuming.done
    assert resuming.outcome(2) == "robot 2: running"
    assert resuming.outcome(3) == (
        "robot 3: still released: mode MANUAL, not GUIDED: its operator must give it back first"
    )
    say(resuming, 3, "degraded")
    assert resuming.done


def test_a_robot_without_a_place_stays_where_it_is() -> None:
    resuming = resuming_of(3)
    say(resuming, 3, "standby", driving=False)
    assert resuming.done
    assert resuming.outcome(3) == "robot 3: standby"


def test_a_robot_whose_mission_is_over_stands_and_is_free() -> None:
    resuming = resuming_of(3)
    say(resuming, 3, "stopped", driving=False, note=MISSION_OVER)
    assert resuming.done
    assert resuming.outcome(3) == "robot 3: stopped: the mission is over"


def test_a_state_from_before_the_leave_does_not_count() -> None:
    """As of robots that have not heard yet of the stop that was given just before."""
    resuming = resuming_of(3)
    say(resuming, 3, "running", orders=VERSION - 1)
    assert not resuming.done
    assert resuming.outcome(3) == "robot 3: running; it has not acknowledged the resume"


def test_a_plant_that_has_missed_the_leave_does_not_count() -> None:
    resuming = resuming_of(3)
    say(resuming, 3, "running", driving=False)
    assert not resuming.done
    assert resuming.outcome(3) == "robot 3: running: its plant brakes"


def test_a_later_stop_is_told_as_such() -> None:
    resuming = resuming_of(3)
    say(resuming, 3, "stopped", note="stop: a person", orders=VERSION + 1)
    assert not resuming.done
    assert resuming.outcome(3) == "robot 3: stopped: stop: a person; ordered after this resume"


def test_silence_is_told() -> None:
    resuming = resuming_of(3)
    assert resuming.outcome(3) == "robot 3: nothing heard from its agent"
    resuming.feed(key_expressions.status("rovers", 4), status(3, "running"))
    assert resuming.outcome(3) == "robot 3: nothing heard from its agent", "on another robot's key"
    resuming.feed(key_expressions.status("rovers", 3), status(3, "running"))
    assert resuming.outcome(3) == "robot 3: nothing heard from its plant"


def named(*robots: int) -> tuple[int, ...]:
    return robots_named(ROVERS, Namespace(robots=list(robots)))


def test_robots_that_are_not_there_are_named() -> None:
    assert named() == ()
    assert named(6, 1, 6) == (1, 6)
    with pytest.raises(InputError) as caught:
        named(9, 1, 7)
    assert str(caught.value) == "there is no robot 7, 9 in rovers; there are: 1, 2, 3, 4, 5, 6"


def test_a_leave_that_came_too_late_is_not_blamed_on_its_operator() -> None:
    resuming = resuming_of(3)
    say(
        resuming,
        3,
        "released",
        obeying=False,
        note="its operator has given it back (it was: disarmed): " + AWAITED,
    )
    assert "clock" in resuming.outcome(3)
    assert "must" not in resuming.outcome(3)


def test_who_waits_for_a_word_will_go_on_with_those_that_are_meant() -> None:
    before = {
        1: status(1, "ready", NOT_SAID),
        2: status(2, "ready", NOT_SAID),
        3: status(3, "stopped", "stop"),
    }
    message = Resume(VERSION, T0, (1,))
    assert Resuming(ROVERS, message, before).others == [2]
    assert Resuming(ROVERS, message._replace(robots=()), before).others == []
    assert resuming_of(1).others == []
