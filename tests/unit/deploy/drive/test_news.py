"""Lines about what happens during a drive."""

from __future__ import annotations

from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.deploy.drive.news import AGAIN_NS, CHANGED, ORDERED, Happening, News
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


def test_a_stop_in_mid_drive_and_its_end() -> None:
    made = news((1, "ready"))
    made.state(1, "running", "")
    made.state(1, "stopping", "stop")
    assert made.sentences(3.0) == []
    made.state(1, "stopped", "stop: a person")
    assert made.sentences(3.5) == ["3.5 s: robot 1 is stopped: stop: a person"]
    made.state(1, "running", "")
    assert made.sentences(9.0) == ["9.0 s: robot 1 is back: running"]


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
