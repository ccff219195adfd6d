"""`handfast up`, with hosts and robots that only seem to be there."""

from __future__ import annotations

import threading
import time
from base64 import b64encode
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Resume, Status, Stop
from handfast.deploy.commands.hosts.up import _say
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.drive.preconditions import CAME_UP, GOES_DOWN
from handfast.deploy.hosts.arrivals import Arrivals
from handfast.deploy.hosts.bundle import Bundle
from handfast.deploy.hosts.certificates import AnotherAuthorityError
from handfast.deploy.hosts.connection import Clock, HostError
from handfast.deploy.hosts.jobs import DONE, FAILED, Row
from handfast.deploy.hosts.systemd_units import roles, unit_name
from handfast.deploy.hosts.up import BringUp, Timing
from handfast.deploy.inventory.hosts import hosts_of
from handfast.deploy.inventory.own_orders import OwnOrders
from tests.unit.deploy.hosts.two_hosts import ROOT, WHEELS, fleet

PATIENCE_S = 20.0


class World:
    """The bus of a fleet, and its hosts: rover1 has robots 1, 3 and 5, rover2 has 2, 4 and 6.

    Attributes:
        states: of agents that are there.
        says: what systemd shows of agents, where that is something else.
        stale: robots that do not run as they should.
        after: what becomes of a robot that starts again: the state of its agent, or an error.
        broken: (robot, role) of units that fail.
        kept: by host, what its robots have kept of orders.
        log: what hosts were asked that changes anything.
        at: the same of each host, which work side by side.
        noted: hosts where something was about to change, and what had been there until then.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.name = fleet.fleet.name
        self.states: dict[int, str] = {}
        self.says: dict[int, str] = {}
        self.stale: set[int] = set()
        self.unwanted: list[str] = []
        self.after: dict[int, str | HostError] = {}
        self.broken: set[tuple[int, str]] = set()
        self.kept: dict[str, list[Stop | Resume]] = {}
        self.reasons: list[str] = []
        self.log: list[tuple[str, Any]] = []
        self.at: dict[str, list[tuple[str, Any]]] = {}
        self.noted: list[tuple[str, list[tuple[str, Any]]]] = []
        self.first = threading.Event()
        self.first.set()
        self._changes: deque[tuple[str, bool]] = deque()
        self.stopped = 0

    def come(self, robot: int, state: str) -> None:
        self.states[robot] = state
        self._changes.extend(
            (key_expressions.alive(self.name, robot, role), True) for role in key_expressions.ROLES
        )

    def go(self, robot: int) -> None:
        self.states.pop(robot, None)
        self._changes.extend(
            (key_expressions.alive(self.name, robot, role), False) for role in key_expressions.ROLES
        )

    def everybody(self, state: str) -> None:
        for robot in self.fleet.ids:
            self.come(robot, state)

    @property
    def restarted(self) -> list[list[int]]:
        return [robots for what, robots in self.log if what == "restart"]

    # ------------------------------------------------------------------ as a bus

    def watch(self, _key: str) -> World:
        return self

    def update(self) -> list[tuple[str, bool]]:
        return [self._changes.popleft() for _ in range(len(self._changes))]

    def drain(self) -> Iterator[tuple[str, bytes]]:
        for robot, state in list(self.states.items()):
            said = Status(robot, 1, 1, state, "", "", 0, self.stopped, (), (), (), ())
            yield key_expressions.status(self.name, robot), encode(said)

    def declare(self, _key: str) -> None: ...

    def subscribe(self, _key: str, _size: int) -> None: ...

    def publish(self, key: str, payload: bytes) -> None:
        """Robots obey a stop."""
        if key == key_expressions.stop(self.name):
            stop = decode(payload)
            assert isinstance(stop, Stop)
            self.stopped = stop.version
            self.reasons.append(stop.reason)
            self.states = dict.fromkeys(self.states, "stopped")

    def close(self) -> None: ...

    # ------------------------------------------------------------------ as hosts

    def host(self, host: HostSection, robots: int, *, accept_new: bool) -> There:
        return There(self, host)


class There:
    """One host of the world, as `deploy.hosts.connection.HostConnection` shows it."""

    def __init__(self, world: World, host: HostSection) -> None:
        self.world, self.host = world, host
        about = {"python": [3, 11, 2], "machine": "aarch64", "system": "Linux", "libc": ["glibc", "2.36"]}
        fine = dict.fromkeys(("writable", "systemd", "lingers", "journal"), True)
        self.about = {**about, **fine, "root": ROOT, "user": "pi"}

    def __enter__(self) -> There:
        return self

    def __exit__(self, *_: object) -> None: ...

    def abort(self) -> None: ...

    def clock(self) -> Clock:
        return Clock(0.0, 0.001)

    def exchange(self, what: str, blob: bytes, **_: Any) -> tuple[None, bytes]:
        return None, b""

    def ask(self, what: str, *, answer_bytes: int | None = None, **asked: Any) -> Any:
        return getattr(self, f"_{what}")(**asked)

    def robots(self, names: Sequence[str]) -> list[int]:
        return sorted({int(name.split("-")[3]) for name in names})

    def _installed(self, version: str) -> bool:
        return True

    def _missing(self, paths: object) -> list[str]:
        return []

    def _status(self, fleet: str) -> Any:
        said = self.world.states | self.world.says
        return {
            "units": {
                unit_name(fleet, robot, "agent"): {"ActiveState": "active", "StatusText": state}
                for robot, state in said.items()
            }
        }

    def _compare(self, fleet: str, wanted: dict[str, str]) -> Any:
        if self.host.name != "rover1":
            assert self.world.first.wait(PATIENCE_S)
        stale = [name for name in wanted if int(name.split("-")[3]) in self.world.stale]
        return {"stale": stale, "unwritten": stale, "unwanted": self.world.unwanted, "open": []}

    def _orders(self, fleet: str, most: int) -> list[str]:
        return [b64encode(encode(each)).decode() for each in self.world.kept.get(self.host.name, ())]

    def _changed(self, what: str, whom: Any) -> None:
        self.world.log.append((what, whom))
        self.world.at.setdefault(self.host.name, []).append((what, whom))

    def _units(self, wanted: dict[str, str]) -> None:
        self._changed("units", self.robots(list(wanted)))

    def _remove(self, names: list[str]) -> None:
        self._changed("remove", names)

    def _restart(self, names: list[str]) -> None:
        world = self.world
        self._changed("restart", self.robots(names))
        world.first.set()
        for robot in self.robots(names):
            world.go(robot)
            after = world.after.get(robot, "running")
            if isinstance(after, HostError):
                raise after
            if after == "stopped":  # so was the whole fleet, meanwhile
                world.states = dict.fromkeys(world.states, "stopped")
            if not any((robot, role) in world.broken for role in key_expressions.ROLES):
                world.come(robot, after)

    def _states(self, names: list[str]) -> dict[str, str]:
        broken = {unit_name(self.world.name, *process) for process in self.world.broken}
        return {name: "failed (exit-code)" if name in broken else "active" for name in names}

    def _last_lines(self, name: str, count: int) -> list[str]:
        return ["it is broken"]

    def _tidy(self, keep: list[str]) -> None:
        self._changed("tidy", self.host.name)


class View:
    """Keeps what it was shown."""

    def __init__(self) -> None:
        self.steps: list[str] = []

    def show(self, rows: Sequence[Row]) -> None:
        self.steps += [row.step for row in rows]


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    there = World(fleet({"rover1": {"address": "10.0.0.1"}, "rover2": {}}, network={"security": "off"}))
    monkeypatch.setattr("handfast.deploy.session.session.operator_bus", lambda *_, **__: there)
    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", there.host)
    monkeypatch.setattr(
        "handfast.deploy.hosts.setup.bundle_for", lambda _, program: Bundle(Path(), WHEELS, program)
    )
    monkeypatch.setattr("handfast.deploy.hosts.up.program_archive", lambda modules: b"program")
    return there


@pytest.fixture(autouse=True)
def ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An ssh that knows where rover2 is."""
    (tmp_path / "ssh").write_text("#!/bin/sh\necho hostname 10.0.0.2\n")
    (tmp_path / "ssh").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")


