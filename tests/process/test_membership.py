"""Orders to a fleet that drives, from other processes: nobody in the middle, and one mission everywhere."""

from __future__ import annotations

import json
import re
import secrets
import signal
import time
from pathlib import Path

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Ask, Beacon, Mission, Status
from handfast.deploy.recording.mcap_reader import read_run
from tests.process.fleet_harness import Robots, all_ready
from tests.process.harness import BUSY, Command, measured, no_trouble_in_logs, wait_for
from tests.process.small_fleets import triangle

NETWORK = ("--set", "network.base_port=21120")
REST_MPS = 0.06
ASK_S = 0.2


def ordered(folder: Path, *arguments: str) -> str:
    """A `handfast` command for a run, to its end, which must be well; what it printed."""
    with Command(folder / secrets.token_hex(4), *arguments) as command:
        assert command.wait() == 0, command.told()
        return command.out


def agreed(fleet: Robots) -> Mission:
    """The one mission that all agents end up with, whoever has been overruled."""

    def look() -> bool:
        newest = max(fleet.versions())
        return fleet.versions() == {newest} and len(fleet.states()) == len(fleet.fleet.ids)

    fleet.wait(look, "one version everywhere")
    version = max(fleet.versions())
    due_s = 0.0

    def said() -> list[Mission]:
        nonlocal due_s
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + ASK_S
            fleet.bus.publish(key_expressions.ask(fleet.name), encode(Ask(time.time_ns(), "a test")))
        return [mission for mission in fleet.orders(Mission) if mission.version == version]

    missions = fleet.wait(said, "a robot says it again")
    assert len(set(missions)) == 1, missions
    return missions[0]


@pytest.mark.alone  # beside others the machine may run late, and a fleet stands as long as it does
def test_orders_to_a_run_from_other_processes(tmp_path: Path) -> None:
    """All four kinds, one after another, while `handfast run` drives; oracles and verdict are fine."""
    name = f"t-{secrets.token_hex(4)}"
    arguments = ("run", "reserve", "--set", f"fleet.name={name}", "--duration", "44", "--out", "out")
    with Command(tmp_path, *arguments, "--no-report", *NETWORK, *BUSY) as run:
        run.wait_for_line(r"(?m)^ +[2-9]\.\d s ")
        run.children()
        for order in (
            ("join", name, "--robot", "7", "--edges", "4,5"),
            ("reshape", name, "--scale", "1.2"),
            ("leave", name, "--robot", "6"),
            ("replace", name, "--robot", "1", "--by", "6"),
        ):
            out = ordered(tmp_path, "change", *order)
            assert "\n7 of 7 acknowledged\n" in out, out
        assert run.wait(90.0) == 0, run.told()
    folder = tmp_path / "out"
    no_trouble_in_logs(folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["verdict"]["passed"], metrics["verdict"]
    checked = {oracle for oracle, found in metrics["oracles"].items() if found["checked"]}
    assert {"separation", "limits", "recovery"} <= checked, metrics["oracles"]
    recording = read_run(folder)
    versions = sorted({mission.version for mission in recording.missions})
    assert len(versions) == 5
    last = {robot.id: robot.status for robot in recording.robots.values()}
    assert {int(status.mission_versions[-1]) for status in last.values()} == {versions[-1]}
    states = {
        robot: "running" if reason.startswith("overloaded: ") else state
        for robot, status in last.items()
        if (known := status.at(43.0)) is not None
        for state, reason in [known]
    }
    assert states == dict.fromkeys((2, 3, 4, 5, 6, 7), "running") | {1: "standby"}


def test_a_body_is_removed_and_comes_back(tmp_path: Path) -> None:
    """Only once its robot is silent; nobody tells of it any more, and it is there again when it is heard."""
    with all_ready(triangle(), tmp_path / "r") as fleet:
        fleet.drive()
        with fleet.command("change remove", "--robot", "3") as refused:
            assert refused.wait() == 2, refused.told()
            assert refused.err == (
                "handfast: cannot be done: the agent of robot 3 is heard: only the body of one whose "
                "agent is silent can be removed\n"
            )
        for role in key_expressions.ROLES:
            fleet.signal(3, role, signal.SIGKILL)
            fleet.processes[3, role].wait()

        def telling() -> list[int]:
            """Who has told last of robot 3 as silent."""
            last = {robot: [*fleet.said(Beacon, robot)][-1] for robot in (1, 2, 4)}
            return [robot for robot, beacon in last.items() if 3 in [row.robot for row in beacon.silent]]

        fleet.wait(lambda: telling() == [1, 2, 4], "all tell of the silent one")
        status, out = fleet.told_by("change remove", "--robot", "3")
        assert status == 0, out
        assert out.startswith("robot 3 has been removed: at "), out
        assert "\n3 of 3 acknowledged\n" in out, out
        assert "robot 3: has been removed\n" in out
        fleet.wait(lambda: telling() == [], "nobody tells of it")
        status, out = fleet.told_by("change join", "--robot", "3", "--edges", "1,2")
        assert (status, out) == (2, "")

        started_ns = time.time_ns()
        for role in key_expressions.ROLES:
            fleet.start(3, role)
        fleet.first(started_ns, Status, 3, lambda m: m.state == "standby", "it is back, without a place")
        status, out = fleet.told_by("change join", "--robot", "3", "--edges", "1,2")
        assert status == 0, out
        mission = agreed(fleet)
        assert mission.note == "robot 3 joins (edges to 1 and 2)"
        assert mission.removed == ()
        fleet.wait(lambda: fleet.states()[3] == "running", "it drives again")
        assert not fleet.died()
        no_trouble_in_logs(fleet.folder)


def test_ctrl_c_in_the_middle_of_a_change(tmp_path: Path) -> None:
    """A run that is to end while its formation grows brakes before it ends, and leaves a whole folder."""
    name = f"t-{secrets.token_hex(4)}"
    arguments = (
        "run",
        "reserve",
        "--set",
        f"fleet.name={name}",
        "--duration",
        "60",
        "--out",
        "out",
        *NETWORK,
    )
    with Command(tmp_path, *arguments) as run:
        run.wait_for_line(r"(?m)^ +[2-9]\.\d s ")
        pids = [*run.children()]
        out = ordered(tmp_path, "change", "reshape", name, "--scale", "2", "--over", "20s")
        told = re.search(r"at (\d+\.\d) s, over 20\.0 s", out)
        assert told is not None, out
        at = int(float(told[1])) + 2
        wait_for(
            lambda: (lines := re.findall(r"(?m)^ +(\d+)\.\d s ", run.err)) and int(lines[-1]) >= at,
            "the change is under way",
            report=run.told,
        )
        run.process.send_signal(signal.SIGINT)
        measured("gone, s", run.wait_until_gone(pids))
        assert run.wait() == 130, run.told()
    folder = tmp_path / "out"
    no_trouble_in_logs(folder)
    recording = read_run(folder)
    assert not recording.warnings
    for robot, data in recording.robots.items():
        assert abs(float(data.plant["speed"][-1])) < REST_MPS, f"robot {robot} was not at rest"
        assert not data.plant["driving"][-1]
    assert max(float(data.plant["speed"].max()) for data in recording.robots.values()) > 0.1
    assert all((folder / each).exists() for each in ("metrics.json", "report.html", "trajectories.png"))
