"""What is asked of a host about real time, and what its answers mean."""

from __future__ import annotations

import json
from typing import Any

import pytest
import tomli_w

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.runtime.realtime_granted import Granted, to_json
from handfast.deploy.cli import main
from handfast.deploy.drive.readiness import WARNING
from handfast.deploy.hosts.connection import HostError
from handfast.deploy.hosts.preflight import granted_on, lines_on, warnings
from handfast.deploy.hosts.systemd_units import unit_name
from tests.unit.deploy.hosts import test_preflight
from tests.unit.deploy.hosts.test_preflight import There, World, tables

ALL = Granted(41, (0,), (0,), locked=True, rtprio=42, memlock=-1, privileged=False)
REFUSED = Granted(0, (0,), (0,), locked=True, rtprio=0, memlock=-1, privileged=False)
world = test_preflight.world


def fleet() -> Fleet:
    return parse_fleet(tomli_w.dumps(tables() | {"process": {"realtime": True}}), source="here")


def unit(pid: int, state: str = "active", version: str = "1") -> dict[str, str]:
    return {"ActiveState": state, "MainPID": str(pid), "version": version}


class Host:
    """The host of robot 1, whose processes have this."""

    def __init__(self, units: dict[str, dict[str, str]], told: str) -> None:
        self.host, self.units, self.told = HostSection("rover1"), units, told
        self.ran: list[Any] = []

    def ask(self, what: str, **asked: Any) -> Any:
        if what == "status":
            return {"units": {unit_name(fleet().fleet.name, 1, role): u for role, u in self.units.items()}}
        assert what == "run"
        self.ran.append((asked["module"], asked["arguments"], asked["version"]))
        return self.told


def granted(host: Host) -> dict[tuple[int, str], Granted | None]:
    return granted_on(host, fleet())  # type: ignore[arg-type]


def test_processes_are_looked_at_by_the_numbers_that_systemd_has() -> None:
    host = Host({"agent": unit(7), "plant": unit(8)}, f"{to_json(ALL)}\n{to_json(None)}\n")
    assert granted(host) == {(1, "agent"): ALL, (1, "plant"): None}
    assert host.ran == [("handfast.agent.runtime.realtime_granted", ["7", "8"], "1")]


def test_of_those_that_do_not_run_nothing_is_asked() -> None:
    host = Host({"agent": unit(0, "failed", ""), "recorder": unit(9)}, "")
    assert granted(host) == {}
    assert host.ran == []


@pytest.mark.parametrize("told", ["", "7\n", "no JSON", f"{to_json(ALL)}\n{to_json(ALL)}\n"])
def test_an_answer_without_sense_is_one_clear_error(told: str) -> None:
    with pytest.raises(HostError, match="what it says of its processes makes no sense"):
        granted(Host({"agent": unit(7)}, told))


def test_what_up_warns_of_is_what_was_not_granted() -> None:
    good = lines_on(Host({"agent": unit(7)}, to_json(ALL)), fleet())  # type: ignore[arg-type]
    assert warnings(good) == []
    bad = lines_on(Host({"agent": unit(7)}, to_json(REFUSED)), fleet())  # type: ignore[arg-type]
    (warning,) = warnings(bad)
    assert "robot 1: realtime agent: core 0, memory locked; SCHED_FIFO refused: RLIMIT_RTPRIO is 0" in warning
    assert "LimitRTPRIO=42" in warning


def test_preflight_asks_every_host_and_says_which_cannot_be(
    world: World, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ask(self: There, what: str, **asked: Any) -> Any:
        robot = int(self.host.name.removeprefix("rover"))
        if what == "run":
            return to_json(ALL if robot != 2 else REFUSED)
        return {"units": {unit_name(world.name, robot, "agent"): unit(100 + robot)}}

    monkeypatch.setattr(There, "ask", ask)
    with open("six.toml", "a") as file:
        file.write("\n[process]\nrealtime = true\n")
    world.off = {"rover5"}
    assert main(["preflight", "six.toml", "--json"]) == 0, "nothing of it blocks"
    rows = {row["robot"]: row["lines"] for row in json.loads(capsys.readouterr().out)["robots"]}
    said = {robot: [each for each in rows[robot] if each["name"].startswith("realtime")] for robot in rows}
    assert {robot: len(each) for robot, each in said.items()} == dict.fromkeys(range(1, 7), 1)
    assert [robot for robot in said if said[robot][0]["level"] == WARNING] == [2, 5]
    assert said[5][0]["found"].startswith("cannot be looked at: its host rover5 cannot be asked")
    assert main(["preflight", "six.toml"]) == 0
    assert "realtime agent  .  !" in capsys.readouterr().out
