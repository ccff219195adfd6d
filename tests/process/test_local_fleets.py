"""Fleets that `handfast run` has on this machine, from other terminals: list, status, logs, stop."""

from __future__ import annotations

import json
import re
import secrets
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.runtime.order_store import private_folder
from tests.process.harness import Command, wait_for

CALM = ("fleet.rate_hz=10", "control.wrench_timeout_s=1", "control.plant_timeout_s=1")
"""Commands shall be judged, not the scheduler of a busy machine."""


class Terminals:
    """Two runs of fleets of one name, and other commands beside them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = f"t-{secrets.token_hex(4)}"
        self.runs: list[Command] = []
        self._count = 0

    def run(self, stack: ExitStack) -> None:
        number = len(self.runs)
        settings = (f'fleet.name="{self.name}"', "network.base_port=21120", *CALM)
        words = [word for setting in settings for word in ("--set", setting)]
        folder = self.folder / f"terminal-{number}"
        run = Command(folder, "run", "pair", "--duration", "300", "--out", "out", "--no-report", *words)
        self.runs.append(stack.enter_context(run))

    def command(self, *arguments: str) -> Command:
        self._count += 1
        return Command(self.folder / f"command-{self._count}", *arguments)

    def told(self, *arguments: str, status: int = 0) -> str:
        """What a command prints to its end, and says."""
        with self.command(*arguments) as command:
            assert command.wait() == status, command.told()
            return command.out + command.err

    def listed(self) -> list[dict[str, Any]]:
        """The rows of ours: others' fleets may run here too."""
        with self.command("status", "--json") as command:
            assert command.wait() in (0, 1), command.told()
            fleets = json.loads(command.out)["fleets"]
        return [row for row in fleets if row["fleet"] == self.name]

    def pid(self, number: int) -> str:
        return str(self.runs[number].process.pid)


@pytest.fixture
def terminals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminals]:
    """Both drive."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    found = Terminals(tmp_path)
    with ExitStack() as stack:
        found.run(stack)
        found.run(stack)
        for run in found.runs:
            run.wait_for_line(r"(?m)^ +[\d.]+ s .* all running$")
            run.children()
        yield found


def states(text: str) -> dict[tuple[int, str], tuple[str, str | None]]:
    """Of each process, whether it runs, and the state that its agent tells."""
    return {(row["robot"], row["role"]): (row["unit"], row["state"]) for row in json.loads(text)["processes"]}


def test_two_of_one_name_from_a_third_terminal(terminals: Terminals) -> None:
    first, second = terminals.pid(0), terminals.pid(1)
    rows = terminals.listed()
    assert sorted(row["stop"] for row in rows) == sorted(f"handfast stop {pid}" for pid in (first, second))
    assert {(row["state"], row["hosts"], *row["robots"]) for row in rows} == {("running", None, 1, 2)}

    # Nothing is stopped while it is not known which is meant; what it says instead works.
    refused = terminals.told("stop", terminals.name, status=2)
    assert f"  handfast stop {first}  # " in refused
    assert f"  handfast stop {second}  # " in refused
    assert f"or stop them all: handfast stop {terminals.name} --all\n" in refused
    for command in ("status", "resume", "logs"):
        assert f"  {first}  # " in terminals.told(command, terminals.name, status=2)

    drives = {(robot, "agent"): ("active", "running") for robot in (1, 2)}
    bodies = {(robot, "plant"): ("active", None) for robot in (1, 2)}
    assert states(terminals.told("status", first, "--json")) == drives | bodies
    with terminals.command("logs", first, "--follow", "--robot", "2") as follower:
        wait_for(lambda: "robot 2 agent: running" in follower.out, "the log so far", report=follower.told)
        told = terminals.told("stop", first, "--each")
        assert re.fullmatch(
            r"(robot \d: stop\w+ after \d+ ms, its plant brakes after \d+ ms \([^)]*\)\n){2}", told
        )
        stamped = r"(?m)^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3} robot 2 agent: stop(ping|ped): stop$"
        wait_for(lambda: re.search(stamped, follower.out), "what is said from now on", report=follower.told)
        assert not re.search(r"(?m)^(\S+ \S+ )?robot 1 ", follower.out)
        assert states(terminals.told("status", second, "--json")) == drives | bodies, "the other drives on"

        told = terminals.told("stop", terminals.name, "--all", "--each", "--reason", "lunch")
        assert told.count(f"{terminals.name} (") == 2
        assert len(re.findall(r"  robot \d: stop\w+ after \d+ ms, its plant brakes", told)) == 4
        for number, pid in enumerate((first, second)):
            told = terminals.told("status", pid)
            assert len(re.findall(r"agent +active .* stop(ped|ping) ", told)) == 2, told
            assert f"run by process {pid} since " in told
            assert str(terminals.folder / f"terminal-{number}" / "out") in told

        # Ctrl-C in the first terminal; the follower ends with the run, and has its last words.
        terminals.runs[0].process.send_signal(signal.SIGINT)
        assert terminals.runs[0].wait() == 130
        assert follower.wait() == 0
        assert "robot 2 agent: ending (SIGTERM)\n" in follower.out
    (only,) = terminals.listed()
    assert only["stop"] == f"handfast stop {terminals.name}"


@pytest.mark.long
def test_a_killed_run_is_not_listed_and_a_frozen_one_is_said_to_be(terminals: Terminals) -> None:
    killed, frozen = terminals.runs
    children = list(killed.children())
    killed.process.kill()
    killed.process.wait()
    frozen.process.send_signal(signal.SIGSTOP)
    wait_for(
        lambda: [row["state"][:15] for row in terminals.listed()] == ["running (PAUSED"], "one is paused"
    )
    (row,) = terminals.listed()
    assert row["processes"] == [frozen.process.pid]
    # Its robots drive on by themselves, and are stopped all the same.
    assert "2 of 2 robots brake" in terminals.told("stop", terminals.name)
    assert f"PAUSED: `fg` there or `kill -CONT {frozen.process.pid}`" in terminals.told(
        "status", terminals.name
    )
    assert f'no fleet of the name "{killed.process.pid}"' in terminals.told(
        "stop", str(killed.process.pid), status=2
    )
    frozen.process.send_signal(signal.SIGCONT)
    killed.wait_until_gone(children)


@pytest.mark.long
def test_a_run_whose_entry_and_whose_folder_are_lost(terminals: Terminals) -> None:
    damaged, bare = terminals.runs
    (entry,) = private_folder().glob(f"run-{damaged.process.pid}-*.json")
    entry.write_text("{")
    (row,) = terminals.listed()
    assert row["processes"] == [bare.process.pid]
    said = (
        f"the run of process {damaged.process.pid} cannot be told: {entry} is damaged, or another version's"
    )
    assert said in terminals.told("status", status=1)
    assert said in terminals.told("stop", terminals.name)
    file = terminals.folder / "terminal-1" / "out" / "fleet.toml"
    file.rename(file.with_suffix(".kept"))
    told = terminals.told("stop", terminals.name, status=2)
    assert f"{file}: cannot read the fleet file: no such file or directory" in told
    assert f"`kill -INT {bare.process.pid}`, stops it" in told
    file.with_suffix(".kept").rename(file)
    # What it says works.
    damaged.process.send_signal(signal.SIGINT)
    assert damaged.wait() == 130
    assert damaged.err.count("SIGINT: stopping every robot") == 1
