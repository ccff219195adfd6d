"""Faults on real processes: live ones from the command line, and what rules do to agents and plants."""

from __future__ import annotations

import re
import secrets
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import LOST
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.tables import Link, LinkTable
from tests.process.harness import (
    Command,
    measured,
    running,
    wait_for,
)
from tests.process.same_way import assert_same_way

NETWORK = ("--set", "network.base_port=21120")
LEASE_S = 2.0
HEALED = re.compile(r"all running$", re.MULTILINE)
"""Ends a line of a fleet's state when all is well and no fault is live."""
AGREE_M = 0.02
ROUNDS = 275
"""The first 5.5 s of a drive."""


@contextmanager
def running_pair(folder: Path, duration_s: float, *more: str) -> Iterator[tuple[str, Command]]:
    """`handfast run pair` under a name of its own, driving; its folder is `folder` / out."""
    name = f"t-{secrets.token_hex(4)}"
    arguments = ("run", "pair", "--set", f"fleet.name={name}", "--duration", f"{duration_s:g}")
    with Command(folder, *arguments, "--out", str(folder / "out"), "--no-report", *NETWORK, *more) as command:
        command.wait_for_line("all running")
        command.children()
        yield name, command


def told(folder: Path, *arguments: str) -> tuple[int, str]:
    """A `handfast` command to its end: exit status and standard output."""
    with Command(folder / secrets.token_hex(4), *arguments) as command:
        return command.wait(), command.out


def decided(recording: Recording) -> dict[Link, LinkTable]:
    return dict(recording.links.by_link())


def rule(folder: Path, text: str) -> tuple[str, str]:
    """Options that add a scenario of rules."""
    path = folder / "rules.toml"
    path.write_text(text)
    return "--faults", str(path)


def test_live_faults_reach_the_links_and_heal(tmp_path: Path) -> None:
    """Set and cleared by one operator; those of another who is killed end with their lease."""
    cut = ("--link", "1->2", "--loss", "100%")
    with running_pair(tmp_path / "run", 30) as (name, run):
        status, out = told(tmp_path, "faults", "set", name, *cut, "--name", "first", "--stay")
        assert (status, out) == (0, f"4 of 4 agents and plants of {name} took it\n")
        run.wait_for_line(r"faults: live loss 100% on 1->2 \(")
        status, out = told(tmp_path, "faults", "show", str(tmp_path / "run" / "out"))
        assert status == 0
        assert ", until cleared, held by 4 of 4:\n    first: loss 100% on 1->2 (holds)\n" in out
        status, out = told(tmp_path, "faults", "clear", name)
        cleared_ns = time.time_ns()
        assert status == 0, out
        assert out.startswith("cleared the live faults of ")

        with Command(tmp_path / "second", "faults", "set", name, *cut, "--for", "60s") as second:
            second.wait_for_line(r"held by 4 of 4; \d+\.\d s left")
            for _ in range(3):  # it goes on holding while others ask
                status, out = told(tmp_path, "faults", "show", name)
                assert status == 0
                held = r"held by 4 of 4:\n    loss 100% on 1->2 \(holds, 5\d\.\d s left\)"
                assert re.search(held, out), out
            second.process.kill()
            killed_ns, before = time.time_ns(), len(run.err)
        wait_for(lambda: HEALED.search(run.err, before), "a drive without faults", report=run.told)
        assert run.wait() == 0, run.told()
    recording = read_run(tmp_path / "run" / "out")
    links = decided(recording)
    assert list(links) == [Link(1, 2, "hand")]
    rows = links[Link(1, 2, "hand")]
    assert (rows.what & LOST == LOST).all()
    first, second_rows = rows[rows.stamp_ns < cleared_ns], rows[rows.stamp_ns > cleared_ns]
    assert len(first) > 50
    assert len(second_rows) > 50
    healed_s = (int(second_rows.stamp_ns[-1]) - killed_ns) / NS_PER_S
    measured("healed after the author was killed, s", healed_s)
    assert 0.5 < healed_s <= LEASE_S


@pytest.mark.long
def test_ctrl_c_heals(tmp_path: Path) -> None:
    with running_pair(tmp_path / "run", 6) as (name, run):
        with Command(tmp_path / "set", "faults", "set", name, "--robot", "1", "--delay", "40ms") as command:
            command.wait_for_line(r"held by 4 of 4; until Ctrl-C")
            command.process.send_signal(signal.SIGINT)
            asked = time.monotonic()
            assert command.wait() == 0, command.told()
            measured("healed after Ctrl-C, s", time.monotonic() - asked)
            assert "not heard" not in command.err
        status, out = told(tmp_path, "faults", "show", name)
        assert status == 0
        assert out.endswith("live: none\n")
        assert run.wait() == 0, run.told()


def test_a_killed_run_leaves_no_frozen_process(tmp_path: Path) -> None:
    rules = rule(tmp_path, '[[faults.rule]]\nname = "ice"\nrobot = 2\npause = "both"\nat = 0.5\nfor = 100\n')
    with running_pair(tmp_path / "run", 60, *rules) as (_, run):
        run.wait_for_line(r"rule 'ice' paused robot 2's plant")
        pids = list(run.children())
        assert len(pids) == 4
        run.process.kill()
        measured("seconds", run.wait_until_gone(pids))
    assert not any(map(running, pids))


@pytest.mark.alone
def test_run_and_simulate_give_every_message_the_same_fate(tmp_path: Path) -> None:
    faults = (
        *("--set", "faults.loss=20%", "--set", "faults.delay=normal 60ms 30ms"),
        *("--duration", "6", "--seed", "7", "--no-report"),
    )
    folders = [tmp_path / mode for mode in ("run", "simulate")]
    for mode, folder in zip(("run", "simulate"), folders, strict=True):
        with Command(folder, mode, "pair", "--out", str(folder / "out"), *faults, *NETWORK) as command:
            command.wait()
    run, simulation = (read_run(folder / "out") for folder in folders)
    fates = [
        {
            (link, int(number)): (int(what), int(delay_us))
            for link, rows in decided(recording).items()
            for number, what, delay_us in zip(rows.sequence, rows.what, rows.delay_us, strict=True)
            if FIRST_ROUND <= number < FIRST_ROUND + ROUNDS
        }
        for recording in (run, simulation)
    ]
    assert len(fates[1]) == 2 * ROUNDS
    # A busy machine may skip ticks: what was not sent has no fate.
    sent = {
        (robot, FIRST_ROUND + int(time_s * 50 + 1e-3))
        for robot, data in run.robots.items()
        for time_s in data.hand.t
    }
    assert fates[0] == {
        (link, number): fate for (link, number), fate in fates[1].items() if (link.source, number) in sent
    }
    assert len(fates[0]) > ROUNDS, "too few to compare: this machine let the robots run half of the time"
    assert 0.1 < sum(what & LOST for what, _ in fates[0].values()) / len(fates[0]) < 0.3
    assert_same_way(run, simulation, 5.9, AGREE_M)
