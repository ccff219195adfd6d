"""Where a simulated body stands, kept in a file: a process that starts again finds its body where it was.

A real body stays where it is when the process that drives it dies. So does this one, however its process
ended: the file is mapped memory, which the kernel keeps.
"""

from __future__ import annotations

import mmap
import os
import zlib
from math import isfinite
from pathlib import Path
from struct import Struct
from typing import Final

from agent.hand import Pose
from plant.backend import Command, PlantBackend, Reading

_PLACE: Final = Struct("<Qddd")  # number of the record; x, y (m, W), heading (rad)
_CHECKSUM: Final = Struct("<I")
_SLOT: Final = _PLACE.size + _CHECKSUM.size

Place = tuple[float, float, float]
"""x, y (m, W), heading (rad)."""


class StandingError(OSError):
    """The file cannot be used; the text is one clear line."""


class Standing:
    """The file at `path`, made if need be.

    Two records take turns, so that one is whole whenever the process dies.

    Raises:
        StandingError: it cannot be opened or made.
    """

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                os.ftruncate(handle, 2 * _SLOT)
                self._memory = mmap.mmap(handle, 2 * _SLOT)
            finally:
                os.close(handle)
        except OSError as error:
            raise StandingError(f"cannot use the pose file {path}: {error.strerror or error}") from None
        found = [record for slot in (0, 1) if (record := self._read(slot)) is not None]
        self._number = max((number for number, _ in found), default=0)
        self.place: Place | None = dict(found).get(self._number)
        """Where the body stood last, None when it is not known."""

    def _read(self, slot: int) -> tuple[int, Place] | None:
        record = self._memory[slot * _SLOT : (slot + 1) * _SLOT]
        packed = record[: _PLACE.size]
        number, *place = _PLACE.unpack(packed)
        whole = _CHECKSUM.unpack(record[_PLACE.size :])[0] == zlib.crc32(packed)
        if not whole or number == 0 or not all(map(isfinite, place)):
            return None
        return number, (place[0], place[1], place[2])

    def write(self, pose: Pose) -> None:
        """Notes where the body is now."""
        self._number += 1
        packed = _PLACE.pack(self._number, pose.x, pose.y, pose.heading)
        start = self._number % 2 * _SLOT
        self._memory[start : start + _SLOT] = packed + _CHECKSUM.pack(zlib.crc32(packed))

    def close(self) -> None:
        self._memory.close()


class StandingBody(PlantBackend):
    """`body`, whose place is noted at every step."""

    def __init__(self, body: PlantBackend, standing: Standing) -> None:
        self._body, self._standing = body, standing

    def step(self, now_ns: int, command: Command | None) -> Reading:
        reading = self._body.step(now_ns, command)
        self._standing.write(reading.pose)
        return reading

    def close(self) -> None:
        self._body.close()
        self._standing.close()
