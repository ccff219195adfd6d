"""`handfast run` from outside: its folder, its lines, its exit status, and every way to end it."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import socket
import termios
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from handfast.agent.supervision.state_machine import State
from handfast.deploy.recording.mcap_reader import read_run
from tests.process.harness import (
    BUSY,
    Command,
    last_lines,
    measured,
    no_trouble_in_logs,
    running,
    wait_for,
)
from tests.process.same_way import assert_same_way, skipped
from tests.screen import screen_lines

KEYS = {
    "fleet", "law", "seed", "mode", "robots", "edges", "rate_hz", "duration_s", "min_distance_m",
    "settling_time_s", "final_distance_error_m", "final_tracking_error_m", "rms_distance_error_m",
    "messages", "age_of_information_ms", "tick", "verdict",
}  # fmt: skip
MESSAGE_KEYS = {"sent", "received", "lost", "delayed", "duplicated", "corrupted", "rejected"}
FIGURES = ("trajectories.png", "distances.png", "report.html")
DRIVE_S = 20.0
"""It forms in 12; a machine that is slow for some seconds has the rest."""
AGREE_M = 0.02
NETWORK = ("--set", "network.base_port=21120")
"""Where `run` begins to look for ports: clear of what else this machine may be running."""


def read_metrics(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return result


def assert_complete(folder: Path, *, report: bool) -> dict[str, Any]:
    """The folder holds what DESIGN.md promises; returns its metrics."""
    metrics = read_metrics(folder)
    assert set(metrics) >= KEYS
    assert set(metrics["messages"]) >= MESSAGE_KEYS
    assert set(metrics["min_distance_m"]) == {"edge", "any"}
    assert set(metrics["age_of_information_ms"]) == {"p50", "p99", "max"}
    assert set(metrics["tick"]) >= {"p50_us", "p99_us", "overruns"}
    assert set(metrics["verdict"]) >= {"passed", "reasons"}
    assert metrics["mode"] == "run"
    assert (folder / "fleet.toml").stat().st_size > 0
    assert [(folder / name).exists() for name in FIGURES] == [report] * len(FIGURES)
    recording = read_run(folder)
    assert not recording.warnings, "the recording was cut short"
    no_trouble_in_logs(folder)
    return metrics


@pytest.fixture(scope="module")
def delta(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Command, int]:
    """One whole run of the paper's formation: its folder, the command, its exit status."""
    folder = tmp_path_factory.mktemp("delta")
    arguments = ("run", "delta", "--duration", f"{DRIVE_S:g}", "--out", str(folder / "out"), *NETWORK)
    with Command(folder, *arguments, *BUSY) as command:
        command.wait_for_line("alive after")
        command.alive_s = time.monotonic() - command.begun
        assert len(command.children()) == 12
        status = command.wait(DRIVE_S + 30.0)
    return folder / "out", command, status


@pytest.mark.alone
def test_delta_passes_and_leaves_the_whole_folder(delta: tuple[Path, Command, int]) -> None:
    folder, command, status = delta
    metrics = assert_complete(folder, report=True)
    assert status == 0, command.told()
    assert (metrics["verdict"]["passed"], metrics["verdict"]["reasons"]) == (True, [])
    assert (metrics["robots"], metrics["edges"], metrics["duration_s"]) == (6, 9, DRIVE_S)
    assert metrics["min_distance_m"]["edge"] > 0.22
    assert command.out.startswith("PASSED\n")
    assert str(folder / "report.html") in command.out
    png = b"\x89PNG\r\n\x1a\n"
    assert all((folder / name).read_bytes().startswith(png) for name in FIGURES[:2])
    html = (folder / "report.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", html), "the report needs other files"


