"""A stop by several ways at once: what is sent, what is waited for, and what is said of ways that fail."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Resume, Status, Stop
from handfast.agent.transport.bus import BusError
from handfast.deploy.analysis.shapes import lattice
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.own_orders import OwnOrders
from handfast.deploy.orders.stop_outcome import PLANT_BRAKES, Stopping
from handfast.deploy.session import stop as stop_module
from handfast.deploy.session.stop import StopSession, stop
from tests.unit.deploy.inventory.test_own_orders import HOSTS
from tests.unit.deploy.orders.order_fleets import square

FLEET = square()


class Through:
    """A way by which all robots brake, but for some; their agents know a later resume first."""

    def __init__(self, but: frozenset[int] = frozenset(), known: int = -1, trouble: str = "") -> None:
        self.sent: list[Stop] = []
        self._but, self._known = but, known
        self.troubles = [trouble] if trouble else []
        self.closed = False

    def send(self, stop: Stop) -> None:
        self.sent.append(stop)

    def collect(self, stopping: Stopping) -> None:
        for robot in FLEET.ids:
            if robot in self._but:
                continue
            version = self.sent[-1].version
            if version <= self._known:
                stopping.found(0, robot, "agent", "running", self._known, "by hand")
                continue
            stopping.found(0, robot, "agent", "stopping", version, "by hand")
            stopping.found(0, robot, "plant", PLANT_BRAKES, version, "by hand")

    busy = False

    def close(self) -> None:
        self.closed = True


class Noting:
    """A bus that only counts what is said."""

    said = 0

    def watch(self, *_: object) -> None: ...

    subscribe = declare = watch

    def publish(self, *_: object) -> None:
        self.said += 1


@pytest.fixture(autouse=True)
def _no_links(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise BusError("its port is in use")

    monkeypatch.setattr(stop_module, "StopSession", fails)
    monkeypatch.setattr(stop_module, "ANSWER_S", 0.1)


def test_one_way_is_enough() -> None:
    dead, way = Through(frozenset(FLEET.ids), trouble="not over ssh to h1: no route"), Through()
    stopping, troubles = stop(FLEET, "a person", [dead, way])
    assert stopping.done
    assert [each.sent for each in (dead, way)] == [[stopping.message]] * 2
    assert stopping.message.reason == "a person"
    assert troubles == ["not over new links: its port is in use", "not over ssh to h1: no route"]
    assert dead.closed
    assert way.closed


def test_no_way_waits_for_a_router_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that stands: it is asked for only while another way has not told that all brake."""
    asked = []

    def opens(_fleet: object, _stopping: Stopping, is_wanted: Callable[[], bool]) -> None:
        while is_wanted():
            asked.append(None)
        raise BusError("no router has answered until it was not wanted any more")

    class Slow(Through):
        looks = 0

        def collect(self, stopping: Stopping) -> None:
            self.looks += 1
            if self.looks > 3:
                super().collect(stopping)

    monkeypatch.setattr(stop_module, "StopSession", opens)
    way = Slow(known=time.time_ns() // 1_000 + 10**9)
    assert stop(FLEET, "", [way])[0].done
    assert len(way.sent) == 2, "a later resume is outdone meanwhile"
    assert len(asked) == 4


def test_what_a_way_tells_as_it_ends_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    class Late(Through):
        """Hears from robots after it was asked what it has, and ends before it is asked again."""

        ends = False

        def collect(self, stopping: Stopping) -> None:
            if self.ends:
                super().collect(stopping)

        @property
        def busy(self) -> bool:  # type: ignore[override]
            self.ends = True
            return False

    monkeypatch.setattr(stop_module, "ANSWER_S", 0.0)
    assert stop(FLEET, "", [Late()])[0].done


def test_who_brakes_and_has_not_kept_it_yet_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class Slow(Through):
        """The agent of robot 3 says that it brakes, and what it has kept only when it was asked often."""

        asked = 0

        def collect(self, stopping: Stopping) -> None:
            super().collect(stopping)
            self.asked += 1
            version = stopping.message.version if self.asked > 5 else 0
            said = Status(3, 1, time.time_ns(), "stopping", "", "stop", 1, version, (), (), (), ())
            stopping.feed(time.time_ns(), key_expressions.status("square", 3), said, "by hand")
            if self.asked > 5:
                stopping.found(0, 3, "plant", PLANT_BRAKES, version, "by hand")

    assert stop(FLEET, "", [Slow(frozenset({3}))])[0].done
    monkeypatch.setattr(stop_module, "WAIT_S", 0.1)
    assert not stop(FLEET, "", [Slow(frozenset({3}))])[0].done


@pytest.mark.parametrize(("robots", "pause_s"), [(4, 0.0), (100, 0.15)])
def test_who_comes_is_told_at_once_and_of_many_some_together(
    robots: int, pause_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their tokens come one after the other: all were told anew for each."""
    fleet = resolved(parse_fleet(lattice("many", robots), source="here"))
    bus = Noting()
    now_s = 100.0
    monkeypatch.setattr(stop_module.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(stop_module, "operator_bus", lambda *_, **__: bus)
    session = StopSession(fleet, Stopping(fleet, 5, ""), lambda: True)
    assert bus.said == 1
    assert not session.is_to_send
    session.alive.add((1, "agent"))
    assert session.is_to_send == (not pause_s)
    now_s += pause_s + 1e-6
    assert session.is_to_send
    session.send()
    assert not session.is_to_send
    session._stopping.outdo(10**6)
    assert session.is_to_send, "another stop is said at once"


def test_who_is_not_reached_is_named() -> None:
    stopping, _ = stop(FLEET, "", [Through(frozenset({3}))])
    assert not stopping.done
    assert [robot for robot in FLEET.ids if not stopping.stands_by(robot)] == [3]
    assert "nothing heard" in stopping.outcome(3)


def test_a_later_resume_is_outdone_by_every_way() -> None:
    way = Through(known=time.time_ns() // 1_000 + 10**9)
    stopping, _ = stop(FLEET, "", [way])
    assert stopping.done
    assert [each.version > way._known for each in way.sent] == [False, True]


def test_what_this_operator_knows_of_is_outdone_though_no_robot_is_heard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a resume that outdid a stop of somebody whose clock was ahead, when the fleet is down."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    fleet = parse_fleet(HOSTS, source="here", overrides=['network.security="off"'])
    now_ns = time.time_ns()
    resume = Resume(now_ns // 1_000 + 3_600 * 10**6, now_ns, ())
    OwnOrders(fleet).keep(resume)
    silent = Through(frozenset(FLEET.ids))
    stopping, _ = stop(fleet, "X", [silent])
    assert stopping.message.version == resume.version + 1
    assert silent.sent[-1] == stopping.message
    assert stopping.message in OwnOrders(fleet).orders


def test_without_any_other_way_what_is_wrong_is_raised() -> None:
    with pytest.raises(BusError, match="in use"):
        stop(FLEET, "")


def test_who_has_no_certificate_and_reaches_nobody_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise InputError("operator anna has no certificate")

    monkeypatch.setattr(stop_module, "StopSession", fails)
    with pytest.raises(InputError, match="anna"):
        stop(FLEET, "", [Through(frozenset(FLEET.ids))])
    assert stop(FLEET, "", [Through()])[0].done
