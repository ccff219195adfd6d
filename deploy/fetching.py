"""Copies what robots recorded from their hosts: what is here already is not sent again."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from agent.fleet import Fleet
from deploy.host_connection import HostConnection
from deploy.hosts import robots_on
from deploy.hosts_view import Row

PART_BYTES: Final = 1 << 20


def cache_folder(fleet: str) -> Path:
    """Where copies are kept, so that another fetch brings what is new only."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "handfast" / "recordings" / fleet


class Fetching:
    """Brings the recordings of each host's robots into folders of their own, ``robot-N``.

    Recordings only grow at their end, and go as whole files: here is kept what is there.

    Args:
        since_s: files that were not written to since then are left there.
    """

    def __init__(self, fleet: Fleet, into: Path, since_s: float | None) -> None:
        self._fleet, self._into, self._since_s = fleet, into, since_s
        self.folders: dict[int, Path] = {}

    def __call__(self, connection: HostConnection, row: Row) -> None:
        """Brings those of one host; see `deploy.host_jobs.Work`.

        Raises:
            deploy.host_connection.HostError: the connection was lost, or a file cannot be read.
        """
        robots = robots_on(self._fleet, connection.host)
        got = 0
        for robot in robots:
            there = f"fleets/{self._fleet.fleet.name}/recordings/robot-{robot}"
            files = connection.ask("listing", folder=there, pattern="*")
            folder = self._into / f"robot-{robot}"
            folder.mkdir(parents=True, exist_ok=True)
            for path in folder.iterdir():
                if path.name not in files:
                    path.unlink()  # it went there to make room for newer ones
            wanted = {
                name: size
                for name, (size, written_s) in files.items()
                if self._since_s is None or written_s >= self._since_s
            }
            total = sum(wanted.values())
            for name, size in wanted.items():
                row.step = f"robot {robot}: {got / 1e6:.0f} of {total / 1e6:.0f} MB"
                got += self._copy(connection, f"{there}/{name}", folder / name, size)
            self.folders[robot] = folder
        row.done(f"fetched {got / 1e6:.1f} MB")

    @staticmethod
    def _copy(connection: HostConnection, there: str, here: Path, size: int) -> int:
        """Brings what is missing of one file; how much that was."""
        begun = here.stat().st_size if here.exists() else 0
        if begun > size:
            begun = 0  # another file of that name
        got = 0
        with open(here, "r+b" if begun else "wb") as stream:
            stream.seek(begun)
            stream.truncate()
            while begun + got < size:
                most = min(PART_BYTES, size - begun - got)
                _, data = connection.exchange("get", None, path=there, offset=begun + got, most=most)
                if not data:
                    break
                stream.write(data)
                got += len(data)
        return got
