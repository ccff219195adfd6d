"""What a process tells systemd of itself.

A process whose certificate is not valid now: it waits, says so now and then, and goes on.

When a process is asked to end: by a signal, or by the end of who started it.
"""

from __future__ import annotations

import os
import signal
import socket
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from handfast.agent.runtime import service
from handfast.agent.runtime.service import (
    SAY_S,
    WAITS,
    Shutdown,
    SystemdNotifier,
    add_parent_argument,
    wait_until_valid,
)
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.identity import of_robot
from handfast.deploy.inventory.certificate_authority import CERTIFICATE_DAYS
from tests.trusted import FLEET, NOW_S, authority, credentials


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


ME = of_robot(FLEET, 1)
EXPIRED_S = NOW_S + (CERTIFICATE_DAYS + 3) * DAY_S


class Clock:
    """Stands for `time`: sleeping is what makes time pass; `at` is what then happens at certain times."""

    def __init__(self, now_s: float) -> None:
        self.wall_s, self.slept_s = now_s, 0.0
        self.at: dict[float, Callable[[], None]] = {}

    def time(self) -> float:
        return self.wall_s

    def monotonic(self) -> float:
        return self.slept_s

    def monotonic_ns(self) -> int:
        return round(self.slept_s * 1e9)

    def sleep(self, duration_s: float) -> None:
        self.slept_s += duration_s
        self.wall_s += duration_s
        for due_s in [due_s for due_s in self.at if due_s <= self.slept_s]:
            self.at.pop(due_s)()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock(NOW_S)
    monkeypatch.setattr(service, "time", made)
    return made


def waits(folder: Path | None, ends: Callable[[], bool] = lambda: False) -> list[str]:
    said: list[str] = []
    with SystemdNotifier({}) as service:
        wait_until_valid(ME, folder, ends, service, said.append)
    return said


def made(folder: Path, now_s: float) -> None:
    with authority(folder / "authority", NOW_S) as by:
        credentials(by, folder / "keys", ME, now_s=now_s)


def test_a_good_one_keeps_nobody(clock: Clock, tmp_path: Path) -> None:
    made(tmp_path, NOW_S)
    assert waits(tmp_path / "keys") == []
    assert clock.slept_s == 0


@pytest.mark.slow
def test_an_expired_one_is_waited_for_until_it_is_renewed(clock: Clock, tmp_path: Path) -> None:
    made(tmp_path, NOW_S)
    clock.wall_s = EXPIRED_S
    clock.at[2.5 * SAY_S] = lambda: made(tmp_path, clock.wall_s)
    said = waits(tmp_path / "keys")
    assert len(said) == 4, "once a minute, and when it is over"
    assert all(line.endswith(f"the certificate of robot 1 expired 3 days ago; {WAITS}") for line in said[:3])
    assert said[3] == "its certificate is valid now"
    assert 2.5 * SAY_S <= clock.slept_s < 2.5 * SAY_S + 2.0


def test_one_that_is_not_valid_yet_is_waited_for_until_the_clock_is_set(clock: Clock, tmp_path: Path) -> None:
    made(tmp_path, NOW_S)
    clock.wall_s = 1000.0

    def set_clock() -> None:
        clock.wall_s = NOW_S + DAY_S

    clock.at[5.0] = set_clock
    said = waits(tmp_path / "keys")
    assert "not valid yet" in said[0]
    assert said[1:] == ["its certificate is valid now"]


def test_who_is_asked_to_end_does(clock: Clock, tmp_path: Path) -> None:
    made(tmp_path, NOW_S)
    clock.wall_s = EXPIRED_S
    assert len(waits(tmp_path / "keys", lambda: clock.slept_s > 10.0)) == 1
    assert 10.0 < clock.slept_s < 11.0


@pytest.mark.parametrize("folder", [None, "keys"])
def test_what_time_does_not_mend_is_not_waited_for(clock: Clock, tmp_path: Path, folder: str | None) -> None:
    assert waits(None if folder is None else tmp_path / folder) == []
    assert clock.slept_s == 0


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Those of the tests' own process are as before in the end."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("words", "ends"),
    [
        ([], False),
        (["--exit-with-parent"], False),
        ([f"--exit-with-parent={os.getppid()}"], False),
        ([f"--exit-with-parent={os.getpid()}"], True),  # which is not its parent, as one that is gone
    ],
)
def test_a_process_whose_parent_was_gone_before_it_looked_ends(words: list[str], ends: bool) -> None:
    parser = ArgumentParser()
    add_parent_argument(parser)
    shutdown = Shutdown(with_parent=parser.parse_args(words).exit_with_parent)
    assert (shutdown.asked, shutdown.why != "") == (ends, ends)


@pytest.mark.parametrize("ignored", [False, True])
def test_a_terminal_that_is_closed_ends_a_process_unless_it_is_to_ignore_that(ignored: bool) -> None:
    """Or it would end at once, without braking."""
    # Whatever these tests were started with, nohup(1) maybe.
    signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    shutdown = Shutdown(with_parent=None)
    os.kill(os.getpid(), signal.SIGHUP)
    assert (shutdown.asked, shutdown.why) == ((False, "") if ignored else (True, "SIGHUP"))
