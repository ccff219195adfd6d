"""When a process is asked to end: by a signal, or by the end of who started it."""

from __future__ import annotations

import os
import signal
from argparse import ArgumentParser
from collections.abc import Iterator

import pytest

from handfast.agent.runtime.shutdown import Shutdown, add_parent_argument


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
