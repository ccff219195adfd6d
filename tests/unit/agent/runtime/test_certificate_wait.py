"""A process whose certificate is not valid now: it waits, says so now and then, and goes on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.runtime import certificate_wait
from handfast.agent.runtime.certificate_wait import SAY_S, WAITS, wait_until_valid
from handfast.agent.runtime.systemd_notify import SystemdNotifier
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.identity import of_robot
from handfast.deploy.inventory.certificate_authority import CERTIFICATE_DAYS
from tests.trusted import FLEET, NOW_S, authority, credentials

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
    monkeypatch.setattr(certificate_wait, "time", made)
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
