"""What this machine grants of real time, for tests that ask for it."""

from __future__ import annotations

import os
import subprocess
from functools import cache

import pytest


@cache
def works(*words: str) -> bool:
    """Whether a command succeeds here."""
    return subprocess.run(words, capture_output=True).returncode == 0


def need_realtime() -> None:
    """Skips the test where no process may be started under SCHED_FIFO."""
    if not works("chrt", "-f", "1", "true"):
        pytest.skip("`chrt -f 1 true` is refused here")


def may_raise_limits() -> bool:
    """Whether this process may raise hard limits (CAP_SYS_RESOURCE), as a container's root may not."""
    return works("prlimit", "--rtprio=0:42", "true")


def without(*capabilities: str) -> list[str]:
    """Begin of a command line that takes capabilities away, where this process has any to lose."""
    if os.geteuid() != 0:
        return []
    return ["setpriv", "--bounding-set", ",".join(f"-{name}" for name in capabilities)]
