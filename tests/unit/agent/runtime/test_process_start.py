"""How a robot's process begins: what it tells while it waits, and what it ends with when it cannot begin."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.__main__ import start
from handfast.agent.runtime import process
from handfast.agent.security.credentials import CredentialsError, NotValidNowError
from handfast.agent.transport.bus import BusError
from tests.unit.agent.runtime.test_service import all_of

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 2, y_m = 0 }]
fleet = { name = "two" }
formation = { edges = [[1, 2]], distance_m = 1.0, safe_distance_m = 0.2 }
network = { security = "mtls" }
"""


class Asked:
    """Stands for `Shutdown`: nobody asks."""

    def __init__(self, *, with_parent: bool) -> None:
        self.asked, self.looked = False, 0

    def look_for_parent(self) -> None:
        self.looked += 1


@pytest.fixture
def begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., Any]], int]:
    """Runs an agent whose bus is made by what is given; the exit status."""
    file = tmp_path / "fleet.toml"
    file.write_text(FLEET)
    monkeypatch.setattr(process, "Shutdown", Asked)

    def run(bus_for: Callable[..., Any]) -> int:
        monkeypatch.setattr(process, "bus_for", bus_for)
        arguments = ["--fleet", str(file), "--robot", "1", "--keys", str(tmp_path)]
        return process.main(arguments, "python -m handfast.agent", "agent", start)

    return run


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", listening.getsockname())
        monkeypatch.setenv("WATCHDOG_USEC", "1500000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        yield listening


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (NotValidNowError("the certificate of robot 1 is not valid yet"), process.FAILED),
        (CredentialsError("the certificate of robot 1 is not for its key"), process.BAD_INPUT),
        (BusError("cannot listen"), process.FAILED),
    ],
)
def test_what_time_mends_is_tried_again(
    begin: Callable[[Callable[..., Any]], int],
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    status: int,
) -> None:
    """A robot boots before its clock is set: systemd gives up on what is bad input for good."""

    def bus_for(*_: object, **__: object) -> None:
        raise error

    assert begin(bus_for) == status
    assert capsys.readouterr().err == f"robot 1 agent: {error}\n"


def test_who_waits_for_a_router_lives(
    begin: Callable[[Callable[..., Any]], int], told: socket.socket, capsys: pytest.CaptureFixture[str]
) -> None:
    """A start that takes longer than systemd gives it would be killed, again and again."""

    def bus_for(*_: object, go_on_waiting: Callable[[], bool], **__: object) -> None:
        assert all_of(told) == []
        assert all(go_on_waiting() for _ in range(3))
        raise BusError("no router answers")

    assert begin(bus_for) == process.FAILED
    assert all_of(told) == [
        "WATCHDOG_USEC=60000000",
        "READY=1",
        "STATUS=waiting for a router",
        "WATCHDOG=1",
    ]
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "robot 1 agent: no router answers yet: waiting for one",
        "robot 1 agent: no router answers",
    ]


def test_a_log_holds_nothing_that_moves_a_cursor(capsys: pytest.CaptureFixture[str]) -> None:
    process.logger("robot 3", "agent")("stopped: \x1b[2Jhere\r\nand there")
    assert capsys.readouterr().err == f"robot 3 agent: stopped: \\x1b[2Jhere\\r{os.linesep}and there\n"


class Left(Exception):
    """The process has ended outright, with this status."""


class AskedLater(Asked):
    """Somebody asks the process to end once it runs, as what is looked at last says."""

    why = "SIGTERM"

    @property
    def asked(self) -> bool:
        return self.looked > 0

    @asked.setter
    def asked(self, _: bool) -> None: ...


class NobodysBus:
    """A bus on which nobody is. Closing it takes for ever."""

    def __init__(self) -> None:
        self.left = False

    def __enter__(self) -> NobodysBus:
        return self

    def __exit__(self, *_: object) -> None:
        assert self.left, "it is left, and not closed"

    def leave(self) -> None:
        self.left = True

    def were_deaf(self) -> list[str]:
        return []

    def drain(self) -> Iterator[tuple[str, bytes]]:
        return iter(())

    def watch(self, _: str) -> NobodysBus:
        return self

    def update(self) -> list[tuple[str, bool]]:
        return []

    def declare(self, _: str) -> None: ...

    def announce(self, _: str) -> None: ...

    def listen(self, _: object) -> None: ...

    def publish(self, *_: object) -> None: ...


@pytest.mark.slow
@pytest.mark.patches
def test_it_ends_outright_and_waits_for_no_link(
    begin: Callable[[Callable[..., Any]], int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(process, "Shutdown", AskedLater)
    monkeypatch.setattr(process, "wait_until_valid", lambda *_: None)

    def leave(status: int) -> None:
        raise Left(status)

    monkeypatch.setattr(os, "_exit", leave)
    with pytest.raises(Left, match=str(process.PASSED)):
        begin(lambda *_, **__: NobodysBus())
    assert "robot 1 agent: ending (SIGTERM)\n" in capsys.readouterr().err