QUICK = Timing(look_s=0.005, listen_s=0.2, units_period_s=0.02, idle_s=0.05, settle_s=0.1)


class Keys:
    """Stands for `deploy.hosts.certificates.HostKeys`.

    Args:
        ruled: hosts whose robots have another authority.
        is_first: whether this machine's has given none a certificate yet.
    """

    def __init__(self, ruled: Sequence[str] = (), *, is_first: bool) -> None:
        self.ruled, self.is_first = ruled, is_first
        self.looked: list[str] = []

    def look(self, connection: There) -> str:
        self.looked.append(connection.host.name)
        if connection.host.name in self.ruled:
            raise AnotherAuthorityError("another one")
        return ""


def bring(
    world: World, view: View | None = None, timing: Timing = QUICK, keys: Keys | None = None
) -> BringUp:
    work = BringUp(
        world.fleet,
        hosts_of(world.fleet, "here"),
        keys,  # type: ignore[arg-type]
        accept_new=False,
        timing=timing,
        before_changes=lambda host: world.noted.append((host, list(world.at.get(host, ())))),
    )
    work.run(view or View(), Interrupt())  # type: ignore[arg-type]
    return work


def ends(work: BringUp) -> dict[str, tuple[str, str]]:
    return {name: (row.state, row.step) for name, row in work.rows.items()}


