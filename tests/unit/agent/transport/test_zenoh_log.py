"""Zenoh's log is taken from standard output, which is then given back, unless somebody has asked for it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from handfast.agent.transport.zenoh_log import WANTED, ZenohLog

CODE = """
import os, sys
from handfast.agent.transport.zenoh_log import ZenohLog
print("before")
log = ZenohLog()
os.write(1, b"from the library\\n")
print("meanwhile")
assert list(log.lines(0)) == []
log.close()
log.close()
assert list(log.lines(10**12)) == []
print("after")
"""


def test_only_what_the_library_writes_is_taken() -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        cwd=Path(__file__).parents[4],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert (done.stdout, done.stderr) == ("before\nmeanwhile\nafter\n", "")


TWO = """
import os
from handfast.agent.transport.zenoh_log import ZenohLog
first, second = ZenohLog(), ZenohLog()
print("meanwhile")
os.write(1, b"from the library\\n")
second.close()
os.write(1, b"from the library\\n")
print("between")
first.close()
print("after")
"""


def test_of_two_the_last_is_closed_first_and_the_output_is_given_back() -> None:
    done = subprocess.run(
        [sys.executable, "-c", TWO],
        cwd=Path(__file__).parents[4],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert (done.stdout, done.stderr) == ("meanwhile\nbetween\nafter\n", "")


def test_a_log_that_somebody_wants_is_left_to_him(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(WANTED, "zenoh=debug")
    before = sys.stdout
    with ZenohLog() as log:
        os.write(1, b"of Zenoh\n")
        (line,) = log.lines(0)
        assert line.startswith("RUST_LOG is set: ")
        # What is refused here is told all the same.
        log.refusals.add("an order")
        assert [*log.lines(1)] == ["refused: an order"]
        assert sys.stdout is before
    assert [*log.lines(2)] == []
    assert capfd.readouterr().out == "of Zenoh\n"
