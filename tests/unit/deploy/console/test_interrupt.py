"""Ctrl-C while a command loads: it ends the command, also where what is imported swallows it."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Final

import pytest

from handfast.deploy import cli
from handfast.deploy.console.interrupt import Interrupt, as_python_does, remembered


@pytest.fixture(autouse=True)
def default() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def swallowed() -> None:
    with suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_one_that_was_swallowed_is_raised_again() -> None:
    went_on = False
    with remembered():
        swallowed()
        with pytest.raises(KeyboardInterrupt), Interrupt().caught():
            went_on = True
    assert not went_on
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class InterruptsItsClass:
    def __set_name__(self, owner: type, name: str) -> None:
        signal.raise_signal(signal.SIGINT)


def test_one_that_came_while_a_class_was_made_is_none_of_its_errors() -> None:
    with pytest.raises(KeyboardInterrupt), remembered():
        type("Made", (), {"field": InterruptsItsClass()})
    with pytest.raises(RuntimeError, match="another"), remembered():
        raise RuntimeError("another")


def test_it_is_forgotten_with_its_command() -> None:
    with remembered():
        swallowed()
    with Interrupt().caught() as interrupt:
        signal.raise_signal(signal.SIGINT)
        assert interrupt.count == 1


def test_one_is_answered_at_once_with_what_is_done_about_it(capfd: pytest.CaptureFixture[str]) -> None:
    with Interrupt().caught() as interrupt:
        with interrupt.answered("it is being completed"):
            signal.raise_signal(signal.SIGINT)
            assert capfd.readouterr().err == "SIGINT: it is being completed\n"
        signal.raise_signal(signal.SIGTERM)
        assert capfd.readouterr().err == ""
        assert interrupt.count == 2


def test_what_may_be_broken_off_is(capfd: pytest.CaptureFixture[str]) -> None:
    with Interrupt().caught() as interrupt:
        with pytest.raises(KeyboardInterrupt), interrupt.answered("it is left out", raises=True):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        assert interrupt.count == 2
    assert capfd.readouterr().err == "SIGTERM: it is left out\n"


def test_one_that_comes_while_an_object_is_finalized_is_not_lost(capfd: pytest.CaptureFixture[str]) -> None:
    """Python swallows what is raised there, and prints a traceback."""

    class Finalized:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    hook = sys.unraisablehook
    with Interrupt().caught() as interrupt:
        with pytest.raises(KeyboardInterrupt), interrupt.answered("it is left out", raises=True):
            Finalized()
        assert interrupt.count == 1
    assert capfd.readouterr().err == "SIGINT: it is left out\n"
    assert sys.unraisablehook is hook


def test_one_that_is_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with remembered():
        signal.raise_signal(signal.SIGINT)


def test_a_task_is_cancelled_and_never_interrupted_in_its_midst() -> None:
    ended = []

    async def serve() -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            await asyncio.sleep(30.0)
        except BaseException as error:
            ended.append(type(error))
            raise

    with remembered():
        before = signal.getsignal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt), as_python_does():
            asyncio.run(serve())
        assert signal.getsignal(signal.SIGINT) is before
    assert ended == [asyncio.CancelledError]


def test_the_command_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    def command(_: object) -> int:
        swallowed()
        with Interrupt().caught():
            return 0

    parser = SimpleNamespace(parse_args=lambda _: SimpleNamespace(command=command))
    monkeypatch.setattr(cli, "_parser", lambda _: parser)
    assert cli.main(["status"]) == 130


WITHIN_EXEC: Final = """
import signal, sys
from types import SimpleNamespace
from handfast.deploy import cli
signal.signal(signal.SIGINT, signal.default_int_handler)
command = lambda _: exec("signal.raise_signal(signal.SIGINT)\\nwhile True: pass")
cli._parser = lambda _: SimpleNamespace(parse_args=lambda _: SimpleNamespace(command=command))
sys.exit(cli.main(["status"]))
"""


def test_the_exit_status_is_one_wherever_it_came(tmp_path: Path) -> None:
    (tmp_path / "loads.py").write_text(WITHIN_EXEC)
    done = subprocess.run(
        [sys.executable, "-m", "loads"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[4])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.parametrize("inherited", [signal.SIG_IGN, signal.SIG_DFL])
def test_who_ignores_a_hang_up_goes_on(inherited: signal.Handlers) -> None:
    before = signal.signal(signal.SIGHUP, inherited)  # `nohup` does
    try:
        with Interrupt().caught() as interrupt:
            if inherited is signal.SIG_IGN:
                signal.raise_signal(signal.SIGHUP)
                assert interrupt.count == 0
            signal.raise_signal(signal.SIGTERM)
            assert interrupt.count == 1
            if inherited is signal.SIG_DFL:
                signal.raise_signal(signal.SIGHUP)
                assert interrupt.count == 2
        assert signal.getsignal(signal.SIGHUP) is inherited
    finally:
        signal.signal(signal.SIGHUP, before)
