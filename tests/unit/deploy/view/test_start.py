"""A mission that a page starts is a command of its own: what it says is told, and how it ended."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from handfast.deploy.view.beside import StartUnderWay

SAYS_ITS_ARGUMENTS = "import sys; print(*sys.argv[1:], sep='|')"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., StartUnderWay]]:
    made: list[StartUnderWay] = []

    def start(command: str, fleet: str = "a fleet.toml", *, resume: bool = False) -> StartUnderWay:
        monkeypatch.setattr("handfast.deploy.console.data_files._RUN", command)
        made.append(StartUnderWay(fleet, 3, resume=resume))
        return made[-1]

    yield start
    for each in made:
        with suppress(ProcessLookupError):
            each._process.send_signal(signal.SIGKILL)
        each._process.wait()
        each._reader.join()


def ended(under_way: StartUnderWay) -> StartUnderWay:
    deadline = time.monotonic() + 20.0
    while not under_way.is_over:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return under_way


def test_it_is_the_command_that_starts_a_mission(started: Callable[..., StartUnderWay]) -> None:
    given = ended(started(SAYS_ITS_ARGUMENTS))
    assert given.lines() == ["drive|a fleet.toml|--detach"]
    assert ended(started(SAYS_ITS_ARGUMENTS, resume=True)).lines() == ["drive|a fleet.toml|--detach|--resume"]
    assert (given.done, given.count, given.what) == (True, (3, 3), "start the mission")
    assert given._process.stdout is not None
    assert given._process.stdout.closed  # one that was started long ago holds no file


def test_one_that_fails_is_over_and_not_done(started: Callable[..., StartUnderWay]) -> None:
    given = ended(started("import sys; print('not started: robot 2', file=sys.stderr); sys.exit(1)"))
    assert (given.done, given.count, given.lines()) == (False, (0, 3), ["not started: robot 2"])


def test_what_it_says_is_told_while_it_waits(started: Callable[..., StartUnderWay]) -> None:
    given = started("import sys; print('waits for robot 1', flush=True); sys.stdin.read(); input()")
    ended(given)  # it has no input: it does not wait for one
    assert "waits for robot 1" in given.lines()[0]
    waits = started("import time; print('waits for robot 1', flush=True); time.sleep(600)")
    deadline = time.monotonic() + 20.0
    while not waits.lines():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert waits.lines() == ["waits for robot 1"]
    assert (waits.is_over, waits.done, waits.count) == (False, False, (0, 3))
