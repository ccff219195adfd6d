"""Keeps the pose of a simulated body in a file, so that a process that starts again finds it where it was.

A real body stays where it is when the process that drives it dies. So does this one, however its process
ended: the file is mapped memory, which the kernel keeps.
"""

from __future__ import annotations

import errno
import mmap
import os
import zlib
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from struct import Struct
from typing import Final

from handfast.agent.control.hand import Pose
from handfast.agent.recorder.folder import PASSING
from handfast.plant.backend import Check, Command, Place, PlantBackend, Reading

_PLACE: Final = Struct("<Qddd")  # number of the record; x, y (m, W), heading (rad)
_CHECKSUM: Final = Struct("<I")
_SLOT: Final = _PLACE.size + _CHECKSUM.size


class PoseFileError(RuntimeError):
    """The file cannot be used; the text is one clear line.

    Attributes:
        transient: whether it may be usable later, as one on a disk that is full.
    """

    def __init__(self, text: str, *, transient: bool) -> None:
        super().__init__(text)
        self.transient = transient


class PoseFile:
    """The pose file at `path`, made if need be.

    Two records take turns, each with its number and a CRC-32, so that one is whole whenever the process dies.

    Attributes:
        place: where the body was last, None when it is not known.

    Raises:
        PoseFileError: it cannot be opened or made.
    """

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                _allocate(handle)
                self._memory = mmap.mmap(handle, 2 * _SLOT)
            finally:
                os.close(handle)
        except OSError as error:
            text = f"cannot use the pose file {path}: {error.strerror or error}"
            raise PoseFileError(text, transient=error.errno in PASSING) from None
        found = [record for slot in (0, 1) if (record := self._read(slot)) is not None]
        self._number = max((number for number, _ in found), default=0)
        self.place: Place | None = dict(found).get(self._number)

    def _read(self, slot: int) -> tuple[int, Place] | None:
        record = self._memory[slot * _SLOT : (slot + 1) * _SLOT]
        packed = record[: _PLACE.size]
        number, *place = _PLACE.unpack(packed)
        whole = _CHECKSUM.unpack(record[_PLACE.size :])[0] == zlib.crc32(packed)
        if not whole or number == 0 or not all(map(isfinite, place)):
            return None
        return number, (place[0], place[1], place[2])

    def write(self, pose: Pose) -> None:
        """Records where the body is now, with `pose` in W. Two stores to memory: it never waits."""
        self._number += 1
        packed = _PLACE.pack(self._number, pose.x, pose.y, pose.heading)
        start = self._number % 2 * _SLOT
        self._memory[start : start + _SLOT] = packed + _CHECKSUM.pack(zlib.crc32(packed))

    def close(self) -> None:
        """Unmaps the file, which stays."""
        self._memory.close()


def _allocate(handle: int) -> None:
    """Has the disk set aside what the file takes: a full one would kill us at a write to mapped memory.

    Raises:
        OSError: there is no room for it.
    """
    there = os.pread(handle, 2 * _SLOT, 0)
    if os.pwrite(handle, there.ljust(2 * _SLOT, b"\0"), 0) < 2 * _SLOT:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    os.ftruncate(handle, 2 * _SLOT)


class PersistentBody(PlantBackend):
    """A body whose place is written to `pose_file` at every step. It closes both."""

    def __init__(self, body: PlantBackend, pose_file: PoseFile) -> None:
        self._body, self._pose_file = body, pose_file

    def step(self, now_ns: int, command: Command | None) -> Reading:
        reading = self._body.step(now_ns, command)
        self._pose_file.write(reading.pose)
        return reading

    def clear_to_drive(self) -> None:
        self._body.clear_to_drive()

    def checks(self, now_ns: int) -> Sequence[Check]:
        return self._body.checks(now_ns)

    def close(self) -> None:
        self._body.close()
        self._pose_file.close()
