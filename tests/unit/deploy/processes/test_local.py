"""Which processes a fleet on this machine has, and what each is told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.control.hand import Pose
from handfast.agent.control.own_law import Law, Moment
from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.deploy.analysis.shapes import lattice as grid
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.faults.process_actions import Action
from handfast.deploy.processes import local
from handfast.deploy.processes.attributes import YIELDING
from handfast.deploy.processes.local import Processes
from handfast.deploy.processes.placement import Vehicle
from handfast.plant.backend import Plant

POSE = Pose(1.5, -2.0, 0.5, 0.3, 0.1)


class Child:
    """Takes the place of a process: remembers what was done to it."""

    def __init__(
        self,
        robot: int,
        role: str,
        module: str,
        arguments: Sequence[str],
        log: Path,
        server: Any = None,
        name: str = "",
        *,
        for_many: bool = False,
    ) -> None:
        self.for_many = for_many
        self.pid = 0
        self.server = server
        self.robot, self.role, self.module, self.arguments, self.log = robot, role, module, arguments, log
        self.name = name or f"robot {robot}'s {role}"
        self.how: str | None = None
        started.append(self)

    def ended(self) -> str | None:
        return self.how

    def kill(self) -> None:
        self.how = "killed by SIGKILL"

    def wait(self, timeout_s: float) -> bool:
        return True


started: list[Child] = []
ended: list[list[str]] = []


@pytest.fixture(autouse=True)
def no_real_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    started.clear()
    ended.clear()

    def end_all(children: Any, timeout_s: float) -> list[Child]:
        ended.append([child.name for child in children])
        return []

    monkeypatch.setattr(local, "Child", Child)
    monkeypatch.setattr(local, "end_all", end_all)


def mixed() -> Fleet:
    return load_fleet(FLEETS / "pair.toml", [
        "robot.2.plant=mavlink", "robot.2.mavlink.connection=udpin:127.0.0.1:9",
        "datum.latitude_deg=1", "datum.longitude_deg=2",
    ])  # fmt: skip


def running(**options: Any) -> Processes:
    vehicles = [Vehicle(2, ("--system=2",), "tcp:127.0.0.1:9")]
    made = Processes(mixed(), Path("fleet.toml"), Path, vehicles, **options)
    made.start()
    return made


def test_each_robot_has_an_agent_and_a_plant_and_a_simulated_rover_where_it_has_one() -> None:
    made = running()
    assert [(child.robot, child.role, child.module) for child in started] == [
        (2, "vehicle", "handfast.bridges.mavlink.simulator"),
        (1, "agent", "handfast.agent"),
        (1, "plant", "handfast.plant"),
        (2, "agent", "handfast.agent"),
        (2, "plant", "handfast.bridges.mavlink"),
    ]
    assert started[0].arguments == ("--system=2",)
    assert started[4].arguments == ["--fleet", "fleet.toml", "--robot", "2"]
    assert started[0].log == Path("robot-2-vehicle.log")
    assert (2, "vehicle") not in made.names, "it is not on the bus"
    assert list(made.names.values())[3] == "robot 2's plant"


def test_only_those_that_are_wanted_are_started() -> None:
    made = running(processes=[(2, "plant")])
    assert [(child.robot, child.role) for child in started] == [(2, "vehicle"), (2, "plant")]
    assert list(made.names) == [(2, "plant")]


def restart(made: Processes, robot: int) -> Child:
    for what in ("kill", "start"):
        assert made.carry_out(Action(1.0, robot, "plant", what, "rule"), POSE)
    return started[-1]


def test_only_a_simulated_body_is_told_where_to_stand_again() -> None:
    made = running()
    assert restart(made, 1).arguments[-1] == "--pose=1.5,-2.0,0.5"
    again = restart(made, 2)
    assert (again.module, again.arguments) == (
        "handfast.bridges.mavlink",
        ["--fleet", "fleet.toml", "--robot", "2"],
    )
    assert [child.role for child in started].count("vehicle") == 1, "its rover goes on"
    assert made.deaths() == []


def test_the_death_of_a_rover_is_told_once() -> None:
    made = running()
    started[0].how = "exit status 1"
    assert [(child.name, how) for child, how in made.deaths()] == [("robot 2's vehicle", "exit status 1")]
    assert made.deaths() == []


def test_rovers_end_after_their_bridges() -> None:
    running().end(1.0)
    assert [len(names) for names in ended] == [4, 1]
    assert ended[1] == ["robot 2's vehicle"]


def routed(monkeypatch: pytest.MonkeyPatch, answers: list[bool]) -> Processes:
    monkeypatch.setattr(local, "_listens", lambda router: answers.pop(0))
    fleet = load_fleet(FLEETS / "pair.toml", ['network.routers=["127.0.0.1:7001", "127.0.0.1:7002"]'])
    made = Processes(fleet, Path("fleet.toml"), Path)
    made.start()
    return made


def test_routers_listen_before_others_start_and_end_after_them(monkeypatch: pytest.MonkeyPatch) -> None:
    made = routed(monkeypatch, [False, True, False, False, True])
    assert [(child.robot, child.role) for child in started[:3]] == [
        (1, "router"),
        (2, "router"),
        (1, "agent"),
    ]
    assert started[1].module == "handfast.agent.runtime.router"
    assert started[1].arguments == ["--fleet", "fleet.toml", "--number", "2"]
    assert not [process for process in made.names if process[1] == "router"], "no process of a robot's"
    started[1].how = "exit status 1"
    assert [(child.name, how) for child, how in made.deaths()] == [("router 2", "exit status 1")]
    made.end(1.0)
    assert ended[1] == ["router 1", "router 2"]


def test_nobody_waits_for_a_router_that_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Child, "ended", lambda self: "exit status 1")
    routed(monkeypatch, [False, False])
    assert [child.role for child in started].count("agent") == 2


def test_bridges_that_only_look_are_told_so() -> None:
    made = running(processes=[(1, "plant"), (2, "plant")], look=True)
    arguments = {child.robot: child.arguments for child in started if child.role == "plant"}
    assert "--look" not in arguments[1], "a simulated body has nothing to arm"
    assert arguments[2][-1] == "--look"
    assert restart(made, 2).arguments[-1] == "--look"


def test_a_disk_that_is_lost_takes_the_orders_of_its_process_with_it(tmp_path: Path) -> None:
    fleet = load_fleet(FLEETS / "pair.toml")
    files = {(robot, role): tmp_path / f"robot-{robot}-{role}.json" for robot in (1, 2) for role in ROLES}
    for path in files.values():
        path.write_text("{}")
    made = Processes(fleet, tmp_path / "fleet.toml", lambda name: tmp_path / name, orders=tmp_path)
    made.start()
    for robot, wipe in ((1, True), (2, False)):
        for what in ("kill", "start"):
            made.carry_out(Action(1.0, robot, "agent", what, "x", wipe and what == "kill"), POSE)
    assert [process for process, path in files.items() if not path.exists()] == [(1, "agent")]


class Server:
    """Takes the place of a fork server: remembers what was read ahead, and whether robots yield."""

    def __init__(self) -> None:
        self.read: list[Path] = []
        self.yielded = 0

    def yields(self, niceness: int) -> None:
        assert niceness == YIELDING
        self.yielded += 1

    def preload(self, fleet_file: Path) -> None:
        self.read.append(fleet_file)


def test_a_fork_server_reads_the_fleet_file_once_for_all() -> None:
    server: Any = Server()
    made = running(server=server)
    assert restart(made, 1).server is server
    assert {child.server for child in started} == {server}
    assert server.read == [Path("fleet.toml")]
    assert server.yielded == 0


class ForeignLaw(Law):
    """A law of others."""

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class ForeignPlant(Plant):
    """A plant of others."""


@pytest.mark.parametrize("settings", [[], [f"control.law={__name__}:ForeignLaw"]])
def test_robots_that_share_a_router_yield_to_it(settings: list[str]) -> None:
    server: Any = Server()
    fleet = load_fleet(FLEETS / "pair.toml", ["network.topology=routed", *settings])
    Processes(fleet, Path("fleet.toml"), Path, server=server).start()
    assert server.yielded == 1


@pytest.mark.parametrize("settings", [
    [f"control.law={__name__}:ForeignLaw"], [f"robot.2.plant={__name__}:ForeignPlant"],
])  # fmt: skip
def test_a_fork_server_reads_no_fleet_with_plugins(settings: list[str]) -> None:
    """It would run the code of others in the process that the rest is forked from."""
    server: Any = Server()
    Processes(load_fleet(FLEETS / "pair.toml", settings), Path("fleet.toml"), Path, server=server).start()
    assert started
    assert server.read == []


def lattice(n: int, rate_hz: float) -> Fleet:
    fleet = parse_fleet(grid(f"grid{n}", n, rate_hz=rate_hz), source="here")
    network = replace(fleet.network, routers=("127.0.0.1:9000",))  # which placement gives it
    return replace(fleet, network=network)


@pytest.mark.slow
def test_bodies_that_are_asked_for_by_name_share_nothing() -> None:
    Processes(lattice(30, 10.0), Path("fleet.toml"), Path, processes=[(3, "plant"), (4, "plant")]).start()
    assert [child.arguments[2:] for child in started if child.role == "plant"] == [
        ["--robot", "3"], ["--robot", "4"],
    ]  # fmt: skip


@pytest.mark.slow
def test_who_shares_a_process_starts_after_the_agents_and_is_known_by_its_own_name() -> None:
    made = Processes(lattice(26, 10.0), Path("fleet.toml"), Path("/logs").joinpath)
    made.start()
    *agents, pool = (child for child in started if child.role != "router")
    assert [child.role for child in agents] == ["agent"] * 26
    assert pool.arguments == [
        "--fleet", "fleet.toml", "--robot", "1", f"--with={','.join(map(str, range(2, 27)))}", "--logs=/logs",
    ]  # fmt: skip
    assert [child.for_many for child in (*agents, pool)] == [False] * 26 + [True]
    assert (pool.name, pool.log) == ("the plants of 26 robots (1-26)", Path("/logs/robot-1-plant.log"))
    assert made.names[17, "plant"] == "robot 17's plant"
    assert (len(made.names), made.count) == (52, 27)
    assert made.up(17, "plant")
    pool.how = "killed by SIGKILL"
    assert [(child.name, how) for child, how in made.deaths()] == [(pool.name, "killed by SIGKILL")]
    assert not made.up(17, "plant")
    assert made.up(17, "agent")
