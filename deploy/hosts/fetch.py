"""Copies what robots recorded from their hosts: what is here already is not sent again."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any, Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.recorder.folder import FILE_NAME, number_of, recording_files
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.hosts.jobs import Row
from handfast.deploy.inventory.hosts import robots_on
from handfast.deploy.inventory.own_orders import cache_folder

PART_BYTES: Final = 1 << 20
SHARE_MAX: Final = 10
"""More than so many times what a robot's recording may take is not brought: the file may have allowed more
once, but no host may fill this disk."""

FILES_MAX: Final = 10_000
"""Of one robot so many files are brought, the newest: they are large as a rule, but each start of a recorder
begins another."""
NAME_BYTES: Final = 128
"""What a host says of one file."""
# A host that gives its recordings drop by drop does not keep the command from its end.
START_S: Final = 60.0
RATE_MIN: Final = 20_000
"""Bytes in a second."""
FILE_S: Final = 2.0

Listed = dict[str, tuple[int, float]]
"""Segments on a host, by name: size (bytes), when it was written to last (wall clock there, s)."""


class Fetching:
    """Brings the recordings of each host's robots into folders of their own, ``robot-N``.

    Recordings only grow at their end, and go as whole files: here is kept what is there. Nothing that a host
    says is believed: it names no place on this computer.

    Args:
        since_s: files that were not written to since then are left there.

    Attributes:
        folders: by robot, what was brought.
        fetched_before: robots of which that was some time ago.
    """

    def __init__(self, fleet: Fleet, since_s: float | None) -> None:
        self._fleet, self._since_s = fleet, since_s
        self._into = cache_folder("recordings") / fleet.fleet.name
        self.folders: dict[int, Path] = {}
        self.fetched_before: set[int] = set()
        self._not_kept: dict[int, str] = {}
        """By robot, why this computer cannot keep what its host gives."""

    def __call__(self, connection: HostConnection, row: Row) -> None:
        """Brings the recordings of one host's robots; see `deploy.hosts.jobs.Work`.

        Raises:
            handfast.deploy.hosts.connection.HostError: the connection was lost, a file cannot be read or
            kept, or the
                host says what cannot be.
        """
        got = 0
        for robot in robots_on(self._fleet, connection.host):
            try:
                got += self._bring(connection, row, robot)
            except OSError as error:
                why = f"this computer cannot keep it in {self._folder(robot)}: {error.strerror or error}"
                self._not_kept |= dict.fromkeys(robots_on(self._fleet, connection.host), why)
                raise HostError(why) from None
            self.folders[robot] = self._folder(robot)
        row.done(f"fetched {got / 1e6:.1f} MB")

    def fall_back(self, robot: int) -> str | None:
        """Takes a robot's recording as it was fetched before, since it was not brought now.

        Returns a warning, None where nothing was fetched before.
        """
        folder = self._folder(robot)
        try:
            fetched_s = folder.stat().st_mtime if recording_files(folder) else None
        except OSError:
            return None
        if fetched_s is None:
            return None
        self.folders[robot] = folder
        self.fetched_before.add(robot)
        why = self._not_kept.get(robot, "its host does not give it now")
        when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(fetched_s))
        return f"what robot {robot} recorded is as fetched at {when}: {why}"

    def _folder(self, robot: int) -> Path:
        return self._into / f"robot-{robot}"

    def _bring(self, connection: HostConnection, row: Row, robot: int) -> int:
        """Brings what is missing of one robot's recording; how much that was."""
        there = f"fleets/{self._fleet.fleet.name}/recordings/robot-{robot}"
        folder = self._folder(robot)
        folder.mkdir(parents=True, exist_ok=True)
        listed = self._listing(connection, robot, there)
        _remove_pruned(folder, listed)
        lacking = {
            name: size - _size(folder / name)
            for name, (size, written_s) in self._fitting(listed).items()
            if self._since_s is None or written_s >= self._since_s
        }
        got, total = 0, sum(max(0, each) for each in lacking.values())
        deadline_s = time.monotonic() + START_S + total / RATE_MIN + len(lacking) * FILE_S
        for name in lacking:
            row.step = f"robot {robot}: {got / 1e6:.0f} of {total / 1e6:.0f} MB"
            try:
                got += _copy(connection, f"{there}/{name}", folder / name, listed[name][0], deadline_s)
            except HostError:
                if time.monotonic() > deadline_s or name in self._listing(connection, robot, there):
                    raise
                # It has made room for newer ones meanwhile.
        os.utime(folder)  # when all of it was here: see `fall_back`
        return got

    def _listing(self, connection: HostConnection, robot: int, there: str) -> Listed:
        answer = connection.ask(
            "listing", folder=there, pattern="*.mcap", most=FILES_MAX, answer_bytes=FILES_MAX * NAME_BYTES
        )
        if not isinstance(answer, dict):
            raise HostError(f"does not say what robot {robot} recorded")
        if len(answer) > FILES_MAX:
            raise HostError(f"says that robot {robot} recorded {len(answer)} files, asked for {FILES_MAX}")
        # The name becomes that of a file here.
        listed: Listed = {
            name: _about(name, about) for name, about in answer.items() if FILE_NAME.fullmatch(name)
        }
        return listed

    def _fitting(self, listed: Listed) -> Listed:
        """Return the newest files that this computer takes; one too large costs no other its place."""
        found, left = {}, SHARE_MAX * self._fleet.recording.max_mb * 1_000_000
        for name in sorted(listed, reverse=True):
            if listed[name][0] <= left:
                found[name] = listed[name]
                left -= listed[name][0]
        return found


def _about(name: str, about: Any) -> tuple[int, float]:
    match about:
        case [int(size), int() | float() as written_s] if 0 <= size < 2**63:
            return size, written_s
    raise HostError(f"says nonsense of {name}: {str(about)[:100]}")


def _remove_pruned(folder: Path, listed: Listed) -> None:
    """Remove copies of files that are older than all files there: those made room for newer ones. Where
    nothing is there, as on a new SD card, these copies are all that there is."""
    oldest = min((number_of(Path(name)) or 0 for name in listed), default=0)
    for path in recording_files(folder):
        if (number_of(path) or 0) < oldest:
            path.unlink()


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _copy(connection: HostConnection, there: str, here: Path, size: int, deadline_s: float) -> int:
    """Brings what is missing of one file until a time by the monotonic clock; how much that was."""
    begun = _size(here)
    if begun > size:
        begun = 0  # another file of that name
    got = 0
    with open(here, "r+b" if begun else "wb") as stream:
        stream.seek(begun)
        stream.truncate()
        while begun + got < size:
            most = min(PART_BYTES, size - begun - got)
            if time.monotonic() > deadline_s:
                raise HostError(f"is too slow: less than {RATE_MIN // 1000} kB/s came")
            offset = begun + got
            _, data = connection.exchange("get", None, data_bytes=most, path=there, offset=offset, most=most)
            stream.write(data)
            got += len(data)
            if len(data) < most:
                break  # it is shorter by now
    return got
