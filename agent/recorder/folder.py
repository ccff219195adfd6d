"""The folder in which a robot's computer keeps its recording: MCAP files of limited size, the newest ones.

Data is on the disk when `append` returns, whatever happens to the computer afterwards. All files together
never take more than their share, and the disk is never filled.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Final

from handfast.agent.common.closing import Closing

FILE_BYTES: Final = 8_000_000
"""Size at which a file is full."""
FILES_MIN: Final = 4
"""Minimum number of files in a full folder: the oldest is deleted as a whole."""
RESERVE_BYTES: Final = 200_000_000
"""Space that stays free on the disk for everything else on that computer."""
LOCK_NAME: Final = "lock"
"""File in the folder that its one recorder has locked."""
FILE_NAME: Final = re.compile(r"([0-9]{8,18})-[0-9a-f]{8}\.mcap")
"""Number of the file, and a random mark: a file of the same name is the same file, perhaps grown."""
PASSING: Final = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS)
"""Errors of a disk that may pass. All others are permanent, such as a folder that belongs to another user."""

_to_disk: Final = getattr(os, "fdatasync", os.fsync)  # macOS has none


class FolderInUseError(RuntimeError):
    """Another process records into the folder; the text is one clear message."""


def recording_files(folder: Path) -> list[Path]:
    """The files of a recording, the oldest first.

    Raises:
        OSError: it cannot be listed.
    """
    numbered = [(number, path) for path in folder.iterdir() if (number := number_of(path)) is not None]
    return [path for _, path in sorted(numbered)]


def number_of(path: Path) -> int | None:
    """Return the number of a file of a recording, None for another file."""
    match = FILE_NAME.fullmatch(path.name)
    return int(match[1]) if match else None


class RecordingFolder(Closing):
    """Appends data to the newest file of a folder. A context manager that keeps other recorders out.

    Args:
        path: made if need be.
        bytes_max: maximum size of all files together.
        reserve_bytes: space that stays free on the disk.

    Raises:
        FolderInUseError: another process records there.
        OSError: it cannot be made, locked or listed.
    """

    def __init__(self, path: Path, bytes_max: int, reserve_bytes: int = RESERVE_BYTES) -> None:
        self.path: Final = path
        self._bytes_max, self._reserve_bytes = bytes_max, reserve_bytes
        self._file_bytes = min(FILE_BYTES, bytes_max // FILES_MIN)
        self._mark = os.urandom(4).hex()
        self._file: FileIO | None = None
        """The newest file; None when the next data begin another."""
        path.mkdir(parents=True, exist_ok=True)
        recording_files(path)
        self._lock = open(path / LOCK_NAME, "ab")  # noqa: SIM115 - closed by close()
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise FolderInUseError(f"{path}: another process is recording there") from None
        with suppress(PermissionError):
            _sync_folder(path.parent)

    def close(self) -> None:
        """End the newest file and unlock the folder."""
        self.end_file()
        self._lock.close()

    def is_full_with(self, size: int) -> bool:
        """Return True if the newest file should end after `size` more bytes."""
        return (self._file.tell() if self._file else 0) + size >= self._file_bytes

    def end_file(self) -> None:
        """End the newest file: the next data begin another."""
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):  # all is on the disk
                file.close()

    def append(self, data: bytes, *, begins: bool = False, ends: bool = False) -> None:
        """Write data to the disk; delete the oldest files to make room.

        Args:
            begins: a file begins with them.
            ends: the file ends after them.

        Raises:
            OSError: the disk does not take it, or has too little room left. The file ends before it.
        """
        if begins:
            self.end_file()
        try:
            self._make_room(len(data))
            self._write(data)
        except OSError:
            ends = True
            raise
        finally:
            if ends:
                self.end_file()

    def _make_room(self, size: int) -> None:
        sizes = {path: path.stat().st_size for path in recording_files(self.path)}
        for oldest in [*sizes][: -1 if self._file else None]:
            if sum(sizes.values()) + size <= self._bytes_max:
                break
            oldest.unlink(missing_ok=True)
            del sizes[oldest]
        disk = os.statvfs(self.path)
        free = disk.f_bavail * disk.f_frsize
        if free - size < self._reserve_bytes:
            about = f"{free / 1e6:.0f} MB are free, {self._reserve_bytes / 1e6:.0f} MB are kept for others"
            raise OSError(errno.ENOSPC, about)

    def _write(self, data: bytes) -> None:
        is_new = self._file is None
        if self._file is None:
            number = 1 + max((number_of(path) or 0 for path in recording_files(self.path)), default=0)
            self._file = FileIO(self.path / f"{number:08d}-{self._mark}.mcap", "xb")
        file, at = self._file, self._file.tell()
        try:
            written = file.write(data)
            if written < len(data):
                raise OSError(errno.ENOSPC, f"only {written} of {len(data)} bytes were taken")
            _to_disk(file.fileno())
            if is_new:
                _sync_folder(self.path)
        except OSError:
            # Where this fails too, a piece stays at the end of the file: readers leave it out.
            with suppress(OSError):
                file.truncate(at)
                if is_new:
                    Path(str(file.name)).unlink()
            raise


def _sync_folder(path: Path) -> None:
    """Put the names in a folder on the disk."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that has no such thing
            raise
    finally:
        os.close(handle)
