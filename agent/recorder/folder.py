"""The folder in which a robot's computer keeps its recording: MCAP files of limited size, the newest ones.

Data is on the disk when `append` returns, whatever happens to the computer afterwards. All files together
never take more than their share, and the disk is never filled.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
from collections import deque
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

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
_HELD: Final = (errno.EWOULDBLOCK, errno.EACCES)
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
    return [path for _, path in sorted(_numbered(folder))]


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    return [(int(match[1]), path) for path in folder.iterdir() if (match := FILE_NAME.fullmatch(path.name))]


def _size(path: Path) -> int | None:
    """None when somebody has removed it."""
    with suppress(FileNotFoundError):
        return path.stat().st_size
    return None


class RecordingFolder:
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
        path.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(path / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        self._file: int | None = None
        """The newest file; None when the next data begin another."""
        self._size = 0
        self._newest = path
        try:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno not in _HELD:
                    raise
                raise FolderInUseError(f"{path}: another process is recording there") from None
            there = sorted(_numbered(path))
            self._closed = deque((each, size) for _, each in there if (size := _size(each)) is not None)
            """Complete files and their sizes, the oldest first."""
            self._next = 1 + max((number for number, _ in there), default=0)
            self._mark = os.urandom(4).hex()
            with suppress(PermissionError):
                _sync_folder(path.parent)
        except BaseException:
            os.close(self._lock)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the newest file and unlock the folder."""
        self.end_file()
        os.close(self._lock)

    @property
    def total_bytes(self) -> int:
        """Size of all files."""
        return sum(size for _, size in self._closed) + self._size

    def is_full_with(self, size: int) -> bool:
        """Return True if the newest file should end after `size` more bytes."""
        return self._size + size >= self._file_bytes

    def end_file(self) -> None:
        """End the newest file: the next data begin another."""
        if self._file is not None:
            self._closed.append((self._newest, self._size))
            file, self._file, self._size = self._file, None, 0
            with suppress(OSError):  # the descriptor is gone all the same, and all is on the disk
                os.close(file)

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
            if self._file is None:
                self._begin(data)
            else:
                self._go_on(self._file, data)
        except OSError:
            ends = True
            raise
        finally:
            if ends:
                self.end_file()

    def _make_room(self, size: int) -> None:
        while self._closed and self.total_bytes + size > self._bytes_max:
            oldest, _ = self._closed[0]
            with suppress(FileNotFoundError):  # somebody else has tidied up
                oldest.unlink()
            self._closed.popleft()
        disk = os.statvfs(self.path)
        free = disk.f_bavail * disk.f_frsize
        if free - size < self._reserve_bytes:
            about = f"{free / 1e6:.0f} MB are free, {self._reserve_bytes / 1e6:.0f} MB are kept for others"
            raise OSError(errno.ENOSPC, about)

    def _begin(self, data: bytes) -> None:
        path = self.path / f"{self._next:08d}-{self._mark}.mcap"
        self._next += 1  # whatever becomes of it: one that cannot be removed is not in the way
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o644)
        try:
            _write(file, data)
            _to_disk(file)
            _sync_folder(self.path)
        except BaseException:
            os.close(file)
            with suppress(OSError):
                path.unlink()
            raise
        self._file, self._size, self._newest = file, len(data), path

    def _go_on(self, file: int, data: bytes) -> None:
        try:
            _write(file, data)
            _to_disk(file)
        except BaseException:
            # Where this fails too, a piece stays at the end of the file: readers leave it out.
            with suppress(OSError):
                os.ftruncate(file, self._size)
            raise
        self._size += len(data)


def _write(file: int, data: bytes) -> None:
    written = os.write(file, data)
    if written < len(data):
        raise OSError(errno.ENOSPC, f"only {written} of {len(data)} bytes were taken")


def _sync_folder(path: Path) -> None:
    """Puts the names in a folder on the disk."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that has no such thing
            raise
    finally:
        os.close(handle)
