"""Lines about what happens during a drive."""

from __future__ import annotations

from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.deploy.drive.news import AGAIN_NS, CHANGED, ORDERED, SENTENCES_MAX, Happening, News
from tests.unit.deploy.orders.order_fleets import EPOCH, S, square

FLEET = square("fleet.duration_s=60")


def news(*states: tuple[int, str]) -> News:
    """Told these states before the drive."""
    made = News(FLEET)
    for robot, state in states:
        made.state(robot, "waiting", "for its plant")
        made.state(robot, state, "")
    assert made.sentences(None) == []
    return made


def test_a_start_and_an_end_are_no_news() -> None:
    made = news((1, "ready"), (7, "standby"))
    made.state(1, "running", "")
    assert made.sentences(0.1) == []
    made.state(7, "standby", "in reserve")
    assert made.sentences(5.0) == []
    for state in ("stopping", "stopped"):
        made.state(1, state, "the mission is over")
        assert made.sentences(60.1) == []


def test_what_a_vehicle_says_again_and_again_is_told_once() -> None:
    made = news()
    for second in range(5):
        made.said(3, "its vehicle says (warning): low battery", EPOCH + 10 * second * S)
    made.said(4, "its vehicle says (warning): low battery", EPOCH)
    text = "its vehicle says (warning): low battery"
    assert made.sentences(3.0) == [f"3.0 s: robot 3: {text}", f"3.0 s: robot 4: {text}"]
    made.said(3, text, EPOCH + 40 * S + AGAIN_NS + 1)
    assert made.sentences(80.0) == [f"80.0 s: robot 3: {text}"]


def test_orders_are_told_once_with_what_they_change() -> None:
    made = news()
    made.order(Mission(1, EPOCH, EPOCH, 60 * S, ""))
    made.order(Mission(2, EPOCH, EPOCH, 60 * S, "", note="robot 4 leaves"))
    made.order(Stop(3, EPOCH, "a person"))
    made.order(Stop(4, EPOCH, ""))
    made.order(Resume(5, EPOCH, ()))
    made.order(Resume(6, EPOCH, (2, 3)))
    assert made.sentences(8.24) == [
        "8.2 s: robot 4 leaves",
        "8.2 s: every robot is told to stop: a person",
        "8.2 s: every robot is told to stop",
        "8.2 s: all robots may drive again",
        "8.2 s: robots 2 and 3 may drive again",
    ]
    assert made.sentences(8.5) == []


def test_robots_that_join_and_leave() -> None:
    made = news((7, "standby"), (2, "ready"))
    made.state(2, "running", "")
    made.state(7, "waiting", "for robot 2")
    made.state(7, "ready", "")
    assert made.sentences(5.0) == []
    made.state(7, "running", "")
    assert made.sentences(5.1) == ["5.1 s: robot 7 is running"]
    made.state(2, "standby", "it has left the formation")
    assert made.sentences(9.0) == ["9.0 s: robot 2 is in standby: it has left the formation"]


def test_robots_in_trouble_are_told_together_and_once() -> None:
    made = news((1, "ready"), (2, "ready"), (3, "ready"))
    for robot in (3, 1):
        made.state(robot, "degraded", "without robot 2")
        made.state(robot, "degraded", "without robot 2 (0.5 s)")
    made.state(2, "fault", "plant silent")
    assert made.sentences(7.0) == [
        "7.0 s: robots 1 and 3 are degraded: without robot 2",
        "7.0 s: robot 2 is in fault: plant silent",
    ]
    made.state(2, "waiting", "for its plant")
    made.state(2, "ready", "")
    assert made.sentences(8.0) == []
    for robot in (1, 2, 3):
        made.state(robot, "running", "")
    assert made.sentences(9.0) == ["9.0 s: robots 1, 2 and 3 are back: running"]


def test_an_agent_that_started_again_in_mid_drive() -> None:
    made = news((1, "ready"))
    made.state(1, "running", "")
    made.sentences(1.0)
    made.state(1, "waiting", "for its plant")
    assert made.sentences(3.0) == ["3.0 s: robot 1 is waiting: for its plant"]
    made.state(1, "running", "")
    assert made.sentences(3.5) == ["3.5 s: robot 1 is back: running"]


def test_a_stop_in_mid_drive_and_its_end() -> None:
    made = news((1, "ready"))
    made.state(1, "running", "")
    made.state(1, "stopping", "stop")
    assert made.sentences(3.0) == []
    made.state(1, "stopped", "stop: a person")
    assert made.sentences(3.5) == ["3.5 s: robot 1 is stopped: stop: a person"]
    made.state(1, "running", "")
    assert made.sentences(9.0) == ["9.0 s: robot 1 is back: running"]


def test_many_changes_at_once_are_counted() -> None:
    made = news()
    for robot in range(1, SENTENCES_MAX + 4):
        made.state(robot, "degraded", "x" * robot)
    said = made.sentences(2.0)
    assert len(said) == SENTENCES_MAX + 1
    assert said[-1] == "2.0 s: and 3 more changes of state"


def test_many_that_are_late_by_as_many_times_are_one_sentence() -> None:
    made = news()
    for robot in range(1, 54):
        made.state(
            robot,
            "holding",
            f"overloaded: this machine ran late by 0.{robot + 10} s: stands until it does not",
        )
    made.state(60, "degraded", "without robot 2")
    assert made.sentences(4.3) == [
        "4.3 s: 53 robots (1-53) are holding: overloaded: this machine ran late by 0.11 to 0.63 s: stands "
        "until it does not",
        "4.3 s: robot 60 is degraded: without robot 2",
    ]


def test_what_happened_is_told_with_its_kind_and_its_robots_once() -> None:
    made = news((1, "ready"), (2, "ready"), (3, "ready"))
    made.order(Stop(3, EPOCH, "a person"))
    made.remark(2, "battery low")
    for robot in (3, 1):
        made.state(robot, "degraded", "without robot 2")
    made.state(2, "fault", "plant silent")
    assert made.happenings(7.0) == [
        Happening(ORDERED, "every robot is told to stop: a person", time_ns=EPOCH),
        Happening(ORDERED, "robot 2: battery low"),
        Happening(CHANGED, "robots 1 and 3 are degraded: without robot 2", (1, 3)),
        Happening(CHANGED, "robot 2 is in fault: plant silent", (2,)),
    ]
    assert made.happenings(7.1) == []
    assert made.sentences(7.1) == []


def test_of_many_changes_the_rest_is_a_happening_of_no_robot() -> None:
    made = news()
    for robot in range(1, SENTENCES_MAX + 3):
        made.state(robot, "degraded", "x" * robot)
    *some, rest = made.happenings(2.0)
    assert [each.robots for each in some] == [(robot,) for robot in range(1, SENTENCES_MAX + 1)]
    assert rest == Happening(CHANGED, "and 2 more changes of state")
