"""What a process tells systemd of itself."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from handfast.agent.runtime.systemd_notify import SystemdNotifier


@pytest.fixture
def told(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(5.0)
        yield listening


def all_of(told: socket.socket) -> list[str]:
    told.setblocking(False)
    found = []
    while True:
        try:
            found.append(told.recv(4096).decode())
        except BlockingIOError:
            return found


def test_what_it_is_told_goes_to_the_socket(told: socket.socket):
    with SystemdNotifier({"NOTIFY_SOCKET": told.getsockname()}) as service:
        service.ready()
        service.says("running")
        service.stopping()
    assert all_of(told) == ["READY=1", "STATUS=running", "STOPPING=1"]


def test_a_status_is_one_notification(told: socket.socket):
    """Whoever gave the reason for a stop tells systemd nothing."""
    with SystemdNotifier({"NOTIFY_SOCKET": told.getsockname()}) as service:
        service.says("stopped: here\nWATCHDOG=trigger")
    assert all_of(told) == ["STATUS=stopped: here\\nWATCHDOG=trigger"]


def test_who_waits_has_begun_and_may_be_silent_for_longer(told: socket.socket):
    environment = {"NOTIFY_SOCKET": told.getsockname(), "WATCHDOG_USEC": "1500000"}
    with SystemdNotifier(environment) as service:
        service.waits("waiting for a router")
        assert all_of(told) == ["WATCHDOG_USEC=60000000", "READY=1", "STATUS=waiting for a router"]
        service.ready()
        service.ready()
    assert all_of(told) == ["WATCHDOG_USEC=1500000", "READY=1", "READY=1"]


def test_an_abstract_socket_is_found():
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(f"\0handfast-test-{os.getpid()}")
        with SystemdNotifier({"NOTIFY_SOCKET": f"@handfast-test-{os.getpid()}"}) as service:
            service.ready()
        assert all_of(listening) == ["READY=1"]


def test_a_loop_says_that_it_lives_a_few_times_within_the_timeout(told: socket.socket):
    with SystemdNotifier({"NOTIFY_SOCKET": told.getsockname(), "WATCHDOG_USEC": "1000000"}) as service:
        for tick in range(100):  # 2 s at 50 Hz
            service.lives(tick * 20_000_000)
        assert all_of(told) == ["WATCHDOG=1"] * 8
        service.lives(0)  # a clock that was set back must not silence it
        assert all_of(told) == ["WATCHDOG=1"]


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "nonsense"},
        {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"},  # its parent's
    ],
)
def test_without_a_watchdog_of_its_own_nothing_is_said(environment: dict[str, str], told: socket.socket):
    with SystemdNotifier(environment | {"NOTIFY_SOCKET": told.getsockname()}) as service:
        service.lives(0)
        service.lives(10**10)
    assert all_of(told) == []


def test_nobody_needs_to_listen(tmp_path: Path):
    SystemdNotifier({}).ready()
    with SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "1000"}) as gone:
        gone.ready()
        gone.lives(0)