def test_with_nothing_to_do_it_ends_as_soon_as_all_are_heard(
    world: World,
) -> None:
    world.everybody("ready")
    work = bring(world, timing=replace(QUICK, listen_s=1000.0))
    assert ends(work) == dict.fromkeys(("rover1", "rover2"), (DONE, "up, nothing to do"))
    assert sorted(world.log) == [("tidy", "rover1"), ("tidy", "rover2")]
    assert _say(work, Interrupt()) == 0


def test_while_none_drives_robots_of_a_host_start_together(world: World) -> None:
    world.everybody("ready")
    world.stale, world.unwanted = {1, 3}, ["handfast-delta-robot-9-agent.service"]
    world.after = {1: "ready", 3: "ready"}
    work = bring(world)
    assert ends(work)["rover1"] == (DONE, "up, robots 1 and 3 started")
    assert ("rover1", []) in world.noted, "before anything changes there"
    at_rover1 = [entry for entry in world.log if entry[0] in ("units", "restart")]
    assert at_rover1 == [("units", [1, 3]), ("restart", [1, 3])]
    assert ("remove", tuple(world.unwanted)) in world.log


@pytest.mark.parametrize(
    ("kept", "reason"),
    [
        ([], CAME_UP),
        ([Stop(5, 5, "a person")], "a person"),
        ([Stop(5, 5, "a person"), Stop(7, 7, GOES_DOWN)], "a person"),
        ([Stop(5, 5, "a person"), Resume(6, 6, (3,))], "a person"),
        ([Stop(5, 5, "a person"), Resume(6, 6, ())], CAME_UP),
        ([Stop(5, 5, GOES_DOWN)], CAME_UP),
    ],
)
@pytest.mark.parametrize("host", ["rover1", "rover2"])
def test_a_stop_that_only_robots_remember_holds_with_its_reason(
    world: World, kept: list[Stop | Resume], reason: str, host: str
) -> None:
    """Somebody else gave it, on another computer, and the fleet went down."""
    world.stale = set(world.fleet.ids)
    world.after = dict.fromkeys(world.fleet.ids, "ready")
    world.kept[host] = kept
    bring(world)
    assert world.reasons[-1] == reason


def test_while_they_drive_each_is_written_and_started_in_its_turn(world: World) -> None:
    world.everybody("running")
    world.stale = {1, 3, 5}
    work = bring(world)
    assert ends(work)["rover1"] == (DONE, "up, robots 1, 3 and 5 started")
    changes = [entry for entry in world.log if entry[0] != "tidy"]
    assert changes == [(what, [robot]) for robot in (1, 3, 5) for what in ("units", "restart")]


