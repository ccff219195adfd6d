"""``python -m tests.process.set_clock SECONDS MODULE ARGUMENTS``: runs a module as a process that starts on a
machine whose wall clock is so many seconds ahead; the monotonic clock is as it is.
"""

from __future__ import annotations

import runpy
import sys
import time

if __name__ == "__main__":
    _real_ns, _ahead_ns = time.time_ns, round(float(sys.argv[1]) * 1e9)
    time.time_ns = lambda: _real_ns() + _ahead_ns
    time.time = lambda: time.time_ns() / 1e9
    sys.argv = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
