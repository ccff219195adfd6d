"""What the processes of a run say, from the files in its folder that they write to."""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Final

LINE_BYTES_MAX: Final = 4_000_000
LAST_BYTES_MAX: Final = 4096
_NAME: Final = re.compile(r"robot-(\d+)-(\w+)\.log")


class LogFile:
    """The log of one process, read on from where it was read last.

    Attributes:
        robot: whose process it is.
        name: the robot and the process's role, as it begins its own lines.
    """

    def __init__(self, path: Path, robot: int, role: str) -> None:
        self.robot: Final = robot
        self.name: Final = f"robot {robot} {role}"
        self._path = path
        self._at = 0

    def lines(self, *, complete: bool = False) -> Iterator[str]:
        """What was written since, without the process's name; `complete`: not a line that is being written.

        Raises:
            OSError: the file cannot be read.
        """
        with open(self._path, "rb") as file:
            file.seek(self._at)
            while data := file.readline(LINE_BYTES_MAX):
                if complete and not data.endswith(b"\n") and len(data) < LINE_BYTES_MAX:
                    return
                self._at = file.tell()
                yield data.decode(errors="replace").rstrip("\n").removeprefix(f"{self.name}: ")

    def last(self, count: int | None, *, complete: bool = False) -> Iterable[str]:
        """The last `count` lines, or all; as `lines`."""
        lines = self.lines(complete=complete)
        return lines if count is None else deque(lines, count)


def log_files(folder: Path, robots: Collection[int]) -> list[LogFile]:
    """The logs of these robots' processes, in the order of robots; none where there is no such folder."""
    found = [
        LogFile(path, int(name[1]), name[2])
        for path in folder.glob("*.log")
        if (name := _NAME.fullmatch(path.name)) is not None
    ]
    return sorted((log for log in found if log.robot in robots), key=lambda log: (log.robot, log.name))


def last_words(folder: Path, robot: int, role: str) -> str:
    """The last line of a process's log, "" where there is none."""
    try:
        with open(folder / f"robot-{robot}-{role}.log", "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LAST_BYTES_MAX))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    return lines[-1].removeprefix(f"robot {robot} {role}: ") if lines else ""
