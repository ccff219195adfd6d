"""An order of a page goes out at once, and again, until all have done it; what becomes of it is told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import nan
from typing import Any

import pytest

from handfast.agent.fleet.orders import OrderSection
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Ask, Mission, Resume, Stop
from handfast.deploy.drive.preconditions import OVER
from handfast.deploy.orders.stop_outcome import Stopping, again_s
from handfast.deploy.session.session import ANSWER_S
from handfast.deploy.view.orders import (
    ChangeUnderWay,
    RefusedError,
    ResumeUnderWay,
    StopUnderWay,
    UnderWay,
    order_of,
)
from tests.unit.deploy.orders.order_fleets import S, order
from tests.unit.deploy.view.running import FLEET, NAME, Running

ALL = FLEET.ids
TOLD = key_expressions.relayed(NAME, 1)


class Way:
    """A way of a stop that notes what it is asked."""

    def __init__(self, *troubles: str, busy: bool = False) -> None:
        self.sent: list[Stop] = []
        self.troubles: Sequence[str] = troubles
        self.busy = busy
        self.closed = 0

    def send(self, stop: Stop) -> None:
        assert not self.closed
        self.sent.append(stop)

    def collect(self, stopping: Stopping) -> None:
        assert not self.closed

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def running() -> Iterator[Running]:
    with Running() as made:
        made.come()
        made.step()
        yield made


def follow(running: Running, under_way: UnderWay) -> None:
    running.live.listeners.append(under_way.feed)


def step(running: Running, under_way: UnderWay, after_ns: int = S // 20) -> None:
    running.step(after_ns)
    if not under_way.is_over:
        under_way.step(running.clock.ns)


def over_after_s(running: Running, under_way: UnderWay, most_s: float = 30.0) -> float:
    """How long it takes until it is over, when nobody says anything."""
    begun_ns = running.clock.ns
    while not under_way.is_over:
        step(running, under_way)
        assert running.clock.ns - begun_ns < most_s * S
    return (running.clock.ns - begun_ns) / S


# ---------------------------------------------------------------------- stop


def brake(running: Running, version: int, *robots: int, reason: str = "stop") -> None:
    """These robots say that they brake by a stop of that version."""
    for robot in robots:
        running.status(robot, "stopping", reason, order_version=version)
        running.body(robot, driving=False)


def test_a_stop_goes_out_at_once_by_every_way(running: Running) -> None:
    ways = [Way(), Way()]
    stop = StopUnderWay(running.state, "a person", ways)
    (said,) = running.of(Stop)
    assert said == Stop(running.clock.ns // 1_000, running.clock.ns, "a person")
    assert [way.sent for way in ways] == [[said], [said]]
    assert running.state.operator.stop_in_force == said
    assert (stop.what, stop.count, stop.done, stop.is_over) == ("stop: a person", (0, 6), False, False)


def test_a_stop_is_said_again_until_all_brake(running: Running) -> None:
    way = Way()
    stop = StopUnderWay(running.state, "", [way])
    follow(running, stop)
    version = running.of(Stop)[0].version
    pause_ns = round(again_s(FLEET) * S)
    for count in range(2, 6):
        step(running, stop, pause_ns - 1)
        assert len(running.of(Stop)) == count - 1
        step(running, stop, 1)
        assert len(running.of(Stop)) == count
    brake(running, version, *ALL[:-1])
    step(running, stop, pause_ns)
    assert (stop.count, stop.done, stop.is_over, way.closed) == ((5, 6), False, False, 0)
    said = len(running.of(Stop))
    brake(running, version, ALL[-1])
    step(running, stop, pause_ns)
    assert (stop.count, stop.done, stop.is_over, way.closed) == ((6, 6), True, True, 1)
    assert all("stopping after" in line for line in stop.lines())
    assert len(running.of(Stop)) <= said + 1
    assert len(way.sent) == 1  # it has not changed
    assert len({encode(each) for each in running.of(Stop)}) == 1


def test_a_robot_that_drives_by_a_newer_order_is_outdone_at_once(running: Running) -> None:
    way = Way()
    stop = StopUnderWay(running.state, "", [way])
    follow(running, stop)
    version = running.of(Stop)[0].version
    running.status(1, "running", order_version=version + 500)
    step(running, stop, 1)
    later = running.of(Stop)[-1]
    assert later.version == version + 501
    assert way.sent[-1] == later
    assert running.state.operator.order_version == later.version
    brake(running, version, *ALL)
    step(running, stop)
    assert not stop.done
    brake(running, later.version, *ALL)
    step(running, stop)
    assert stop.done


def test_a_stop_is_newer_than_what_is_known_already(running: Running) -> None:
    """Also where this machine's clock is behind that of who gave it."""
    resume = Resume(running.clock.ns // 1_000 + 5_000_000, running.clock.ns, ())
    running.bus.put(key_expressions.resume(NAME), resume)
    running.step()
    StopUnderWay(running.state, "", ())
    assert {each.version for each in running.of(Stop)} == {resume.version + 1}


def test_a_stop_that_nobody_answers_is_over_in_the_end(running: Running) -> None:
    way = Way("not over ssh to h1: no route")
    stop = StopUnderWay(running.state, "", [way])
    assert over_after_s(running, stop) == pytest.approx(ANSWER_S, abs=0.1)
    assert (stop.done, stop.count, way.closed) == (False, (0, 6), 1)
    assert stop.lines()[0] == "robot 1: nothing heard from its agent, nothing heard from its plant"
    assert stop.lines()[-1] == "not over ssh to h1: no route"


def test_a_stop_of_somebody_is_not_taken_for_that_of_a_program(running: Running) -> None:
    StopUnderWay(running.state, OVER, ())
    assert running.of(Stop)[0].reason == f"{OVER}, somebody says"


# ---------------------------------------------------------------------- resume


def stopped(running: Running, before_ns: int) -> Stop:
    """All robots stand by a stop that somebody gave so long ago."""
    stop = Stop((running.clock.ns - before_ns) // 1_000, running.clock.ns - before_ns, "a person")
    running.bus.put(key_expressions.stop(NAME), stop)
    for robot in ALL:
        running.status(robot, "stopped", "stop: a person", order_version=stop.version)
        running.body(robot, driving=False)
    running.step(0)
    return stop


def test_a_resume_is_said_until_all_drive(running: Running) -> None:
    stop = stopped(running, 5 * S)
    resume = ResumeUnderWay(running.state, (), running.clock.ns)
    follow(running, resume)
    (said,) = running.of(Resume)
    assert said.version > stop.version
    assert said.robots == ()
    assert (resume.what, resume.count, resume.done) == ("resume", (0, 6), False)
    for _ in range(10):
        step(running, resume, S // 10)
    assert len(running.of(Resume)) == 4  # each quarter of a second
    for robot in ALL[:4]:
        running.status(robot, "running", order_version=said.version)
        running.body(robot)
    running.status(7, "standby", order_version=said.version)
    running.body(7)
    step(running, resume)
    assert (resume.count, resume.is_over) == ((5, 6), False)
    running.status(8, "standby", order_version=said.version)
    running.body(8)
    step(running, resume)
    assert (resume.count, resume.done, resume.is_over) == ((6, 6), True, True)
    assert running.state.operator.stop_in_force is None


def test_a_resume_of_one_robot_is_for_that_alone(running: Running) -> None:
    stopped(running, 5 * S)
    resume = ResumeUnderWay(running.state, (3,), running.clock.ns)
    assert resume.what == "resume 3"
    assert resume.count == (0, 1)
    assert running.of(Resume)[0].robots == (3,)
    assert over_after_s(running, resume) == pytest.approx(ANSWER_S, abs=0.1)
    assert not resume.done
    assert resume.lines() == ["0 of 1 resumed", "robot 3: nothing heard from its agent"]


# ---------------------------------------------------------------------- changes


def begun(running: Running) -> Mission:
    mission = running.begin(version=7)
    for robot in ALL:
        running.status(robot, "running" if robot < 5 else "standby", mission_version=7)
        running.body(robot, 3.0 * robot)
    running.step()
    return mission


def acknowledge(running: Running, mission: Mission, *robots: int) -> None:
    for robot in robots:
        running.status(robot, "running", mission_version=mission.version)


@pytest.mark.parametrize(
    ("given", "says", "members"),
    [
        (order("leave", robot=4), "robot 4 leaves", {1, 2, 3}),
        (order("join", robot=7, edges=(1, 2)), "robot 7 joins", {1, 2, 3, 4, 7}),
        (order("replace", robot=4, by=8), "robot 8", {1, 2, 3, 8}),
        (order("reshape", scale=1.5), "reshaped: 1.5 times the size", {1, 2, 3, 4}),
    ],
)
def test_a_change_is_said_until_all_have_acknowledged_it(
    running: Running, given: OrderSection, says: str, members: set[int]
) -> None:
    before = begun(running)
    change = ChangeUnderWay(running.state, given)
    follow(running, change)
    (mission,) = running.of(Mission)
    assert mission.version > before.version
    assert {place.robot for place in mission.robots} == members
    assert change.what.startswith(says)
    for _ in range(10):
        acknowledge(running, mission, *ALL[:4])
        step(running, change, S // 10)
    assert (change.count, change.done, change.is_over) == ((4, 6), False, False)
    assert running.of(Mission) == [mission] * 4
    acknowledge(running, mission, *ALL)
    step(running, change)
    assert running.of(Ask)  # another operator's of the same version shows only in what agents say it is
    assert (change.is_over, change.done) == (False, False)
    running.bus.put(TOLD, mission)
    step(running, change)
    assert (change.count, change.done, change.is_over) == ((6, 6), True, True)
    assert change.lines() == ["6 of 6 acknowledged"]


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (order("leave", robot=7), "robot 7"),
        (order("join", robot=3, edges=(1,)), "robot 3"),
        (order("reshape"), "reshape changes nothing"),
    ],
)
def test_what_cannot_be_done_is_refused_and_not_said(running: Running, given: OrderSection, why: str) -> None:
    begun(running)
    with pytest.raises(RefusedError, match=f"cannot be done: .*{why}"):
        ChangeUnderWay(running.state, given)
    assert running.of(Mission) == []


# ---------------------------------------------------------------------- what a page says


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ({"kind": "leave"}, "robot"),
        ({"kind": "leave", "robot": 99}, "robot: "),
        ({"kind": "leave", "robot": "4"}, "robot: "),
        ({"kind": "leave", "robot": 4.5}, "robot: "),
        ({"kind": "leave", "robot": None}, "robot: "),
        ({"kind": "leave", "robot": [4]}, "robot: "),
        ({"kind": "leave", "robot": 10**400}, "robot: "),
        ({"kind": "leave", "robot": 4, "scale": 2}, "scale: "),
        ({"kind": "leave", "robot": 4, "more": {}}, "more: "),
        ({"kind": "reshape", "scale": nan}, "scale: "),
        ({"kind": "reshape", "scale": float("inf")}, "scale: "),
        ({"kind": "reshape", "scale": 10**400}, "scale: "),
        ({"kind": "reshape", "formation": None}, "formation: "),
        ({"kind": "reshape", "formation": {"offsets": [[0, 0], None]}}, "formation.offsets"),
        ({"kind": "reshape", "formation": {"offsets": [[1e300, 0]]}}, "formation.offsets"),
        ({"kind": "join", "robot": 7, "edges": {}}, "edges: "),
        ({"kind": "resume", "robots": [1, 1, "x"]}, "robots"),
        ({"kind": "dance"}, "kind: "),
        ({"kind": None}, "kind: "),
        ({}, "kind"),
    ],
)
def test_what_is_no_order_is_refused_and_why(content: dict[str, Any], why: str) -> None:
    with pytest.raises(RefusedError) as caught:
        order_of(content, ALL)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "order[1]" not in str(caught.value)
    assert len(str(caught.value)) < 500