def test_one_that_does_not_come_back_halts_it_and_the_rest_stay_as_they_are(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    world.everybody("running")
    world.stale, world.broken = {1, 2, 3, 5}, {(1, "agent")}
    world.first.clear()
    work = bring(world)
    assert world.log == [("units", [1]), ("restart", [1])], "nothing of the others changes"
    halted = "robot 1 did not come back"
    assert ends(work) == {
        "rover1": (
            FAILED,
            f"robot 1's agent is failed (exit-code): it is broken; robots 3 and 5 left as before: {halted}",
        ),
        "rover2": (FAILED, f"robot 2 left as before: {halted}"),
    }
    assert _say(work, Interrupt()) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("robot 1 on rover1: NOT UP: robot 1's agent is failed")
    assert said[1] == "robot 3 on rover1: running (left as before)"
    assert "robot 4 on rover2: running" in said


def test_a_host_that_dies_in_its_turn_halts_it(world: World) -> None:
    world.everybody("running")
    world.stale = {1, 2}
    world.after[1] = HostError("the connection to it was lost")
    world.first.clear()
    work = bring(world)
    assert world.restarted == [[1]]
    assert ends(work) == {
        "rover1": (FAILED, "the connection to it was lost"),
        "rover2": (FAILED, "robot 2 left as before: robot 1 did not come back"),
    }


def test_a_stop_during_an_upgrade_does_not_halt_it(world: World) -> None:
    world.everybody("running")
    world.stale = {1, 3}
    world.after = {1: "stopped", 3: "stopped"}
    begun = time.monotonic()
    work = bring(world)
    assert time.monotonic() - begun < Timing().present_s / 2
    assert ends(work)["rover1"] == (DONE, "up, robots 1 and 3 started")


def test_a_robot_that_drives_but_is_not_heard_is_not_touched(world: World) -> None:
    world.says = {3: "degraded: slower"}
    world.stale = {1, 3, 5}
    world.unwanted = ["handfast-delta-robot-9-agent.service"]
    work = bring(world)
    for name in ("rover1", "rover2"):
        state, step = ends(work)[name]
        assert (state, step) == (
            FAILED,
            "left as it was: robot 3 drives, but is not heard here: `handfast stop` first, or open the ports",
        )
    assert world.log == world.noted == []


def test_robots_that_drive_against_the_stop_that_is_known_here_are_told_it_again(world: World) -> None:
    """They were out of its reach, or have new disks."""
    OwnOrders(world.fleet).keep(Stop(7, 7, "a person"))
    world.everybody("running")
    world.stale, world.after = {1}, dict.fromkeys(world.fleet.ids, "stopped")
    work = bring(world)
    assert set(world.states.values()) == {"stopped"}
    assert any("did not know of the stop" in line and "a person" in line for line in work.warnings)
    assert ends(work)["rover1"] == (DONE, "up, robot 1 started")


def test_where_another_authority_rules_nothing_changes(world: World) -> None:
    world.everybody("ready")
    world.stale, world.after = {1, 2}, {1: "ready", 2: "ready"}
    work = bring(world, keys=Keys(["rover2"], is_first=False))
    assert ends(work)["rover2"] == (FAILED, "another one")
    assert ends(work)["rover1"] == (DONE, "up, robot 1 started")
    assert world.restarted == [[1]]


def test_an_authority_that_rules_nobody_yet_asks_all_hosts_before_it_begins(world: World) -> None:
    """Else a second operator's would get those hosts that have none, and the fleet would have two."""
    world.everybody("ready")
    world.stale = {1, 2}
    keys = Keys(["rover2"], is_first=True)
    work = bring(world, keys=keys)
    assert ends(work) == {
        "rover1": (FAILED, "left as it was: another authority rules on rover2"),
        "rover2": (FAILED, "another one"),
    }
    assert sorted(keys.looked) == ["rover1", "rover2"]
    assert world.log == []


def test_a_host_that_cannot_be_asked_keeps_the_others_not_for_good(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = There.__enter__

    def enter(there: There) -> There:
        if there.host.name == "rover2":
            raise HostError("it does not answer")
        return real(there)

    monkeypatch.setattr(There, "__enter__", enter)
    world.everybody("ready")
    work = bring(world, keys=Keys(is_first=True))
    assert ends(work) == {"rover1": (DONE, "up, nothing to do"), "rover2": (FAILED, "it does not answer")}


def test_without_having_listened_nothing_is_touched(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.everybody("ready")
    world.stale = {1}
    monkeypatch.setattr(threading.Event, "wait", lambda *_: False)
    work = bring(world)
    assert ends(work)["rover1"][1].startswith("left as it was: this machine is too busy to hear")
    assert world.log == []


def test_robots_of_a_host_are_waited_for_together(world: World) -> None:
    view = View()
    work = bring(world, view, replace(QUICK, present_s=0.3))
    assert "waiting for robots 1, 3 and 5 on the bus" in view.steps
    assert ends(work)["rover1"] == (
        FAILED,
        "robots 1, 3 and 5: running there, but not heard here: is the port open (tcp/10.0.0.1:7600 and so "
        "on)?",
    )


def test_what_is_wrong_beside_robots_that_are_up_is_a_warning(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise HostError("the connection to it was lost")

    monkeypatch.setattr(There, "_tidy", fails)
    world.everybody("ready")
    world.stale, world.broken, world.after = {1}, {(1, "recorder")}, {1: "ready"}
    assert "recorder" in roles(world.fleet)
    work = bring(world)
    assert ends(work)["rover1"] == (DONE, "up, robot 1 started")
    lost = "versions that nothing needs may still be there: the connection to it was lost"
    assert set(work.warnings) == {
        "rover1: robot 1's recorder is failed (exit-code): it is broken",
        f"rover1: {lost}",
        f"rover2: {lost}",
    }


def test_a_robot_that_is_gone_at_the_end_is_not_up(
    world: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(There, "_tidy", lambda there, keep: there.world.go(1))
    world.everybody("ready")
    work = bring(world)
    gone = "robot 1 came and went again: `handfast logs` says why"
    assert ends(work) == {"rover1": (FAILED, gone), "rover2": (DONE, "up, nothing to do")}
    assert _say(work, Interrupt()) == 1
    assert f"robot 1 on rover1: NOT UP: {gone}" in capsys.readouterr().out


def test_who_goes_and_comes_between_two_looks_has_come_later(world: World) -> None:
    with Arrivals(world.fleet) as arrivals:
        world.come(1, "running")
        arrivals.look()
        since = {"agent": time.monotonic()}
        assert arrivals.is_here(1, {})
        assert not arrivals.is_here(1, since)
        world.go(1)
        world.come(1, "ready")
        arrivals.look()
        assert arrivals.is_here(1, since)
        assert arrivals.says(1) == "ready"
