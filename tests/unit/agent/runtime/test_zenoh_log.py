"""Zenoh's log is taken from standard output, which is then given back."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CODE = """
import os, sys
from agent.runtime.zenoh_log import ZenohLog
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
