"""Parameters of vehicles on hosts that only seem to be there."""

from __future__ import annotations

import json
import threading
from typing import Any, ClassVar

import pytest
import tomli_w

from agent.fleet.hosts import HostSection
from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from bridges.mavlink.bridge.parameter_setup import Answer, Task
from deploy.console.interrupt import Interrupt
from deploy.hosts import parameters, remote_vehicle
from deploy.hosts.at_rest import Rest
from deploy.hosts.connection import HostError
from deploy.hosts.parameters import carry_out_on_hosts, refusal
from tests.unit.deploy.hosts.test_preflight import tables

SET = Task(("FS_ACTION",), {"FS_ACTION": (0.0, 2.0)}, 1)


class There:
    """A host whose vehicles answer so."""

    answers: ClassVar[dict[str, Any]] = {}
    asked: ClassVar[list[dict[str, Any]]] = []

    def __init__(self, host: HostSection, _robots: int, *, accept_new: bool) -> None:
        self.host, self.gone = host, threading.Event()

    def __enter__(self) -> There:
        return self

    def __exit__(self, *_: object) -> None: ...

    def abort(self) -> None:
        self.gone.set()

    def extend(self, module: object) -> None:
        assert module is remote_vehicle

    def ask(self, what: str, *, timeout_s: float, **asked: Any) -> Any:
        assert what == "in_place_of_bridges"
        assert asked["within_s"] < timeout_s
        self.asked.append(asked)
        answer = self.answers[self.host.name]
        if answer is None:
            assert self.gone.wait(10.0)
            raise HostError("the connection was lost")
        if isinstance(answer, HostError):
            raise answer
        return answer


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> type[There]:
    monkeypatch.setattr("deploy.hosts.jobs.HostConnection", There)
    monkeypatch.setattr(There, "asked", [])
    fine = {str(robot): Answer("", robot, {"FS_ACTION": 2.0})._asdict() for robot in (1, 2, 3)}
    told = {f"rover{robot}": json.dumps(fine) for robot in (1, 2, 3)}
    monkeypatch.setattr(There, "answers", told)
    return There


def fleet() -> Fleet:
    return parse_fleet(tomli_w.dumps(tables()), source="here")


def carried_out(*robots: int, task: Task = SET, interrupt: Interrupt | None = None) -> dict[int, Answer]:
    return carry_out_on_hosts(fleet(), dict.fromkeys(robots, task), "f.toml", interrupt or Interrupt())


def test_each_host_is_asked_for_its_own_vehicles(there: type[There]) -> None:
    assert carried_out(1, 2) == {robot: Answer("", robot, {"FS_ACTION": 2.0}) for robot in (1, 2)}
    assert sorted(asked["robots"] for asked in there.asked) == [[1], [2]]
    assert {asked["module"] for asked in there.asked} == {"bridges.mavlink.bridge.parameter_program"}


def test_of_a_host_that_fails_it_is_said_what_is_not_known(there: type[There]) -> None:
    there.answers["rover2"] = HostError("it cannot be reached")
    there.answers["rover3"] = "{}"
    found = carried_out(1, 2, 3)
    assert found[1].trouble == ""
    assert found[2].lacking == {"FS_ACTION": "may be set or not: rover2: it cannot be reached"}
    assert "makes no sense" in found[3].lacking["FS_ACTION"]
    assert carried_out(2, task=Task(("FS_ACTION",)))[2].trouble == "rover2: it cannot be reached"


def test_a_version_that_has_no_such_program_is_told(there: type[There]) -> None:
    there.answers["rover1"] = HostError("python: No module named bridges.mavlink.bridge.parameter_program")
    trouble = carried_out(1, task=Task(("FS_ACTION",)))[1].trouble
    assert trouble == "rover1: its version of handfast cannot do that: `handfast up f.toml` first"


def test_what_a_host_says_is_fit_to_be_printed(there: type[There]) -> None:
    there.answers["rover1"] = json.dumps({"1": Answer("\x1b[2J", 1)._asdict()})
    assert "\x1b" not in carried_out(1)[1].trouble


def test_ctrl_c_ends_it_and_what_was_begun_is_not_known(there: type[There]) -> None:
    there.answers["rover1"] = None
    interrupt = Interrupt()
    threading.Timer(0.2, lambda: setattr(interrupt, "count", 1)).start()
    assert (
        "may be set or not: rover1: interrupted"
        in carried_out(1, interrupt=interrupt)[1].lacking["FS_ACTION"]
    )


def test_a_fleet_on_a_mission_keeps_its_bridges(monkeypatch: pytest.MonkeyPatch) -> None:
    rest = Rest((), (4,))
    monkeypatch.setattr(parameters, "rest_of", lambda *_: rest)
    assert refusal(fleet(), "f.toml") == ""
    rest = Rest((2, 3), ())
    assert refusal(fleet(), "f.toml") == "robots 2 and 3 are on a mission: `handfast stop f.toml` first"
    rest = Rest((2,), ())
    assert refusal(fleet(), "f.toml") == "robot 2 is on a mission: `handfast stop f.toml` first"
