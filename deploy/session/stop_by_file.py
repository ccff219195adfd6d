"""The way of a stop that needs no link: the file that the robots of this machine look for."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import Resume, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.runtime.order_store import (
    FILE_BYTES_MAX,
    STOP_FILE,
    OrderFileError,
    order_file,
    packed,
    unpacked,
)
from handfast.agent.security.private_files import KeyFileError, exists, read, write
from handfast.agent.security.sealed_order import Forged, payload_of
from handfast.agent.supervision.state_machine import State
from handfast.deploy.check.network import sharing
from handfast.deploy.orders.stop_outcome import PLANT_BRAKES, Stopping
from handfast.deploy.session.operator_bus import sealed

WAY: Final = "by a file on this machine"


def kept_versions(orders: Iterable[bytes], *, is_secured: bool) -> tuple[int, int]:
    """The greatest versions of the stops, and of the resumes, among kept orders; -1 without any."""
    found = list(_stops(orders, is_secured))
    stops = [each.version for each in found if isinstance(each, Stop)]
    return max(stops, default=-1), max((e.version for e in found if isinstance(e, Resume)), default=-1)


def _stops(orders: Iterable[bytes], is_secured: bool) -> Iterator[Stop | Resume]:
    for order in orders:
        try:
            message = decode(payload_of(order) if is_secured else order)
        except (Forged, Malformed):
            continue
        if isinstance(message, Stop | Resume):
            yield message


class FileWay:
    """The robots of `fleet` on this machine, which keep their orders in `folder`."""

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        self._fleet, self._folder = fleet, folder
        self._found: set[tuple[int, str]] = set()
        # Bodies that share a process have what it keeps under the name of the first.
        self._keeps = {robot: part[0] for part in sharing(fleet) for robot in part}
        self.troubles: list[str] = []

    def send(self, stop: Stop) -> None:
        """See `deploy.session.stop.Way`."""
        self._found.clear()
        try:
            write(self._folder / STOP_FILE, packed([sealed(self._fleet, encode(stop))]), private=True)
        except (KeyFileError, ValueError) as error:
            self.troubles = [f"not {WAY}: {error}"]

    def collect(self, stopping: Stopping) -> None:
        """Tells who has kept the stop: who does has obeyed it, if no later resume is kept beside it."""
        of_pools: dict[int, tuple[int, int]] = {}
        for robot in self._fleet.ids:
            for role in ROLES:
                if (robot, role) in self._found:
                    continue
                if role == "plant" and (first := self._keeps.get(robot)) is not None:
                    if first not in of_pools:
                        of_pools[first] = self._kept_versions(first, role)
                    stop, resume = of_pools[first]
                else:
                    stop, resume = self._kept_versions(robot, role)
                if stop < stopping.message.version:
                    continue
                if resume > stop:  # it is to be outdone
                    stopping.found(time.time_ns(), robot, role, "", resume, WAY)
                    continue
                self._found.add((robot, role))
                state = State.STOPPING.value if role == "agent" else PLANT_BRAKES
                stopping.found(time.time_ns(), robot, role, state, stop, WAY)

    def _kept_versions(self, robot: int, role: str) -> tuple[int, int]:
        return kept_versions(self._kept(robot, role), is_secured=self._fleet.is_secured)

    def _kept(self, robot: int, role: str) -> Sequence[bytes]:
        path = order_file(self._folder, robot, role)
        try:
            return unpacked(read(path, most=FILE_BYTES_MAX)) if exists(path) else ()
        except (KeyFileError, OrderFileError):
            return ()

    @property
    def busy(self) -> bool:
        """See `deploy.session.stop.Way`."""
        return False

    def close(self) -> None:
        """See `deploy.session.stop.Way`: the file stays, for who starts again."""
