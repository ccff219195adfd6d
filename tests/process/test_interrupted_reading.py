"""A command whose input never comes: a pipe that nobody writes into."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.process.harness import Command, wait_for


@pytest.mark.parametrize(
    ("words", "number"),
    [
        (("run",), signal.SIGINT),
        (("up",), signal.SIGINT),
    ],
)
def test_it_can_be_interrupted(tmp_path: Path, words: tuple[str, ...], number: signal.Signals) -> None:
    pipe = tmp_path / "fleet.toml"
    os.mkfifo(pipe)
    with Command(tmp_path / "in", *words, str(pipe)) as command:
        writers: list[int] = []

        def has_a_reader() -> bool:
            try:
                writers.append(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
            except OSError:  # ENXIO: nobody has opened it to read
                return False
            return True

        try:
            wait_for(has_a_reader, "the command to read", 60.0, command.told)
            os.kill(command.process.pid, number)
            assert command.wait(20.0) == 130, command.told()
        finally:
            for writer in writers:
                os.close(writer)
    assert command.out == ""
    assert command.err in ("", f"{number.name}: nothing was started\n")
    assert {path.name for path in (tmp_path / "in").iterdir()} == {"stdout", "stderr"}
