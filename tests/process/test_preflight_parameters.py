"""Failsafes of a simulated rover behind a real socket, set and set back by the command."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.process.harness import ADDRESS, environment, wait_for

HANDFAST = (sys.executable, "-P", "-m", "deploy.cli")
SIMULATOR = (sys.executable, "-P", "-m", "bridges.mavlink.simulator")


@pytest.fixture
def rover(tmp_path: Path) -> Iterator[tuple[str, ...]]:
    """The words of `handfast preflight` for a fleet in which robot 1 is a rover that is on, disarmed."""
    with (
        open(tmp_path / "said", "wb") as said,
        subprocess.Popen(
            [*SIMULATOR, f"--listen=tcp:{ADDRESS}:0", "--warm"],
            env=environment(), stdin=subprocess.DEVNULL, stderr=said,
        ) as simulator,
    ):  # fmt: skip
        listens = re.compile(r"listens on tcp:.*:(\d+)")
        port = wait_for(lambda: listens.search((tmp_path / "said").read_text()), "the simulator")[1]
        sets = [f"--set=robot.1.mavlink.connection=tcp:{ADDRESS}:{port}"]
        sets += [f"--set=robot.{robot}.plant=unicycle" for robot in range(2, 7)]
        yield (*HANDFAST, "preflight", "rovers", *sets)
        simulator.kill()


def run(words: tuple[str, ...], folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    variables = {**environment(), "XDG_STATE_HOME": str(folder / "state")}
    return subprocess.run(
        [*words, *more], env=variables, capture_output=True, text=True, timeout=60.0, stdin=subprocess.DEVNULL
    )


def test_they_are_set_and_set_back(rover: tuple[str, ...], tmp_path: Path) -> None:
    old = tmp_path / "state/handfast/parameters/rovers/robot-1.json"
    refused = run(rover, tmp_path, "--set-parameters")
    assert (refused.returncode, old.exists()) == (2, False)
    done = run(rover, tmp_path, "--set-parameters", "--yes")
    assert done.returncode == 0, done
    assert "robot 1: set and read back: FS_CRASH_CHECK 1, BATT_FS_LOW_ACT 2" in done.stdout
    assert json.loads(old.read_text())["values"] == {"FS_CRASH_CHECK": 0.0, "BATT_FS_LOW_ACT": 0.0}
    again = run(rover, tmp_path, "--set-parameters", "--yes")
    assert "robot 1: nothing to set" in again.stdout
    looked = json.loads(run(rover, tmp_path, "--json").stdout)
    assert {"FS_CRASH_CHECK", "BATT_FS_LOW_ACT"}.isdisjoint(
        line["name"] for line in looked["robots"][0]["lines"] if line["level"] == "warning"
    )
    back = run(rover, tmp_path, "--restore-parameters", "--yes")
    assert back.returncode == 0, back
    assert "robot 1: set and read back: FS_CRASH_CHECK 0, BATT_FS_LOW_ACT 0" in back.stdout
    assert not old.exists()


def test_at_a_terminal_it_asks_and_ctrl_c_is_no(rover: tuple[str, ...], tmp_path: Path) -> None:
    ours, its = pty.openpty()
    variables = {**environment(), "XDG_STATE_HOME": str(tmp_path / "state")}
    with subprocess.Popen(
        [*rover, "--set-parameters"], env=variables, stdin=its, stdout=its, stderr=its, start_new_session=True
    ) as process:
        said = b""
        while b"to go on: " not in said:
            said += os.read(ours, 4096)
        assert b"FS_CRASH_CHECK" in said
        process.send_signal(2)
        assert process.wait(20.0) == 130
    os.close(ours)
    os.close(its)
    assert not (tmp_path / "state").exists()


PARAM_SET = 23


def sets_a_parameter(data: bytes) -> bool:
    """Whether a PARAM_SET (MAVLink 2) is in it."""
    return any(
        data[at] == 0xFD and data[at + 7 : at + 10] == bytes((PARAM_SET, 0, 0)) for at in range(len(data))
    )


class Cut:
    """A port before a vehicle's; once a PARAM_SET went by to the vehicle, nothing comes back any more.

    Args:
        then: called at that, once.
    """

    def __init__(self, port: int, then: Callable[[], object]) -> None:
        self._then, self._cut, self._to = then, threading.Event(), port
        self._listens = socket.create_server((ADDRESS, 0))
        self.port: int = self._listens.getsockname()[1]
        self._threads = [threading.Thread(target=self._run)]
        self._threads[0].start()

    def _run(self) -> None:
        with suppress(OSError):
            while True:
                peer, _ = self._listens.accept()
                thread = threading.Thread(target=self._joined, args=(peer,))
                self._threads.append(thread)
                thread.start()

    def _joined(self, peer: socket.socket) -> None:
        with peer, socket.create_connection((ADDRESS, self._to)) as vehicle, suppress(OSError):
            while True:
                ready, _, _ = select.select([peer, vehicle], [], [])
                if vehicle in ready:
                    data = vehicle.recv(4096)
                    if not data:
                        return
                    if not self._cut.is_set():
                        peer.sendall(data)
                if peer in ready:
                    data = peer.recv(4096)
                    if not data:
                        return
                    is_set = sets_a_parameter(data) and not self._cut.is_set()
                    if is_set:
                        self._cut.set()
                    vehicle.sendall(data)
                    if is_set:
                        self._then()

    def close(self) -> None:
        """Once the other end is closed."""
        self._listens.shutdown(socket.SHUT_RDWR)
        self._listens.close()
        for thread in self._threads:
            thread.join(10.0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_ended_after_it_was_sent_the_old_value_stays_kept(
    rover: tuple[str, ...], tmp_path: Path, number: signal.Signals
) -> None:
    old = tmp_path / "state/handfast/parameters/rovers/robot-1.json"
    (connection,) = (word for word in rover if "mavlink.connection" in word)
    port = int(connection.rpartition(":")[2])
    sent = threading.Event()
    cut = Cut(port, sent.set)
    words = [word.replace(f":{port}", f":{cut.port}") for word in rover]
    with subprocess.Popen(
        [*words, "--set-parameters", "--yes"],
        env={**environment(), "XDG_STATE_HOME": str(tmp_path / "state")},
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    ) as process:  # fmt: skip
        assert sent.wait(30.0)
        os.killpg(process.pid, number)
        said, _ = process.communicate(timeout=20.0)
    cut.close()
    if number == signal.SIGINT:
        assert process.returncode == 130, said
        assert "NOT DONE: FS_CRASH_CHECK was sent and not read back: it may have it or not" in said
        assert "keeps" not in said
    assert json.loads(old.read_text())["values"]["FS_CRASH_CHECK"] == 0.0
    looked = run(rover, tmp_path)
    assert re.search(
        r"robot 1: values from before --set-parameters on [\d-]+ are kept: --restore-parameters sets them",
        looked.stdout,
    ), looked
    back = run(rover, tmp_path, "--restore-parameters", "--yes")
    assert back.returncode == 0, back
    assert "robot 1: set and read back: FS_CRASH_CHECK 0" in back.stdout
    assert not old.exists()


def test_what_was_changed_by_hand_since_is_left_alone(rover: tuple[str, ...], tmp_path: Path) -> None:
    old = tmp_path / "state/handfast/parameters/rovers/robot-1.json"
    assert run(rover, tmp_path, "--set-parameters", "--yes").returncode == 0
    content = json.loads(old.read_text())
    content["set"]["FS_CRASH_CHECK"] = [2.0]  # as if it had set that, and somebody else 1
    old.write_text(json.dumps(content))
    back = run(rover, tmp_path, "--restore-parameters", "--yes")
    assert back.returncode == 0, back
    assert "robot 1: FS_CRASH_CHECK is 1, changed since by somebody else: left alone" in back.stdout
    assert "robot 1: set and read back: BATT_FS_LOW_ACT 0\n" in back.stdout
    assert not old.exists()