@pytest.mark.alone
def test_mcap_library_reads_every_message(delta: tuple[Path, Command, int]) -> None:
    folder, _, _ = delta
    count: Counter[str] = Counter()
    with open(folder / "run.mcap", "rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            count[channel.topic] += 1
            json.loads(message.data)
    ticks = DRIVE_S * 25 - len(skipped(read_run(folder)))  # as `BUSY` has it; a busy machine skips some
    for robot in range(1, 7):
        for what in ("hand", "plant/state", "plant/wrench"):
            assert count[f"delta/robot/{robot}/{what}"] >= ticks, count
        assert count[f"delta/robot/{robot}/status"] >= 5 * DRIVE_S, count
    assert count["delta/mission"] >= 1
    assert count["delta/stop"] >= 1


@pytest.mark.alone
def test_it_says_when_all_are_alive(delta: tuple[Path, Command, int]) -> None:
    _, command, _ = delta
    told = re.search(r"^all 12 processes alive after (\d+\.\d+) s$", command.err, re.MULTILINE)
    assert told is not None, command.told()
    measured("alive, s", command.alive_s)
    # The line counts from the first process on, and twelve of them take a while.
    assert 0.1 < float(told[1]) <= command.alive_s


@pytest.mark.alone
def test_no_message_is_lost_on_this_machine(delta: tuple[Path, Command, int]) -> None:
    """Whichever robot wakes first in a tick: every hand state is taken, in its tick or in the next."""
    folder, _, _ = delta
    metrics = read_metrics(folder)
    messages = metrics["messages"]
    assert messages["received"] >= 0.98 * messages["sent"], messages
    # A tick that a busy machine skips has its number all the same: what was not sent is missed by all others.
    assert messages["lost"] <= (metrics["robots"] - 1) * metrics["tick"]["overruns"], metrics
    assert messages["rejected"] == 0, messages


@pytest.mark.alone
def test_run_and_simulate_agree(delta: tuple[Path, Command, int], tmp_path: Path) -> None:
    folder, _, _ = delta
    arguments = ("simulate", "delta", "--duration", f"{DRIVE_S:g}", "--out", "out", "--no-report", *BUSY)
    with Command(tmp_path, *arguments) as command:
        assert command.wait() == 0, command.told()
    assert_same_way(folder, tmp_path / "out", DRIVE_S, AGREE_M)


@pytest.mark.alone
def test_plain_lines_without_a_terminal(delta: tuple[Path, Command, int]) -> None:
    _, command, _ = delta
    assert "\x1b" not in command.out + command.err
    assert "\r" not in command.out + command.err
    lines = command.err.splitlines()
    assert re.fullmatch(r"starting 6 agents and 6 plants on ports \d+ to \d+", lines[0]), lines[0]
    times = [float(line.split()[0]) for line in lines if re.match(r" +\d+\.\d s  ", line)]
    assert [time // 2.0 * 2.0 for time in times] == [2.0 * k for k in range(round(DRIVE_S / 2.0) + 1)], lines
    assert all(
        ("worst edge" in line and "oldest message" in line) or re.match(r"\d+\.\d s: robots? ", line)
        for line in lines[2:]
    ), lines


@pytest.mark.alone
def test_two_runs_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    """The same fleet, the same name, the same wish for ports: own ports and own results all the same."""
    seconds = 5.0
    arguments = ("run", "pair", "--duration", f"{seconds:g}", "--out", "out", "--no-report", *NETWORK)
    with Command(tmp_path / "1", *arguments) as one, Command(tmp_path / "2", *arguments) as two:
        ports = {run.wait_for_line(r"on ports (\d+) to")[1] for run in (one, two)}
        assert len(ports) == 2
        for run in (one, two):
            run.wait_for_line("all 4 processes alive")
        assert len({*one.children(), *two.children()}) == 8
        assert [one.wait(), two.wait()] == [0, 0], one.told() + two.told()
    with Command(tmp_path / "3", *("simulate", *arguments[1:-2])) as simulated:
        assert simulated.wait() == 0, simulated.told()
    for run in ("1", "2"):
        metrics = assert_complete(tmp_path / run / "out", report=False)
        assert metrics["verdict"]["passed"]
        assert_same_way(tmp_path / run / "out", tmp_path / "3" / "out", seconds, AGREE_M)
        assert len(read_run(tmp_path / run / "out").missions) == 1


# ---------------------------------------------------------------------- ways to end it


def drive(folder: Path, fleet: str, *more: str) -> Command:
    arguments = ("run", fleet, "--duration", "60", "--out", str(folder / "out"), *NETWORK, *more)
    return Command(folder, *arguments)


def last_speeds(folder: Path) -> list[float]:
    recording = read_run(folder)
    return [abs(float(robot.plant["speed"][-1])) for robot in recording.robots.values()]


def fastest(folder: Path) -> float:
    recording = read_run(folder)
    return min(float(np.abs(robot.plant["speed"]).max()) for robot in recording.robots.values())


def test_ctrl_c_in_mid_drive(tmp_path: Path) -> None:
    with drive(tmp_path, "delta") as command:
        command.wait_until_driving()
        pids = [*command.children()]
        assert len(pids) == 12
        begun = time.monotonic()
        command.process.send_signal(signal.SIGINT)
        measured("gone, s", command.wait_until_gone(pids))
        assert command.wait() == 130, command.told()
        measured("report there, s", time.monotonic() - begun)
    folder = tmp_path / "out"
    metrics = assert_complete(folder, report=True)
    assert metrics["verdict"]["passed"] is False
    assert any("interrupted" in reason or "stopped" in reason for reason in metrics["verdict"]["reasons"])
    assert command.out.startswith("FAILED\n")
    assert fastest(folder) > 0.1, "they did not drive at all"
    assert max(last_speeds(folder)) < 0.06
    assert "was killed" not in command.err
    for robot in range(1, 7):
        name = f"robot {robot} plant"
        lines = last_lines(folder / "logs" / f"robot-{robot}-plant.log", 3)
        brakes, ends = [line for line in lines if ": missed " not in line][-2:]
        # By the stop, or by its agent, if that has heard of it sooner.
        assert brakes in (f"{name}: braking: stop: interrupted", f"{name}: braking: its agent brakes")
        assert ends == f"{name}: ending (SIGTERM)"


@pytest.fixture
def without_nohup() -> Iterator[None]:
    """What is started hears of a hang-up, also where these tests are to outlive one."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("without_nohup")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=["sigterm", "sighup"])
def test_other_signals_end_a_run_in_order(tmp_path: Path, number: signal.Signals) -> None:
    with drive(tmp_path, "pair", "--no-report") as command:
        command.wait_until_driving()
        pids = [*command.children()]
        command.process.send_signal(number)
        measured("gone, s", command.wait_until_gone(pids))
        assert command.wait() == 130, command.told()
    assert_complete(tmp_path / "out", report=False)
    assert max(last_speeds(tmp_path / "out")) < 0.06


def test_ctrl_c_during_start_up(tmp_path: Path) -> None:
    """From the first line on, whatever it is at: one by one, at moments spread over the start."""
    for k, delay_s in enumerate((0.0, 0.03, 0.1, 0.2, 0.35)):
        with drive(tmp_path / str(k), "pair", "--no-report") as command:
            command.wait_for_line("starting 2 agents")
            at = time.monotonic() + delay_s
            wait_for(lambda at=at, command=command: command.children() and time.monotonic() >= at, "a moment")
            command.process.send_signal(signal.SIGINT)
            assert command.wait() == 130, command.told()
        metrics = assert_complete(tmp_path / str(k) / "out", report=False)
        assert not metrics["verdict"]["passed"]
        assert "was killed" not in command.err, command.told()


@pytest.mark.long
def test_ctrl_c_while_waiting_for_a_robot(tmp_path: Path) -> None:
    """A start that gets nowhere, because an agent hangs, can be left."""
    with drive(tmp_path, "pair", "--no-report") as command:
        command.wait_for_line("starting 2 agents")
        wait_for(lambda: len(command.children()) == 4, "four processes", report=command.told)
        os.kill(command.child(2, "agent"), signal.SIGSTOP)
        wait_for((tmp_path / "out" / "logs" / "robot-1-agent.log").read_text, "robot 1 waits")
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130, command.told()
    assert "all 4 processes alive" not in command.err
    assert not assert_complete(tmp_path / "out", report=False)["verdict"]["passed"]


@pytest.mark.long
def test_ctrl_c_while_a_bridge_connects(tmp_path: Path) -> None:
    """Opening a TCP connection cannot be cut short: the bridge gets the time to let go of it."""
    with socket.create_server(("127.0.0.1", 0), backlog=0) as server, ExitStack() as stack:
        port = server.getsockname()[1]
        for _ in range(3):  # they fill its queue: whoever comes now waits
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(("127.0.0.1", port))
        settings = (
            "robot.1.plant=mavlink", f"robot.1.mavlink.connection=tcp:127.0.0.1:{port}",
            "datum.latitude_deg=48", "datum.longitude_deg=11",
        )  # fmt: skip
        sets = [each for setting in settings for each in ("--set", setting)]
        with drive(tmp_path, "pair", "--no-report", "--no-check", *sets) as command:
            command.wait_for_line("all 4 processes alive")
            command.process.send_signal(signal.SIGINT)
            assert command.wait() == 130, command.told()
    assert "was killed" not in command.err, command.told()


@pytest.mark.long
def test_ctrl_c_while_it_loads(tmp_path: Path) -> None:
    """A third of a second of imports comes before anything else: no traceback from there either."""
    with drive(tmp_path, "pair") as command:
        maps = Path(f"/proc/{command.process.pid}/maps")
        wait_for(lambda: "numpy" in maps.read_text(), "numpy being loaded", report=command.told)
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130, command.told()
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_ctrl_c_before_the_first_line(tmp_path: Path) -> None:
    """Nothing was started yet: the command just ends, without a traceback."""
    with drive(tmp_path, "pair") as command:
        # Its folder is the first that it makes; whatever it imports, it imports before.
        wait_for((tmp_path / "out").exists, "the folder", report=command.told)
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130, command.told()


def test_second_ctrl_c(tmp_path: Path) -> None:
    with drive(tmp_path, "pair", "--no-report") as command:
        command.wait_until_driving()
        pids = [*command.children()]
        for _ in range(2):
            command.process.send_signal(signal.SIGINT)
            time.sleep(0.02)  # two signals at one moment would be one
        measured("gone, s", command.wait_until_gone(pids))
        assert command.wait() == 130, command.told()
    assert_complete(tmp_path / "out", report=False)


@pytest.mark.long
def test_ctrl_c_with_a_frozen_agent(tmp_path: Path) -> None:
    """Who does not listen is killed, and the others still brake."""
    with drive(tmp_path, "pair", "--no-report") as command:
        command.wait_until_driving()
        pids = [*command.children()]
        os.kill(command.child(2, "agent"), signal.SIGSTOP)
        command.process.send_signal(signal.SIGINT)
        measured("gone, s", command.wait_until_gone(pids))
        assert command.wait() == 130, command.told()
    assert "robot 2's agent did not end when asked and was killed" in command.err
    assert_complete(tmp_path / "out", report=False)
    assert max(last_speeds(tmp_path / "out")) < 0.06


def test_run_killed_leaves_no_process(tmp_path: Path) -> None:
    with drive(tmp_path, "pair", "--no-report") as command:
        command.wait_until_driving()
        pids = [*command.children()]
        command.process.kill()
        command.process.wait()
        measured("gone, s", command.wait_until_gone(pids))
    no_trouble_in_logs(tmp_path / "out")
    for log in (tmp_path / "out" / "logs").iterdir():
        assert "ending (the process that started it is gone)" in log.read_text(), log.read_text()
    # What it had recorded until then, up to the last second, is there.
    recording = read_run(tmp_path / "out")
    assert recording.data_end_s > 0.5


@pytest.mark.parametrize("role", ["agent", "plant"])
def test_a_child_that_dies_is_named_and_fails_the_run(tmp_path: Path, role: str) -> None:
    with drive(tmp_path, "pair", "--no-report") as command:
        command.wait_until_driving()
        pids = [*command.children()]
        os.kill(command.child(2, role), signal.SIGKILL)
        told = command.wait_for_line(rf"Robot 2's {role} ended at (\d+\.\d) s \(killed by SIGKILL\)\.")
        command.wait_until_gone(pids)
        assert command.wait() == 1, command.told()
    assert f"    robot 2 {role}: " in command.err[told.end() :], command.told()
    metrics = assert_complete(tmp_path / "out", report=False)
    assert metrics["verdict"]["passed"] is False
    assert told[0] in metrics["verdict"]["reasons"]
    assert told[0] in command.out
    assert max(last_speeds(tmp_path / "out")[:1]) < 0.06


@pytest.mark.long
def test_a_child_that_dies_at_start_is_named(tmp_path: Path) -> None:
    with drive(tmp_path, "pair", "--no-report") as command:
        command.wait_for_line("starting 2 agents")
        wait_for(lambda: len(command.children()) == 4, "four processes", report=command.told)
        os.kill(command.child(1, "plant"), signal.SIGKILL)
        assert command.wait() == 1, command.told()
    assert "Robot 1's plant ended before the start (killed by SIGKILL)." in command.err
    assert not assert_complete(tmp_path / "out", report=False)["verdict"]["passed"]


# ---------------------------------------------------------------------- bad input

BROKEN = """
[fleet]
name = "broken"
colour = "red"
rate_hz = "fast"
[formation]
edges = [[1, 2], [1, 7]]
distance_m = 0.2
safe_distance_m = 0.22
[trajectory]
kind = "hold"
[[robot]]
id = 1
x_m = 0.0
y_m = 0.0
[[robot]]
id = 1
x_m = nan
y_m = 1.0
"""


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("pair", "--out", "taken"), ("taken is not empty", "--out")),
        (("pair", "--out", "file/out"), ("file/out", "Not a directory")),
        (("dalta",), ("dalta", "did you mean delta?")),
        (("broken.toml",), ("broken.toml", "colour", "rate_hz", "[1, 7]", "x_m")),
        (("pair", "--law", "papper"), ("papper", "paper")),
    ],
)
def test_bad_input_is_one_clear_message(
    tmp_path: Path, arguments: tuple[str, ...], says: tuple[str, ...]
) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "notes.txt").write_text("mine")
    (tmp_path / "file").write_text("")
    (tmp_path / "broken.toml").write_text(BROKEN)
    with Command(tmp_path, "run", *arguments) as command:
        assert command.wait() == 2, command.told()
    assert command.out == ""
    assert command.err.startswith("handfast: "), command.err
    for words in says:
        assert words in command.err, command.err
    assert (tmp_path / "taken" / "notes.txt").read_text() == "mine"
    assert [entry.name for entry in (tmp_path / "taken").iterdir()] == ["notes.txt"]
    assert not (tmp_path / "runs").exists()


# ---------------------------------------------------------------------- a terminal


class Screen:
    """The other end of a terminal."""

    def __init__(self) -> None:
        self.master, self.tty = pty.openpty()
        termios.tcsetwinsize(self.tty, (40, 120))
        self.text = ""

    def read(self) -> str:
        while select.select([self.master], [], [], 0)[0]:
            try:
                data = os.read(self.master, 65536)
            except OSError:  # nobody is at the other end any more
                break
            if not data:
                break
            self.text += data.decode(errors="replace")
        return self.text

    def type(self, text: str) -> None:
        os.write(self.master, text.encode())

    def close(self) -> None:
        os.close(self.master)
        os.close(self.tty)


def test_live_view_on_a_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table is there and moves; Ctrl-C typed at it ends the run; the terminal is as it was."""
    monkeypatch.setenv("TERM", "xterm-256color")
    for name in ("NO_COLOR", "COLUMNS", "LINES"):
        monkeypatch.delenv(name, raising=False)
    screen = Screen()
    before = termios.tcgetattr(screen.tty)
    arguments = ("run", "pair", "--duration", "60", "--out", "out", "--no-report", *NETWORK)
    try:
        with Command(tmp_path, *arguments, tty=screen.tty) as command:

            def seen(pattern: str) -> None:
                wait_for(
                    lambda: re.search(pattern, screen.read()),
                    f"{pattern!r} on the terminal",
                    report=lambda: repr(screen.text[-3000:]),
                )

            seen("starting 2 agents and 2 plants")
            seen("off m.*nearest m.*m/s.*why.*worst edge m")
            seen(rf"driving.* 1\.\d of 60 s(?s:.*){State.RUNNING.value}")
            pids = [*command.children()]
            assert len(pids) == 4
            screen.type("\x03")
            measured("gone, s", command.wait_until_gone(pids))
            wait_for(lambda: (screen.read(), command.process.poll())[1] is not None, "its end")
            assert command.process.returncode == 130, screen.text[-3000:]
        text = screen.read()
        assert text.count("\x1b[?25l") >= 1, "the cursor was never hidden: no live view"
        assert text.rfind("\x1b[?25h") > text.rfind("\x1b[?25l"), "the cursor stays hidden"
        assert "\x1b[?1049h" not in text, "the alternate screen would take the verdict with it"
        assert "FAILED" in text[text.rfind("\x1b[?25h") :]
        shown = screen_lines(text, 120)
        starts = [line.split()[0] for line in shown[: shown.index("FAILED")]]
        assert starts == ["starting", "all", "SIGINT:", "drove", "worst", "robot", "1", "2"], shown
        assert termios.tcgetattr(screen.tty) == before
        assert "Traceback" not in text
    finally:
        screen.close()
    assert_complete(tmp_path / "out", report=False)
    assert not any(running(pid) for pid in pids)
    for log in (tmp_path / "out" / "logs").iterdir():  # the keys went to the command alone, which ended them
        assert "ending (SIGTERM)" in log.read_text(), log.read_text()
