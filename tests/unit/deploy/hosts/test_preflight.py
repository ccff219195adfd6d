"""`handfast preflight` of a fleet on hosts, with bridges and hosts that only seem to be there."""

from __future__ import annotations

import json
import os
import signal
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import CheckLine, Checks
from handfast.agent.transport.bus import BusError
from handfast.deploy.cli import main
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.hosts import preflight
from handfast.deploy.hosts.connection import HostError
from handfast.deploy.hosts.systemd_units import unit_name

OK = CheckLine("link", "ok", "system 1 on /dev/serial0", "")
BLOCKS = CheckLine("type", "blocking", "is a quadrotor (MAV_TYPE 2), not a rover", "")
WAITS = CheckLine("EKF", "blocking", "waiting for its EKF", "")


def tables() -> dict[str, Any]:
    """The bundled rovers, on a host each."""
    raw = tomllib.loads((FLEETS / "rovers.toml").read_text(encoding="utf-8"))
    raw["network"] = {"security": "off"}
    raw["host"] = {f"rover{row['id']}": {"address": f"10.0.0.{row['id']}"} for row in raw["robot"]}
    raw["robot_defaults"]["mavlink"]["connection"] = "/dev/serial0"
    for row in raw["robot"]:
        row["host"] = f"rover{row['id']}"
    return raw


