"""Columns of numbers that grow with a run. What they have collected can wait in a file, not in memory."""

from __future__ import annotations

import os
import sys
import tempfile
import weakref
from array import array
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray

ASIDE_BYTES: Final = 16_384
"""A column that holds less than this is left where it is."""

Code = Literal["q", "d", "H", "B"]
"""Of `array.array`: 64-bit integers, floats, 16-bit and 8-bit whole numbers."""


class Store:
    """Makes columns, and puts aside what they hold.

    Args:
        folder: where the file for it is made; it has no name and is gone with this process, however that
            ends. None: all stays in memory.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._file: BinaryIO | None = None
        self._columns: list[Column] = []

    def column(self, code: Code) -> Column:
        """A new, empty column."""
        made = Column(code, self)
        self._columns.append(made)
        return made

    def records(self) -> Records:
        """A new, empty column of records."""
        return Records(self.column("B"))

    def put_aside(self) -> None:
        """Moves what the columns hold into the file. Where that cannot be written, it stays in memory."""
        if self._folder is None:
            return
        try:
            for column in self._columns:
                column.put_aside()
        except OSError:
            self._folder = None

    def write(self, data: bytes) -> int:
        """Appends to the file; returns where it stands there.

        Raises:
            OSError: it cannot be written.
        """
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        start = self._file.seek(0, os.SEEK_END)
        if self._file.write(data) != len(data):
            raise OSError("the file takes no more")
        return start

    def read(self, start: int, size: int) -> bytes:
        """What was appended there."""
        assert self._file is not None
        self._file.seek(start)
        return self._file.read(size)


class Column:
    """Numbers in the order in which they came.

    Attributes:
        append, extend: those of `array.array`, at its speed.
        append_bytes: extends it by numbers as they are in memory.
    """

    __slots__ = ("_new", "_parts", "_store", "append", "append_bytes", "extend")

    def __init__(self, code: Code, store: Store) -> None:
        self._new: array[Any] = array(code)
        self._store = store
        self._parts: list[tuple[int, int]] = []
        self.append, self.extend, self.append_bytes = self._new.append, self._new.extend, self._new.frombytes

    def __len__(self) -> int:
        return sum(size for _, size in self._parts) // self._new.itemsize + len(self._new)

    def whole(self) -> NDArray[Any]:
        """All of them, (n,), in a copy."""
        data = bytearray()
        for part in self._parts:
            data += self._store.read(*part)
        data += self._new.tobytes()
        return np.frombuffer(data, dtype=np.dtype(self._new.typecode))

    def put_aside(self) -> None:
        """Moves what is in memory into the store's file, if it is worth it.

        Raises:
            OSError: it cannot be written; nothing has changed.
        """
        size = len(self._new) * self._new.itemsize
        if size >= ASIDE_BYTES:
            self._parts.append((self._store.write(self._new.tobytes()), size))
            del self._new[:]


class Records:
    """Rows of anything that MessagePack can hold, with texts as the keys of dictionaries."""

    def __init__(self, column: Column) -> None:
        self._column = column

    def append(self, record: Iterable[Any]) -> None:
        self._column.append_bytes(msgpack.packb(record))

    def whole(self) -> list[Any]:
        """All of them, with tuples for lists."""
        stream = BytesIO(self._column.whole().tobytes())
        return list(msgpack.Unpacker(stream, use_list=False, object_pairs_hook=_named))


def _named(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """A dictionary; of the same few names, which come thousands of times, one each is kept."""
    return {sys.intern(name): value for name, value in pairs}
