"""Zenoh's log where somebody has asked for it: it is left where it is, and what is not told is said."""

from __future__ import annotations

import os
import sys

import pytest

from agent.runtime.zenoh_log import WANTED, ZenohLog


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
