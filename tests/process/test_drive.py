"""`handfast drive`: a fleet whose agents and plants others have started, driven as `run` drives its own."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Stop
from handfast.deploy.commands.running.drive import ROBOTS_FILE
from handfast.deploy.drive.preconditions import OVER
from handfast.deploy.inventory.known_fleets import find
from handfast.deploy.inventory.registry import running
from handfast.deploy.recording.mcap_reader import read_run
from tests.process.fleet_harness import Robots, all_ready
from tests.process.harness import Command, environment, no_trouble_in_logs
from tests.process.small_fleets import triangle

SLOW = ("fleet.rate_hz=25", "control.wrench_timeout_s=0.5", "control.plant_timeout_s=0.5")
"""Robots shall be judged, not the scheduler of a busy machine."""


@contextmanager
def fleet_up(folder: Path) -> Iterator[Robots]:
    with all_ready(triangle(*SLOW), folder / "r") as fleet:
        yield fleet
        assert not fleet.died()
        no_trouble_in_logs(fleet.folder)


@contextmanager
def drive(fleet: Robots, *arguments: str) -> Iterator[tuple[Command, Path]]:
    """`handfast drive` that records into the folder, under way."""
    with fleet.command("drive", "--out", "out", "--no-report", *arguments) as command:
        command.wait_for_line(r"(?m)^ +[1-9]\.\d s ")
        yield command, command.out_file.parent / "out"


def end(fleet: Robots, command: Command) -> int:
    fleet.wait(lambda: command.process.poll() is not None, "the end of the drive")
    return command.wait()


def complete(folder: Path) -> dict[str, object]:
    """The metrics of a drive whose folder is complete."""
    assert {path.name for path in folder.iterdir()} == {
        "events.txt",
        "fleet.toml",
        ROBOTS_FILE,
        "run.mcap",
        "metrics.json",
    }
    assert not read_run(folder).foreign
    metrics: dict[str, object] = json.loads((folder / "metrics.json").read_text())
    return metrics


def order_driven(fleet: Robots) -> Stop:
    """The stop that the fleet knew last."""
    stops = fleet.orders(Stop)
    assert stops
    found = max(stops, key=lambda each: each.version)
    assert isinstance(found, Stop)
    return found


def test_one_drive_after_another(tmp_path: Path) -> None:
    """The stop at the regular end of one is lifted by the next; in the middle an agent starts again."""
    with fleet_up(tmp_path) as fleet:
        orders = tmp_path / "orders.toml"
        orders.write_text('[[order]]\nat = 1\nkind = "reshape"\nscale = 1.1\n')
        with drive(fleet, "--duration", "12", "--orders", str(orders)) as (command, folder):
            # Commands find it by its name, and robots take their orders: by the file that they read.
            (run,) = [each for each in running() if each.name == fleet.name]
            assert find(fleet.name).fleet_file == Path(run.fleet_file) == folder.resolve() / ROBOTS_FILE
            assert fleet.told_by("drive")[0] == 2
            fleet.signal(2, "agent", signal.SIGKILL)
            fleet.processes[2, "agent"].wait()
            command.wait_for_line(r"\d s: no connection to robot 2's agent\n")
            fleet.start(2, "agent")
            command.wait_for_line(r"\d s: connected again: robot 2's agent\n")
            fleet.wait_until_all("running")
            assert end(fleet, command) == 0, command.told()
        assert "1.1 times the size" in command.err
        verdict = complete(folder)["verdict"]
        assert isinstance(verdict, dict)
        assert verdict["passed"], verdict
        assert [re.sub(r"[\d.]+ s", "T", line) for line in verdict["warnings"]] == [
            "No connection to robot 2's agent from T to T."
        ]
        assert order_driven(fleet).reason == OVER
        assert not [each for each in running() if each.name == fleet.name]

        # Back to the start and the old size from wherever the first drive ended: 5.6 s on a quiet machine.
        with drive(fleet, "--duration", "10") as (command, folder):
            assert end(fleet, command) == 0, command.told()
        assert "told to stop" not in command.err
        assert not read_run(folder).warnings
        states = [read_run(folder).robots[robot].status.states[-1] for robot in fleet.members]
        assert set(states) <= {"stopping", "stopped"}


def test_a_stop_that_somebody_meant_is_lifted_by_name_only(tmp_path: Path) -> None:
    with fleet_up(tmp_path) as fleet:
        with drive(fleet, "--duration", "60") as (command, folder):
            asked_ns = time.time_ns()
            command.process.send_signal(signal.SIGINT)
            assert end(fleet, command) == 130, command.told()
        assert command.err.count("SIGINT: stopping every robot\n") == 1
        complete(folder)
        fleet.wait(lambda: all(fleet.states()[robot] == "stopped" for robot in fleet.members), "all stand")
        assert order_driven(fleet).reason == "interrupted"
        for robot in fleet.members:
            late_ns = asked_ns + NS_PER_S
            assert not any(m.driving for _, m in fleet.since(late_ns, type(fleet.plant(robot)), robot))

        with fleet.command("drive", "--duration", "4") as command:
            assert end(fleet, command) == 2
        assert re.fullmatch(
            rf"handfast: not started: the robots of {fleet.name} were told to stop at \d\d:\d\d:\d\d: "
            r"interrupted; drive with --resume if they may drive again\n",
            command.err,
        ), command.err
        assert not (command.out_file.parent / "runs").exists()
        assert {fleet.states()[robot] for robot in fleet.members} == {"stopped"}

        with drive(fleet, "--duration", "4", "--resume") as (command, folder):
            said = command.err
            assert end(fleet, command) in (0, 1), command.told()
        assert re.search(r"(?m)^lifting the stop that was given at \d\d:\d\d:\d\d: interrupted$", said)
        recording = read_run(folder)
        # Nobody goes on with the mission of before: leave comes when all have the new one.
        assert recording.epoch_ns is not None
        for robot in fleet.members:
            plant = recording.robots[robot].plant
            assert not plant["driving"][plant.t < -0.05].any()
            assert plant["driving"].any()


@pytest.mark.long
def test_robots_left_to_themselves_drive_to_the_end(tmp_path: Path) -> None:
    with fleet_up(tmp_path) as fleet:
        status, out = fleet.told_by("drive", "--detach", "--duration", "5", "--quiet")
        assert status == 0, out
        assert re.fullmatch(
            rf"{fleet.name} drives until \d\d:\d\d:\d\d; `handfast stop {fleet.fleet_file}` stops it\n", out
        )
        fleet.wait_until_all("running")
        # Nobody is there to tell what starts again; its own agent tells the plant.
        for role in key_expressions.ROLES:
            fleet.signal(3, role, signal.SIGKILL)
            fleet.processes[3, role].wait()
            fleet.start(3, role)
        fleet.wait_until_all("running")
        with fleet.command("drive") as command:
            assert end(fleet, command) == 2
        assert re.match(rf"handfast: not started: {fleet.name} is driving already: a mission .*", command.err)
        fleet.wait_until_all("stopped")
        assert not fleet.orders(Stop)
        # The next needs nobody's leave.
        status, out = fleet.told_by("drive", "--detach", "--duration", "3")
        assert status == 0, out
        fleet.wait_until_all("running")


def test_a_fleet_that_another_drive_has_taken_is_left_alone(tmp_path: Path) -> None:
    """As when two operators begin at once: the later mission holds, and the end of the other stops nobody."""
    with fleet_up(tmp_path) as fleet, drive(fleet, "--duration", "6") as (command, folder):
        period_ns = fleet.fleet.period_ns
        epoch_ns = (time.time_ns() + NS_PER_S) // period_ns * period_ns
        mission = fleet.mission_of(epoch_ns, 30.0)
        fleet.bus.publish(key_expressions.mission(fleet.name), encode(mission))
        assert end(fleet, command) == 1, command.told()
        assert "Another operator has begun another drive, and the robots drive that." in command.out
        fleet.wait_until_all("running")
        assert not fleet.orders(Stop)
        complete(folder)


def test_robots_stop_at_a_ctrl_c_that_also_ends_who_reads(tmp_path: Path) -> None:
    """As of `handfast drive ... 2>&1 | tee log`: nobody is left to be told of the stop."""
    with fleet_up(tmp_path) as fleet:
        reader, writer = os.pipe()
        try:
            command = [sys.executable, "-P", "-m", "handfast.deploy.cli", "drive", str(fleet.fleet_file)]
            process = subprocess.Popen(
                [*command, "--duration", "60", "--out", "out", "--no-report"],
                **dict.fromkeys(("stdout", "stderr"), writer),
                cwd=tmp_path,
                env=environment(),
                start_new_session=True,
            )
        finally:
            os.close(writer)
        try:
            fleet.wait_until_all("running")
        finally:
            os.close(reader)
            process.send_signal(signal.SIGINT)
            fleet.wait(lambda: process.poll() is not None, "the end of the drive")
        fleet.wait_until_all("stopped")
        assert order_driven(fleet).reason == "interrupted"
        complete(tmp_path / "out")
