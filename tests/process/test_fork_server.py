"""The process that forks those of `handfast run`: what it forks is as what is started, and nothing is left
when it, or the command, is killed at any time."""

from __future__ import annotations

import os
import re
import signal
import sys
from pathlib import Path

import pytest

from handfast.deploy.processes.forking import PRELOADING
from tests.process.harness import Command, children, no_trouble_in_logs, running, wait_for

NETWORK = ("--set", "network.base_port=21120")


def drive(folder: Path) -> Command:
    return Command(folder, "run", "pair", "--no-report", "--out", str(folder / "out"), *NETWORK)


def server_of(command: Command) -> int:
    """pid of the fork server of a run, as soon as there is one."""

    def look() -> int:
        found = [pid for pid, text in children(command.process.pid).items() if f"-m {PRELOADING}" in text]
        return found[0] if found else 0

    return wait_for(look, "a fork server", report=command.told)


def assert_gone(folder: Path) -> None:
    """Waits until no process names a file of this run, nor is there any fork server of it."""

    def left() -> list[str]:
        found = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                text = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if str(folder) in text and running(int(path.parent.name)):
                found.append(text)
        return found

    wait_for(lambda: not left(), "no process is left", report=lambda: "\n".join(left()))


def test_processes_are_forked_and_seen_as_if_they_were_started(tmp_path: Path) -> None:
    with drive(tmp_path) as command:
        command.wait_until_driving()
        server = server_of(command)
        forked = children(server)
        assert len(forked) == 4
        fleet = tmp_path / "out" / "fleet.toml"
        for role in ("agent", "plant"):
            pid = command.child(2, role)
            words = Path(f"/proc/{pid}/cmdline").read_text().rstrip("\0").split("\0")
            assert words[:8] == [
                sys.executable,
                "-P",
                "-m",
                f"handfast.{role}",
                "--fleet",
                str(fleet),
                "--robot",
                "2",
            ]
            assert words[-1] == "--exit-with-parent"
            assert os.getpgid(pid) == pid, "a Ctrl-C is not for it"
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130
        assert not running(server)
        assert not any(map(running, forked))
    no_trouble_in_logs(tmp_path / "out")


@pytest.mark.long
def test_a_run_whose_fork_server_is_killed_ends(tmp_path: Path) -> None:
    with drive(tmp_path) as command:
        command.wait_until_driving()
        pids = [*command.children()]
        os.kill(server_of(command), signal.SIGKILL)
        assert command.wait() == 1
        ended = r"(Robot \d's \w+|4 processes) ended at \d+\.\d s \(by the end of the fork server\)"
        assert re.search(ended, command.err), command.told()
        assert not any(map(running, pids))
    for log in (tmp_path / "out" / "logs").iterdir():
        assert "ending (the process that started it is gone)" in log.read_text(), log.read_text()


@pytest.mark.long
def test_a_run_whose_fork_server_is_killed_early_starts_what_it_needs(tmp_path: Path) -> None:
    """Before it has forked anything, nothing is lost."""
    with drive(tmp_path) as command:
        os.kill(server_of(command), signal.SIGKILL)
        command.wait_until_driving()
        parents = [
            Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1] for pid in command.seen
        ]
        assert parents == [str(command.process.pid)] * 4
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130
    no_trouble_in_logs(tmp_path / "out")


@pytest.mark.long
@pytest.mark.parametrize("processes", [0, 1, 3])
@pytest.mark.parametrize("which", ["command", "server"])
def test_nothing_is_left_of_a_start_that_is_killed(tmp_path: Path, processes: int, which: str) -> None:
    """Killed as soon as there is a server, the first process, the third."""
    with drive(tmp_path) as command:
        server = server_of(command)
        wait_for(lambda: len(command.children()) >= processes, "the first processes", report=command.told)
        os.kill(command.process.pid if which == "command" else server, signal.SIGKILL)
        if which == "server":
            command.process.send_signal(signal.SIGINT)
            command.process.wait()
        else:
            command.process.wait()
            wait_for(lambda: not running(server), "the server's end")
        assert_gone(tmp_path)
