"""Views hold nobody up, and show texts of robots and hosts as what they are: text."""

from __future__ import annotations

import errno
import io
import pty
import select
import termios
from collections.abc import Callable
from typing import TextIO

import pytest

from handfast.deploy.console.terminal import TerminalView
from handfast.deploy.drive.display import terminal_view
from handfast.deploy.drive.display.live_view import make_view
from handfast.deploy.drive.watch import Picture, RobotPicture
from handfast.deploy.hosts import jobs
from handfast.deploy.hosts.jobs import Row, make_hosts_view

EVIL = "[/x] [bold]a\x1b[2Jb\nc"
SAFE = "[/x] [bold]a\\x1b[2Jb\\nc"


class Output(io.StringIO):
    """Counts what is tried on it; may be a terminal, and may be gone."""

    def __init__(self, *, tty: bool, error: Exception | None = None) -> None:
        super().__init__()
        self._tty, self._error, self.tried = tty, error, 0

    def isatty(self) -> bool:
        return self._tty

    def write(self, text: str) -> int:
        self.tried += 1
        if self._error is not None:
            raise self._error
        return super().write(text)


def show_fleet(stream: TextIO) -> None:
    robots = {
        1: RobotPicture("released", EVIL, None, 0.0, None, 0),
        2: RobotPicture(EVIL, "", 0.1, 0.0, 5, 0),
    }
    with make_view(stream) as view:
        view.say(EVIL)
        view.show(Picture(1.0, 10.0, robots=robots, faults=[EVIL]))


def show_hosts(stream: TextIO) -> None:
    with make_hosts_view(stream) as view:
        view.say(EVIL)
        view.show([Row("left", (1,), EVIL)])


SHOWN = pytest.mark.parametrize("shown", [show_fleet, show_hosts])


@SHOWN
@pytest.mark.parametrize("tty", [False, True])
@pytest.mark.parametrize(
    "error", [BrokenPipeError(errno.EPIPE, "gone"), OSError(errno.EIO, "hung up"), ValueError("closed")]
)
def test_an_output_that_is_gone_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, shown: Callable[[TextIO], None], tty: bool, error: Exception
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    output = Output(tty=tty, error=error)
    shown(output)
    assert output.tried


@SHOWN
@pytest.mark.parametrize("tty", [False, True])
def test_texts_are_shown_as_they_are(
    monkeypatch: pytest.MonkeyPatch, shown: Callable[[TextIO], None], tty: bool
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    output = Output(tty=tty)
    shown(output)
    text = output.getvalue()
    assert text.count(SAFE) >= 2
    assert "\x1b[2J" not in text
    assert "\nc" not in text


@pytest.mark.parametrize("make", [terminal_view.Terminal, jobs.Terminal])
def test_a_ctrl_c_is_not_echoed_while_something_is_redrawn(make: Callable[[TextIO], TerminalView]) -> None:
    ours, theirs = pty.openpty()
    with open(ours, "wb"), open(theirs, "w") as terminal:

        def echoes() -> bool:
            return bool(termios.tcgetattr(theirs)[3] & termios.ECHOCTL)

        before = echoes()
        with make(terminal):
            assert not echoes()
        assert before
        assert echoes()


@pytest.mark.parametrize("make", [terminal_view.Terminal, jobs.Terminal])
def test_a_ctrl_c_drops_nothing_that_is_not_shown_yet(make: Callable[[TextIO], TerminalView]) -> None:
    ours, theirs = pty.openpty()
    with open(ours, "r+b", buffering=0) as keyboard, open(theirs, "w") as terminal, make(terminal) as shown:
        shown.say("a line")
        keyboard.write(b"\x03")
        seen = b""
        while b"a line" not in seen and select.select([ours], [], [], 1.0)[0]:
            seen += keyboard.read(4096)
        assert b"a line" in seen
