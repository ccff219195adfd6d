"""What the processes of a fleet said, from several hosts; with a `ssh` that says what a test has it say."""

from __future__ import annotations

import argparse
import json
import queue
import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import tomli_w

from handfast.agent.fleet.loading import to_dict
from handfast.deploy.cli import main
from handfast.deploy.commands.hosts import logs as logs_command
from handfast.deploy.commands.hosts.logs import Line, Reader
from handfast.deploy.console.arguments import InputError, no_changes
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.inventory import hosts, registry
from handfast.deploy.inventory.registry import Registration
from tests.unit.agent.fleet.test_hosts import HOSTS, ROUTERS, fleet


def reader(host: str, *times_us: int) -> Reader:
    lines = [Line(time_us, host, str(time_us)) for time_us in times_us]
    following = iter([*lines, None])
    return cast(Reader, SimpleNamespace(next=lambda _: next(following)))


def test_logs_of_several_hosts_come_in_the_order_of_time() -> None:
    readers = [reader("a", 1, 4, 5), reader("b", 2, 3, 9)]
    assert [line.time_us for line in logs_command.merged(readers, None, Interrupt())] == [1, 2, 3, 4, 5, 9]
    readers = [reader("a", 1, 4, 5), reader("b", 2, 3, 9)]
    assert [line.time_us for line in logs_command.merged(readers, 1, Interrupt())] == [5, 9], (
        "the last of each host"
    )


@pytest.mark.parametrize(("robots", "is_asked"), [([], True), ([1], False)])
def test_what_a_router_said_is_asked_for_unless_robots_are_named(robots: list[int], is_asked: bool) -> None:
    routed = fleet(HOSTS + ROUTERS % "left")
    asked = argparse.Namespace(robots=robots, lines=None, follow=False)
    words = logs_command.command(routed, routed.hosts[0], [1], None, asked)
    assert ("SYSLOG_IDENTIFIER=handfast-two-router" in words) == is_asked
    assert "USER_UNIT=handfast-two-robot-1-agent.service" in words
    assert "router" not in logs_command.command(routed, routed.hosts[1], [2], None, asked)


def test_lines_that_are_followed_wait_for_earlier_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs_command, "HOLD_S", 0.05)
    readers = [reader("a", 7, 8), reader("b", 6)]
    assert [line.time_us for line in logs_command.followed(readers, Interrupt())] == [6, 7, 8]


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"MESSAGE": "hello"}, "hello"),
        ({"MESSAGE": [104, 105, 255]}, "hi\N{REPLACEMENT CHARACTER}"),
        ({"MESSAGE": "a\x1b[31mb"}, "a\\x1b[31mb"),
    ],
)
def test_a_line_is_safe_to_print(entry: dict[str, Any], text: str) -> None:
    line = logs_command._parsed("a", json.dumps(entry | {"__REALTIME_TIMESTAMP": "17"}).encode())
    assert line == Line(17, "a", text)


@pytest.mark.parametrize("text", ["[" * 100_000, "[1]", json.dumps({"MESSAGE": [10**9], "x": 1})])
def test_what_makes_no_sense_is_left_out(text: str) -> None:
    assert logs_command._parsed("a", text.encode()) is None


def test_a_host_that_floods_keeps_neither_the_others_nor_this_computers_memory() -> None:
    taken = 0

    def flood(_: float) -> Line:
        nonlocal taken
        taken += 1
        return Line(100 + taken, "a", "x")

    readers = [cast(Reader, SimpleNamespace(next=flood)), reader("b", 1)]
    line = next(logs_command.followed(readers, Interrupt()))
    assert line == Line(1, "b", "1")
    assert taken < 100 * logs_command.WAITING_MAX


# --- the command -----------------------------------------------------------------------------------

ENTRY = json.dumps({"MESSAGE": "hello", "__REALTIME_TIMESTAMP": "17"})


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return tmp_path


def logs(tools: Path, left: str, right: str, **given: Any) -> int:
    """The exit status of `logs` where ssh to the two hosts does this."""
    script = tools / "ssh"
    script.write_text(f'#!/bin/sh\ncase "$*" in *" left "*) {left};; *) {right};; esac\n')
    script.chmod(0o755)
    return run(tools, **given)


def run(tools: Path, **given: Any) -> int:
    file = tools / "two.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet())))
    nothing = {"hosts": [], "robots": [], "since": None, "lines": None, "follow": False}
    return logs_command._logs(argparse.Namespace(**{**no_changes(), **nothing, "fleet": str(file), **given}))


