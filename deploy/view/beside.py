"""The page of a fleet that a command drives: served by a process of its own, which never slows the drive."""

from __future__ import annotations

import subprocess
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final

from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.program import handfast

OVER: Final = b"over\n"
"""Says that the drive is over, and its recording not complete yet."""
RECORDED: Final = b"recorded\n"
"""Says that the recording is complete."""
END_S: Final = 5.0
POLL_S: Final = 0.1


class PageBeside:
    """``handfast view`` of the run in `folder`, from its start on. A context manager; it ends with this
    process, however that ends.

    Args:
        wanted: whether there is to be one at all.
        interrupt: whose Ctrl-C ends it, once the run is over; one that has ended the drive has ended it, too.
    """

    def __init__(self, folder: Path, interrupt: Interrupt, *, wanted: bool) -> None:
        self._folder, self._interrupt, self._is_wanted = folder, interrupt, wanted
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> PageBeside:
        if self._is_wanted:
            self._process = subprocess.Popen(
                handfast("view", str(self._folder), "--beside"),
                stdin=subprocess.PIPE,
                start_new_session=True,  # a Ctrl-C is for the drive, which goes on to its end in order
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        process = self._process
        if process is None or process.stdin is None:
            return
        with suppress(OSError):
            process.stdin.close()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def over(self) -> None:
        """The drive is over: pages keep what they have until there is a recording."""
        self._say(OVER)

    def recorded(self) -> None:
        """The recording is complete: pages show that, until Ctrl-C."""
        self._say(RECORDED)
        while self._process is not None and self._process.poll() is None and not self._interrupt.count:
            time.sleep(POLL_S)

    def _say(self, what: bytes) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # it has ended, and that is no matter of the drive
                self._process.stdin.write(what)
                self._process.stdin.flush()
