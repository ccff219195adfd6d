"""The command line of this process as others see it: ps, pkill, and `deploy.processes.table`.

A process that is forked has that of its parent. The kernel shows the memory in which the arguments were
handed over (proc(5)), so what is written there is what is seen; there is no more room than they had.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from os import fsencode
from pathlib import Path
from typing import Final

ROOM: Final = 1 << 14
"""Bytes that the command line of a process is made long that forks others, for theirs."""
_ARG_START: Final = 48
"""Of the fields in /proc/PID/stat, as proc(5) counts them; the next one is the end."""


def words_of(module: str, arguments: Sequence[str]) -> list[str]:
    """The command line of a program of ours."""
    # -P: a folder called `agent` in the working directory must not be taken for the package.
    return [sys.executable, "-P", "-m", module, *arguments]


def area() -> tuple[int, int]:
    """Address and size (bytes) of the memory of this process's arguments, (0, 0) where that is not known."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()  # from the third on
        begin, end = (int(field) for field in fields[_ARG_START - 3 : _ARG_START - 1])
    except (OSError, ValueError):
        return 0, 0
    return (begin, end - begin) if 0 < begin < end else (0, 0)


def room(words: Sequence[str]) -> int:
    """How many bytes a command line takes."""
    return sum(len(fsencode(word)) + 1 for word in words)


def show(words: Sequence[str]) -> None:
    """Has this process seen under the command line `words`.

    Raises:
        ValueError: there is no room for it.
    """
    import ctypes  # here: who only looks need not wait for it

    begin, size = area()
    text = b"".join(fsencode(word) + b"\0" for word in words)
    if len(text) > size:
        raise ValueError(f"a command line of {len(text)} bytes does not fit into {size}")
    ctypes.memmove(begin, text.ljust(size, b"\0"), size)