class World:
    """The bus of a fleet, and its hosts.

    Attributes:
        says: by robot, what its bridge says again and again.
        units: by robot, what systemd shows of its bridge; none for those that are not up.
        off: hosts that cannot be reached.
        asked: hosts that were asked.
        hangs: whether hosts take a connection and say nothing.
        published: keys on which anything was said.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet, self.name = fleet, fleet.fleet.name
        self.says: dict[int, tuple[CheckLine, ...]] = dict.fromkeys(fleet.ids, (OK,))
        self.units: dict[int, dict[str, str]] = {}
        self.off: set[str] = set()
        self.asked: list[str] = []
        self.published: list[str] = []
        self.times = 0
        self.hangs = False

    def watch(self, _key: str) -> World:
        return self

    def update(self) -> list[tuple[str, bool]]:
        return []

    def subscribe(self, key: str, _size: int) -> None:
        assert key == key_expressions.checks(self.name, "*")

    def publish(self, key: str, _payload: bytes) -> None:
        self.published.append(key)

    def drain(self) -> Iterator[tuple[str, bytes]]:
        self.times += 1
        for robot, lines in self.says.items():
            yield (
                key_expressions.checks(self.name, robot),
                encode(Checks(robot, self.times, self.times, lines)),
            )

    def close(self) -> None: ...

    def host(self, host: HostSection, _robots: int, *, accept_new: bool) -> There:
        assert not accept_new
        return There(self, host)


class There:
    """One host of the world, as `deploy.hosts.connection.HostConnection` shows it."""

    def __init__(self, world: World, host: HostSection) -> None:
        self.world, self.host, self.gone = world, host, threading.Event()

    def __enter__(self) -> There:
        self.world.asked.append(self.host.name)
        if self.world.hangs:
            assert self.gone.wait(20.0)
            raise HostError("the connection was lost")
        if self.host.name in self.world.off:
            raise HostError("it cannot be reached: no route to host")
        return self

    def __exit__(self, *_: object) -> None: ...

    def abort(self) -> None:
        self.gone.set()

    def ask(self, what: str, *, fleet: str) -> Any:
        assert (what, fleet) == ("status", self.world.name)
        units = {unit_name(fleet, robot, "plant"): about for robot, about in self.world.units.items()}
        return {"units": units}


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> World:
    text = tomli_w.dumps(tables())
    (tmp_path / "six.toml").write_text(text)
    there = World(parse_fleet(text, source="here"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("handfast.deploy.session.session.operator_bus", lambda *_, **__: there)
    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", there.host)
    monkeypatch.setattr(preflight, "QUIET_S", 0.2)
    monkeypatch.setattr(preflight, "TIMEOUT_S", 0.6)
    monkeypatch.setattr(preflight, "BOOT_TIMEOUT_S", 0.6)
    monkeypatch.setattr("handfast.deploy.drive.readiness.SETTLE_NS", 1)
    return there


def test_the_bridges_of_all_hosts_are_one_table_and_nothing_is_said_to_them(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["preflight", "six.toml"]) == 0
    out = capsys.readouterr().out
    assert out == (
        "check  1  2  3  4  5  6\n"
        "link   .  .  .  .  .  .\n"
        ". ok   ! warning   X blocking\n"
        "CLEAR\n"
    )  # fmt: skip
    assert world.published == []
    assert world.asked == [], "no login on a computer whose bridge is heard"


def test_what_blocks_one_is_said_and_is_the_exit_status(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    world.says[2] = (OK, BLOCKS)
    assert main(["preflight", "six.toml"]) == 1
    assert "BLOCKED: robot 2: type" in capsys.readouterr().out
    assert main(["preflight", "six.toml", "--each"]) == 1
    assert capsys.readouterr().out.count("system 1 on /dev/serial0") == 6
    assert main(["preflight", "six.toml", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert [robot["robot"] for robot in told["robots"] if len(robot["lines"]) == 2] == [2]


def test_one_that_waits_is_waited_for(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.says[2] = (OK, WAITS)
    real, begun = world.drain, world.times

    def drain() -> Iterator[tuple[str, bytes]]:
        if world.times > begun + 10:
            world.says[2] = (OK,)
        return real()

    world.drain = drain  # type: ignore[method-assign]
    assert main(["preflight", "six.toml"]) == 0
    assert "CLEAR" in capsys.readouterr().out


def test_a_fleet_that_is_not_up_is_said_to_be(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.says.clear()
    assert main(["preflight", "six.toml"]) == 1
    out = capsys.readouterr().out
    assert "X robots 1, 2, 3, 4, 5 and 6: bridge: is not up on its host (`handfast up six.toml`)" in out
    assert "BLOCKED: robots 1, 2, 3, 4, 5 and 6: bridge" in out
    assert sorted(world.asked) == [f"rover{number}" for number in range(1, 7)]


def test_of_those_that_are_silent_their_hosts_say_why(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    for robot in (2, 3, 4):
        del world.says[robot]
    world.off = {"rover2"}
    world.units = {
        3: {"ActiveState": "active", "Result": "success", "StatusText": "braking: no wrench yet"},
        4: {"ActiveState": "failed", "Result": "exit-code"},
    }
    assert main(["preflight", "six.toml"]) == 1
    out = capsys.readouterr().out
    assert (
        "X robot 2: bridge: its host rover2 cannot be asked: it cannot be reached: no route to host (switch "
        "it on or bring it into reach, then `handfast up six.toml`)"
    ) in out
    assert "X robot 3: bridge: runs on rover3, but is not heard here: braking: no wrench yet (open" in out
    assert (
        "X robot 4: bridge: is failed (exit-code) on rover4 (see `handfast logs six.toml --robot 4`; then "
        "`handfast up six.toml`)"
    ) in out
    assert "BLOCKED: robots 2, 3 and 4: bridge" in out
    assert sorted(world.asked) == ["rover2", "rover3", "rover4"]


def test_without_a_bus_the_hosts_say_why(
    world: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_bus(*_: object, **__: object) -> None:
        raise BusError("no router answers")

    monkeypatch.setattr("handfast.deploy.session.session.operator_bus", no_bus)
    assert main(["preflight", "six.toml"]) == 1
    told = capsys.readouterr()
    assert told.err == "handfast: no router answers\n"
    assert "BLOCKED: robots 1, 2, 3, 4, 5 and 6: bridge" in told.out


def test_ctrl_c_ends_it(world: World) -> None:
    world.says.clear()
    world.hangs = True
    threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    assert main(["preflight", "six.toml"]) == 130


@pytest.mark.parametrize("option", [["--set", "robot.1.mavlink.system=2"], ["--seed", "3"]])
def test_a_fleet_that_robots_have_read_is_not_changed(
    world: World, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["preflight", "six.toml", *option]) == 2
    assert f"{option[0]} changes the fleet file" in capsys.readouterr().err
