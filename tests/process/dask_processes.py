"""A Dask scheduler and its workers as real processes on this machine."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Final

from tests.process.harness import ADDRESS, ROOT, children, environment, wait_for

START_S: Final = 90.0


class DaskProcesses:
    """A scheduler and its workers, each with one thread; a context manager.

    Args:
        folder: for their files; the scheduler's is `file`.
        workers: how many are started with it.
    """

    def __init__(self, folder: Path, workers: int = 2) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._count = folder, workers
        self.file = folder / "scheduler.json"
        self.workers: list[subprocess.Popen[bytes]] = []
        self.scheduler: subprocess.Popen[bytes] | None = None
        self._logs = 0

    def __enter__(self) -> DaskProcesses:
        try:
            self.start()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in filter(None, (*self.workers, self.scheduler)):
            left = [*children(process.pid), process.pid] if process.poll() is None else []
            for pid in left:
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    continue
            process.wait()

    def start(self) -> None:
        """Starts a scheduler, and workers of it; waits until it knows them."""
        self.file.unlink(missing_ok=True)
        self.scheduler = self._process(
            "scheduler", "--host", ADDRESS, "--port", "0", "--no-dashboard", "--no-jupyter"
        )
        wait_for(self._is_written, "the scheduler", START_S, self.told)
        logs = [self.add_worker() for _ in range(self._count)]
        for log in logs:
            wait_for(partial(_registered, log), "a worker", START_S, self.told)

    def _is_written(self) -> bool:
        """Whether the scheduler's file is there, whole: Dask makes it first, and then writes it."""
        return self.file.exists() and self.file.read_text().rstrip().endswith("}")

    @property
    def address(self) -> str:
        """``tcp://host:port`` of the scheduler."""
        return str(json.loads(self.file.read_text())["address"])

    def add_worker(self, source: Path = ROOT, *more: str) -> Path:
        """Starts a worker, whose handfast may be that of another tree than the one under test; returns its
        log."""
        words = (
            "--nthreads",
            "1",
            "--host",
            ADDRESS,
            "--no-dashboard",
            "--local-directory",
            str(self._folder),
            *more,
        )
        self.workers.append(self._process("worker", *words, source=source))
        return self._log("worker")

    def worker_process(self, number: int) -> int:
        """The process of a worker, below its nanny; those that drive runs are below it."""

        def look() -> int:
            found = children(self.workers[number].pid)
            return next((pid for pid, words in found.items() if "spawn_main" in words), 0)

        return wait_for(look, "a worker", START_S, self.told)

    def told(self) -> str:
        """What they said last."""
        logs = sorted(self._folder.glob("*.log"))
        return "\n".join(f"{log.name}: {log.read_text(errors='replace')[-2000:]}" for log in logs)

    def _process(self, kind: str, *arguments: str, source: Path = ROOT) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-P", "-m", f"distributed.cli.dask_{kind}"]
        self._logs += 1
        with open(self._log(kind), "wb") as output:
            return subprocess.Popen(
                [*words, *arguments, "--scheduler-file", str(self.file)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment() | {"PYTHONPATH": str(source), "TMPDIR": str(self._folder)},
            )

    def _log(self, kind: str) -> Path:
        return self._folder / f"{kind}-{self._logs}.log"


def _registered(log: Path) -> bool:
    return "Registered to" in log.read_text()


def changed_copy(folder: Path) -> Path:
    """A tree of our packages that differs from this one in a comment."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "handfast", folder / "handfast", ignore=ignored)
    with open(folder / "handfast" / "agent" / "core.py", "a", encoding="utf-8") as file:
        file.write("# a change\n")
    return folder
