"""What starts a Dask worker on a host of a fleet, beside `deploy.hosts.remote_program`, and ends it.

It is sent along when it is needed (`deploy.hosts.connection.HostConnection.extend`), and imports nothing but
the standard library and that program. The worker ends with the program, and that with its ssh connection, or
after its worker where nobody asks about that any more: the end of a connection that was cut is not heard of.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from handfast.deploy.hosts.remote_program import HostError, inside, request

MODULE: Final = "handfast.deploy.cluster.worker_process"
TEXT_MAX: Final = 300
UNASKED_S: Final = 120.0
"""A campaign asks every second."""


class Started:
    """A worker's process, in a process group of its own, and its folder.

    Attributes:
        asked: how often somebody has asked whether it has ended.
    """

    def __init__(self, python: Path, settings: dict[str, Any]) -> None:
        self.asked = 0
        self.folder: Final = Path(tempfile.mkdtemp(prefix="handfast-worker-"))
        self._log: Final = self.folder / "log"
        with open(self._log, "wb") as log:
            self.process: Final = subprocess.Popen(
                [str(python), "-P", "-m", MODULE],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                cwd=self.folder,
                start_new_session=True,
            )
        stdin = self.process.stdin
        assert stdin is not None
        with suppress(BrokenPipeError):  # it has ended, which shows
            stdin.write(json.dumps(settings | {"folder": str(self.folder)}).encode() + b"\n")
            stdin.flush()

    def ended(self) -> str:
        """How it ended and the last that it said, empty while it runs."""
        status = self.process.poll()
        if status is None:
            return ""
        lines = [line for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        said = f": {lines[-1].strip()[:TEXT_MAX]}" if lines else ""
        return f"its worker ended (status {status}){said}"

    def end(self) -> None:
        """Ends it and all that it has started, now."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.communicate()
        shutil.rmtree(self.folder, ignore_errors=True)

    def outlive(self) -> None:
        """Ends this program when the worker has ended, and for so long nobody has asked about it."""
        self.process.wait()
        before = -1
        while before != self.asked:
            before = self.asked
            time.sleep(UNASKED_S)
        self.end()
        os._exit(1)  # the main thread reads from a connection that may never end


_started: Final[list[Started]] = []


@request
def start_worker(version: str, port: int, settings: dict[str, Any]) -> None:
    """Starts a worker with an installed version, for the scheduler on that port of who is connected here."""
    addresses = os.environ.get("SSH_CONNECTION", "").split()
    if len(addresses) != 4:
        raise HostError("its ssh server does not say from where it is reached (SSH_CONNECTION)")
    there, _, here, _ = addresses
    python = inside(f"versions/{version}") / "bin" / "python"
    scheduler = f"tls://{f'[{there}]' if ':' in there else there}:{port}"
    threads = len(os.sched_getaffinity(0))
    found = Started(python, settings | {"scheduler": scheduler, "host": here, "threads": threads})
    _started.append(found)
    atexit.register(found.end)
    threading.Thread(target=found.outlive, daemon=True).start()


@request
def worker_ended() -> str:
    """How the worker that was started last ended, empty while it runs."""
    _started[-1].asked += 1
    return _started[-1].ended()
