"""Runs for a pool that leave something behind: their process dies, once or whenever, or another goes on.

As a program, with a folder, how many at a time and numbers of runs, it prints what came of them.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from handfast.deploy.simulate.worker_pool import Pool

DIES_ONCE: Final = 1
DIES: Final = 2
STARTS: Final = 3
FORKS: Final = 4
HANGS: Final = 5


class DyingWork:
    """A `deploy.simulate.worker_pool.Work`: each run gives its number; pids of what it started are in files
    of `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def execute(self, number: int, _go_on: Callable[[], bool]) -> str:
        again = self._folder / f"died-{number}"
        if number == DIES_ONCE and not again.exists():
            again.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if number == DIES:
            os._exit(7)
        if number == STARTS:
            sleep = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1e6)"])
            self._note(number, sleep.pid)
        if number == FORKS:
            pid = os.fork()
            while not pid:
                signal.pause()
            self._note(number, pid)
        if number == HANGS:
            self._note(number, os.getpid())
            while True:
                signal.pause()
        return f"done {number}"

    def unfinished(self, number: int, reason: str, _wall_s: float, *, timed_out: bool) -> str:
        return f"{'timed out' if timed_out else 'crashed'} {number}: {reason}"

    def _note(self, number: int, pid: int) -> None:
        new = self._folder / "new"
        new.write_text(str(pid))
        new.rename(self._folder / f"started-{number}")


if __name__ == "__main__":
    from tests.process.dying_work import DyingWork as Work  # workers know no `__main__`

    with Pool(Work(Path(sys.argv[1])), int(sys.argv[2]), 60.0) as pool:
        print("\n".join(sorted(pool.results(map(int, sys.argv[3:]), lambda: True))))
