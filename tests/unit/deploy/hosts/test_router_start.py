"""`handfast up` of a fleet that hosts of its own route, with hosts and robots that only seem to be there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.transport.bus import BusError
from handfast.deploy.commands.hosts.up import _say
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.hosts.bundle import Bundle
from handfast.deploy.hosts.connection import HostError
from handfast.deploy.hosts.jobs import DONE, FAILED
from tests.unit.deploy.hosts.test_up import QUICK, Keys, There, World, bring, ends
from tests.unit.deploy.hosts.two_hosts import WHEELS, fleet

UNIT = "handfast-delta-router.service"
BOTH = ("rover1", "rover2")


class Routed(World):
    """Both hosts have a router.

    Attributes:
        pids: of the routers that run, by host.
        old: hosts whose router runs something else than it should.
        failing: hosts whose router does not start.
        silent: robots that say nothing more once a router has started again.
    """

    def __init__(self) -> None:
        network = {"security": "off", "routers": list(BOTH)}
        addresses = {"rover1": "10.0.0.1", "rover2": "10.0.0.2"}
        super().__init__(
            fleet({name: {"address": each} for name, each in addresses.items()}, network=network)
        )
        self.pids: dict[str, int] = {}
        self.old: set[str] = set()
        self.failing: set[str] = set()
        self.silent: set[int] = set()

    def host(self, host: Any, robots: int, *, accept_new: bool) -> There:
        return WithRouter(self, host)

    def bus(self, *_: object, **__: object) -> World:
        if not self.pids:
            raise BusError("no router answers")
        return self

    @property
    def changes(self) -> list[tuple[str, Any]]:
        return [entry for entry in self.log if entry[0] != "tidy"]


class WithRouter(There):
    """One of the two."""

    world: Routed

    def robots(self, names: Sequence[str]) -> Any:
        return f"router of {self.host.name}" if UNIT in names else super().robots(names)

    def _status(self, fleet: str) -> Any:
        found = super()._status(fleet)
        pid = self.world.pids.get(self.host.name)
        state = "failed" if pid == 0 else "active"
        found["units"] |= {} if pid is None else {UNIT: {"ActiveState": state, "MainPID": str(pid)}}
        return found

    def _compare(self, fleet: str, wanted: dict[str, str]) -> Any:
        found = super()._compare(fleet, {name: text for name, text in wanted.items() if name != UNIT})
        name = self.host.name
        if UNIT in wanted and (name in self.world.old or not self.world.pids.get(name)):
            found["stale"].append(UNIT)
        return found

    def _restart(self, names: list[str]) -> None:
        if UNIT not in names:
            super()._restart(names)
            return
        name = self.host.name
        self._changed("restart", self.robots(names))
        self.world.pids[name] = 0 if name in self.world.failing else self.world.pids.get(name, 100) + 1
        self.world.old.discard(name)
        for robot in self.world.silent:
            self.world.go(robot)

    def _states(self, names: list[str]) -> dict[str, str]:
        return {UNIT: "failed (exit-code)"} if names == [UNIT] else super()._states(names)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Routed:
    there = Routed()
    monkeypatch.setattr("handfast.deploy.session.session.operator_bus", there.bus)
    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", there.host)
    monkeypatch.setattr(
        "handfast.deploy.hosts.setup.bundle_for", lambda _, program: Bundle(Path(), WHEELS, program)
    )
    monkeypatch.setattr("handfast.deploy.hosts.up.program_archive", lambda modules: b"program")
    return there


def test_where_no_router_answers_they_start_before_anything_else(
    world: Routed, capsys: pytest.CaptureFixture[str]
) -> None:
    world.stale = set(world.fleet.ids)
    world.after = dict.fromkeys(world.fleet.ids, "ready")
    work = bring(world)
    for name, robots in (("rover1", [1, 3, 5]), ("rover2", [2, 4, 6])):
        whose = f"router of {name}"
        at = [entry for entry in world.at[name] if entry[0] != "tidy"]
        assert at == [("units", whose), ("restart", whose), ("units", robots), ("restart", robots)]
    first = {whom for _, whom in world.changes[:4]}
    assert first == {"router of rover1", "router of rover2"}, "before any robot"
    assert _say(work, Interrupt()) == 0
    assert capsys.readouterr().out.splitlines()[:2] == ["router 1 on rover1: up", "router 2 on rover2: up"]


def test_one_that_answers_is_enough_to_begin(world: Routed) -> None:
    world.everybody("ready")
    world.pids["rover2"] = 7
    work = bring(world)
    assert ends(work) == {"rover1": (DONE, "up, its router started"), "rover2": (DONE, "up, nothing to do")}
    assert world.changes == [("units", "router of rover1"), ("restart", "router of rover1")]


def test_a_router_that_does_not_start_keeps_no_robot_of_its_host(
    world: Routed, capsys: pytest.CaptureFixture[str]
) -> None:
    world.pids["rover2"] = 7
    world.failing = {"rover1"}
    world.stale, world.after = {1, 3, 5}, dict.fromkeys((1, 3, 5), "ready")
    world.everybody("ready")
    work = bring(world)
    assert ends(work)["rover1"] == (FAILED, "its router is failed (exit-code): it is broken")
    assert world.restarted[-1] == [1, 3, 5]
    assert _say(work, Interrupt()) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "router 1 on rover1: NOT UP"
    assert "robot 1 on rover1: ready" in said


def test_while_the_fleet_drives_routers_start_again_in_their_turns(world: Routed) -> None:
    world.everybody("running")
    world.pids, world.old = dict.fromkeys(BOTH, 7), set(BOTH)
    work = bring(world)
    assert ends(work) == dict.fromkeys(BOTH, (DONE, "up, its router started"))
    whom = [robots for what, robots in world.changes if what == "restart"]
    assert sorted(whom) == ["router of rover1", "router of rover2"]
    assert [what for what, _ in world.changes] == ["units", "restart"] * 2, "one after the other"


def test_robots_that_do_not_drive_again_halt_it(world: Routed) -> None:
    world.everybody("running")
    world.pids, world.old, world.silent = dict.fromkeys(BOTH, 7), set(BOTH), {5}
    world.stale = {2}
    work = bring(world, timing=replace(QUICK, present_s=0.5, idle_s=1000.0))
    found = [entry for entry in world.changes if entry[0] == "restart"]
    assert len(found) == 1, "neither the other router nor a robot"
    assert {state for state, _ in ends(work).values()} == {FAILED}
    steps = [step for _, step in ends(work).values()]
    assert any("did not all drive again after its router had started" in step for step in steps), steps
    assert any("left as before: the router on rover" in step for step in steps), steps


def test_an_authority_that_rules_nobody_yet_asks_all_hosts_before_the_first_router(world: Routed) -> None:
    keys = Keys(["rover2"], is_first=True)
    secured = replace(world.fleet, network=replace(world.fleet.network, routers=("rover1",)))
    world.fleet = secured
    with pytest.raises(BusError, match="rover1: left as it was: another authority rules on rover2"):
        bring(world, keys=keys)
    assert sorted(keys.looked) == ["rover1", "rover2"]
    assert world.log == []


def test_a_connection_that_is_lost_is_said(world: Routed, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(*_: Any, **__: Any) -> None:
        raise HostError("the connection to it was lost")

    monkeypatch.setattr(WithRouter, "_restart", lost)
    with pytest.raises(BusError, match="rover1: the connection to it was lost"):
        bring(world)
