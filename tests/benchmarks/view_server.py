"""The server of a page, as its users start it."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.benchmarks.processes import BenchmarkError, environment, handfast

READY_S = 20.0


class Served(NamedTuple):
    """The process of ``handfast view`` and the address of its page."""

    pid: int
    address: str


@contextmanager
def served(what: Path, folder: Path, ready_s: float = READY_S) -> Iterator[Served]:
    """``handfast view`` of a fleet's file or of the folder of a run; what it says is in `folder`.

    Args:
        ready_s: it has its page by then.
    """
    out = folder / "view.out"
    with open(out, "wb") as stream:
        command = handfast("view", str(what), "--no-browser")
        process = subprocess.Popen(command, stdout=stream, stderr=stream, env=environment())
    try:
        end = time.monotonic() + ready_s
        while not (address := re.search(r"http://\S+", out.read_text())):
            if time.monotonic() > end or process.poll() is not None:
                raise BenchmarkError(f"no page: {out.read_text()[-500:]}")
            time.sleep(0.05)
        yield Served(process.pid, address[0])
    finally:
        process.kill()
        process.wait()
