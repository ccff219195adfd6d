"""Work on its way to a worker's processes, and what comes back: nothing but bytes and plain answers.

The process that talks to the cluster never reads the work itself: plugins of a fleet are imported only in
processes that drive runs, from files that came along.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from handfast.deploy.console.wording import error_text
from handfast.deploy.simulate.worker_pool import GoOn, Work


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A run whose process died or was ended; arguments as of `Work.unfinished`."""

    reason: str
    wall_s: float
    timed_out: bool


@dataclass(frozen=True, slots=True)
class Unreadable:
    """A worker's process cannot read the work; `why` is one line."""

    why: str


class SentWork:
    """Work as bytes, which a worker's process reads when its first run comes. A `Work`.

    Args:
        data: of `pack`.
        folder: where the files of plugins lie that came along; None without any.
    """

    def __init__(self, data: bytes, folder: Path | None) -> None:
        self._data, self._folder = data, folder
        self._work: Work[Any] | None = None

    def execute(self, number: int, go_on: GoOn) -> object:
        """What the work makes of the run, or `Unreadable`."""
        if self._work is None:
            if self._folder is not None:
                sys.path.insert(0, str(self._folder))
            try:
                # What Dask itself does with all that it is sent: docs/sweep.md says whom a scheduler trusts.
                self._work = pickle.loads(self._data)  # noqa: S301
            except Exception as error:
                return Unreadable(error_text(error))
        assert self._work is not None
        return self._work.execute(number, go_on)

    def unfinished(self, _number: int, reason: str, wall_s: float, *, timed_out: bool) -> object:
        return Unfinished(reason, wall_s, timed_out)


def pack(work: Work[Any]) -> bytes:
    """Work as bytes."""
    return pickle.dumps(work)


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes files of plugins, by their names below a folder of packages.

    Raises:
        ValueError: a name leads out of the folder.
        OSError: one cannot be written.
    """
    for name, data in files.items():
        parts = PurePosixPath(name).parts
        if not parts or ".." in parts or name.startswith("/"):
            raise ValueError(f"{name}: not a name below a folder")
        path = folder.joinpath(*parts)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
