"""Whether a fleet is at rest, with hosts and robots that only seem to be there."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.transport.bus import BusError
from handfast.deploy.hosts import at_rest
from handfast.deploy.hosts.at_rest import Rest, rest_of
from handfast.deploy.hosts.connection import HostError
from tests.unit.deploy.hosts.test_up import There, World
from tests.unit.deploy.hosts.two_hosts import fleet


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> World:
    where = {"rover1": {"address": "10.0.0.1"}, "rover2": {"address": "10.0.0.2"}}
    there = World(fleet(where, network={"security": "off"}))
    monkeypatch.setattr("handfast.deploy.session.session.operator_bus", lambda *_, **__: there)
    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", there.host)
    monkeypatch.setattr(at_rest, "LISTEN_S", 0.1)
    return there


def cut_off(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """These hosts do not answer."""
    real = There.__enter__

    def enter(there: There) -> There:
        if there.host.name in names:
            raise HostError("it does not answer")
        return real(there)

    monkeypatch.setattr(There, "__enter__", enter)


def test_robots_that_stand_or_do_not_run_are_at_rest(world: World) -> None:
    assert rest_of(world.fleet, "f.toml") == Rest((), ())
    world.everybody("stopped")
    assert rest_of(world.fleet, "f.toml") == Rest((), ())


def test_who_is_on_a_mission_is_found_on_the_bus_or_by_its_host(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.everybody("ready")
    world.states |= {2: "holding", 3: "running"}
    world.says = {5: "degraded: slower", 1: "ready: for a mission"}
    del world.states[5]
    cut_off(monkeypatch, "rover2")
    assert rest_of(world.fleet, "f.toml") == Rest((2, 3, 5), ())


def test_who_cannot_be_asked_is_unknown(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    cut_off(monkeypatch, "rover2")
    world.come(4, "ready")
    assert rest_of(world.fleet, "f.toml") == Rest((), (2, 6))


def test_without_a_bus_the_hosts_tell(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise BusError("no router answers")

    monkeypatch.setattr("handfast.deploy.session.session.operator_bus", refused)
    world.says = {1: "running", 2: "ready"}
    assert rest_of(world.fleet, "f.toml") == Rest((1,), ())


def test_what_is_said_of_it() -> None:
    assert Rest((), ()).refusal() == ""
    assert Rest((1,), (2,)).refusal().startswith("robot 1 is on a mission: `handfast stop` first")
    assert Rest((1, 2), ()).refusal().startswith("robots 1 and 2 are on a mission")
    said = Rest((), (2, 6)).refusal()
    assert said.startswith("robots 2 and 6 cannot be asked, neither")
    assert all("--force" in each for each in (said, Rest((1,), ()).refusal()))
