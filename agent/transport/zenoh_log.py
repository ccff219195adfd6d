"""Zenoh's own log, kept from the process's output and read for what Zenoh refuses, which only it says.

Zenoh writes its log to standard output, from the thread that serves the links: a pipe that is full would stop
them. So the log goes to a file in memory, which never makes anybody wait, and is emptied when it has grown.
"""

from __future__ import annotations

import fcntl
import os
import sys
import tempfile
from collections.abc import Iterator
from typing import Final, TextIO

from handfast.agent.common.closing import Closing
from handfast.agent.security.refusals import Refusals

READ_MAX: Final = 131_072
"""Bytes that are read at once; of a flood the rest is counted by its size."""
POLL_NS: Final = 200_000_000
"""How often the log is read, ns."""
SIZE_MAX: Final = 2_097_152
"""A log of this size is emptied at once, whenever it was read last."""
WANTED: Final = "RUST_LOG"
"""Variable of the environment that says what Zenoh logs, whatever is asked for here."""
_STDOUT: Final = 1


class ZenohLog(Closing):
    """Takes file descriptor 1 from the process while it is open; Python's own standard output goes on.

    Make it before the first session, and give Zenoh `agent.security.refusals.FILTER`. Of several in
    one process the last has all of the log, and is closed first.

    Who sets `WANTED` means to read Zenoh's log: it stays on standard output then. That is said, and of
    refusals only those that are added to `refusals`.
    """

    def __init__(self) -> None:
        self.refusals = Refusals()
        self._closed = False
        self._is_wanted = self._is_news = WANTED in os.environ
        if self._is_wanted:
            return
        self._due_ns = self._read = 0
        self._output = os.dup(_STDOUT)  # not inherited by children, as the new 1 is
        self._sys_stdout = sys.stdout
        if _goes_to_stdout(sys.stdout):
            sys.stdout.flush()
            sys.stdout = os.fdopen(os.dup(self._output), "w", buffering=1, encoding=sys.stdout.encoding)
        self._file = _memory_file()
        fcntl.fcntl(self._file, fcntl.F_SETFL, fcntl.fcntl(self._file, fcntl.F_GETFL) | os.O_APPEND)
        os.dup2(self._file, _STDOUT)

    def close(self) -> None:
        """Gives standard output back; safe to call twice. Sessions must be closed before."""
        if self._closed:
            return
        self._closed = True
        if self._is_wanted:
            return
        if sys.stdout is not self._sys_stdout:
            sys.stdout.close()
            sys.stdout = self._sys_stdout
        os.dup2(self._output, _STDOUT)
        os.close(self._output)
        os.close(self._file)

    def lines(self, now_ns: int) -> Iterator[str]:
        """What is to be said at `now_ns`, of a clock that never goes back: call it at every tick."""
        if self._closed:
            return
        if self._is_news:
            self._is_news = False
            yield f"{WANTED} is set: Zenoh's log is on standard output, and what it refuses is not shown here"
        if self._is_wanted or self._read_file(now_ns):
            yield from self.refusals.lines(now_ns)

    def _read_file(self, now_ns: int) -> bool:
        """Reads what is new, if it is due; whether it was."""
        size = os.fstat(self._file).st_size
        if now_ns < self._due_ns and size < SIZE_MAX:
            return False
        self._due_ns = now_ns + POLL_NS
        new = size - self._read
        if new > 0:
            log = os.pread(self._file, READ_MAX, self._read)
            self._read = size
            if size >= SIZE_MAX:
                os.ftruncate(self._file, 0)  # what came since it was read is lost, hence only now and then
                self._read = 0
            self.refusals.take(log, min(1.0, READ_MAX / new))
        return True


def _goes_to_stdout(stream: TextIO) -> bool:
    try:
        return stream.fileno() == _STDOUT
    except (OSError, ValueError):
        return False


def _memory_file() -> int:
    in_memory = getattr(os, "memfd_create", None)  # Linux
    if in_memory is not None:
        handle: int = in_memory("zenoh-log")
        return handle
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