def test_a_host_that_cannot_be_read_is_said_and_fails(
    tools: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = "echo 'x: Permission denied' >&2; exit 255"
    assert logs(tools, f"echo '{ENTRY}'", said) == 1
    out, err = capsys.readouterr()
    assert out.endswith("left: hello\n")
    assert err.startswith("handfast: right: it does not let r in")


@pytest.mark.parametrize("hangs", ["exec sleep 60", "exec yes"])
def test_a_host_that_says_nothing_is_given_up(
    tools: Path, hangs: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where a login hangs, or floods: no line of a log ever comes."""
    monkeypatch.setattr(logs_command, "SILENT_S", 0.4)
    assert logs(tools, f"echo '{ENTRY}'", hangs) == 1
    out, err = capsys.readouterr()
    assert out.endswith("left: hello\n")
    assert "handfast: right: it has said nothing for 0 s" in err


def test_a_status_without_a_word_is_a_failure_too(tools: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert logs(tools, "true", "exit 1") == 1
    assert capsys.readouterr().err == "handfast: right: the program there ended (status 1)\n"


def test_whoever_follows_hears_of_a_host_that_cannot_be_read(
    tools: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At once: the others are followed on and on."""
    told: list[str] = []

    def look(self: Reader, timeout_s: float, plain: Any = Reader.next) -> Line | None:
        line = plain(self, timeout_s)
        if line is None and self.host.name == "right":
            told.append(capsys.readouterr().err)
            signal.raise_signal(signal.SIGINT)
        return cast("Line | None", line)

    monkeypatch.setattr(Reader, "next", look)
    assert logs(tools, "exec sleep 60", "exit 255", follow=True) == 130
    assert told == [f"handfast: right: {hosts.LOST}\n"]


@pytest.mark.parametrize("lines", [None, 5])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_it_while_a_host_says_nothing(
    tools: Path, lines: int | None, number: signal.Signals
) -> None:
    waits = threading.Event()
    main = threading.main_thread().ident
    assert main is not None
    sent = threading.Thread(target=lambda: (waits.wait(10.0), signal.pthread_kill(main, number)))
    plain = queue.Queue.get

    def get(self: Any, block: bool = True, timeout: float | None = None) -> Any:
        waits.set()
        return plain(self, block, timeout)

    sent.start()
    begun = time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(queue.Queue, "get", get)
        assert logs(tools, "exec sleep 60", "true", lines=lines) == 130
    assert time.monotonic() - begun < 20.0
    sent.join()


def test_without_ssh_it_is_one_line(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tools))
    with pytest.raises(InputError, match="there is no ssh on this machine"):
        run(tools)


# --- a run on this machine ------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run that has said something."""
    (tmp_path / "private").mkdir()
    monkeypatch.setattr(registry, "private_folder", lambda: tmp_path / "private")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    logs = tmp_path / "run" / "logs"
    logs.mkdir(parents=True)
    text = (FLEETS / "pair.toml").read_text().replace('"pair"', '"pair-here"')
    (tmp_path / "run" / "fleet.toml").write_text(text)
    for robot in (1, 2):
        name = f"robot {robot} agent"
        (logs / f"robot-{robot}-agent.log").write_text(f"{name}: ready\n{name}: a\x1b[31mb\n")
    return tmp_path / "run"


def of_run(folder: Path) -> Registration:
    return Registration("pair-here", folder, folder / "fleet.toml")


def test_of_a_run_here_its_files_are_read(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [f"robot {robot} agent: {text}\n" for robot in (1, 2) for text in ("ready", "a\\x1b[31mb")]
    with of_run(folder):
        assert main(["logs", "pair-here"]) == 0
        assert capsys.readouterr().out == "".join(lines)
        assert main(["logs", "pair-here", "--robot", "2", "-n", "1"]) == 0
        assert capsys.readouterr().out == lines[3]
    assert main(["logs", str(folder)]) == 0, "when it is over, too"
    assert capsys.readouterr().out == "".join(lines)


def test_of_a_run_here_lines_are_followed_to_its_end(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    steps: list[Any] = []
    with of_run(folder) as run, open(folder / "logs" / "robot-2-agent.log", "a") as log:

        def say(text: str) -> None:
            print(text, end="", file=log, flush=True)

        def end() -> None:
            say("ed\nthe last words")
            (folder / "logs" / "robot-1-plant.log").write_text("robot 1 plant: ending\n")
            run.close()

        steps = [lambda: say("robot 2 agent: stopp"), end]
        monkeypatch.setattr(logs_command.time, "sleep", lambda _: steps.pop(0)())
        assert main(["logs", "pair-here", "--follow", "-n", "1"]) == 0
    first, second, *later = capsys.readouterr().out.splitlines()
    assert (first, second) == ("robot 1 agent: a\\x1b[31mb", "robot 2 agent: a\\x1b[31mb")
    stamped = [line[len("2026-11-20 10:00:00.000 ") :] for line in later]
    assert sorted(stamped) == [
        "robot 1 plant: ending",
        "robot 2 agent: stopped",
        "robot 2 agent: the last words",
    ]


def test_of_a_run_here_what_cannot_be(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def says(*arguments: str) -> str:
        assert main(["logs", *arguments]) == 2
        return capsys.readouterr().err.removeprefix("handfast: ")

    assert says("pair-here").startswith('no fleet of the name "pair-here" runs here; ')
    with of_run(folder):
        assert says("pair-here", "--since", "1 h").startswith(
            "--since: what a run on this machine says bears no"
        )
        assert says("pair-here", "--host", "a").startswith("--host: pair-here runs on this machine")
        assert says("pair-here", "--robot", "3").startswith("there is no robot 3 in pair-here")
        (folder / "logs" / "robot-1-plant.log").mkdir()
        assert main(["logs", "pair-here", "-n", "0"]) == 1
        assert "robot 1 plant: cannot read its log: " in capsys.readouterr().err
    with Registration("pair-here", folder, folder / "fleet.toml", attached=True):
        assert says("pair-here").startswith(
            "there are no logs of pair-here here: no `handfast run` has started"
        )
