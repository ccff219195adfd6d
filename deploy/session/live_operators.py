"""The way of a stop over links that are open already: those of an operator's command that lasts.

Who drives a fleet (`handfast run`, `drive`), or sends it heartbeats, has links to all of its processes, when
no new one opens any more. It listens on a socket in this user's private folder: whoever may write there gives
it a stop, which it says on its own links, and is told what robots say then.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

import msgpack

from handfast.agent.common.closing import Closing
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import BYTES_MAX, PlantState, Status, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.runtime.order_store import NotPrivateError, private_folder
from handfast.deploy.orders.stop_outcome import Stopping, again_s
from handfast.deploy.processes.placement import mark

WAY: Final = "over the links of a live operator"
_PREFIX: Final = "live"
_OF_PROCESS: Final = re.compile(r"(?:live-[0-9a-f]+|asks)-(\d{1,9})(?:-[0-9a-f]+)?\.sock")
_DATAGRAM_MAX: Final = 2 * BYTES_MAX
FOLLOW_S: Final = 3.0
"""So long a stop is said again, and is told what comes back."""
TAKEN_MAX: Final = 16
"""Datagrams that are looked at in one step."""


class Publisher(Protocol):
    """A bus with links to all of the fleet, on which the key of the stop is declared."""

    def publish(self, key: str, payload: bytes) -> None: ...


def _name(fleet: Fleet) -> str:
    return f"{_PREFIX}-{mark(fleet)[:8]}"  # the path of a socket has no more than some 100 bytes


def _tidy(folder: Path) -> None:
    """Removes sockets of processes that were killed: their names hold the process's number."""
    for path in folder.glob("*.sock"):
        found = _OF_PROCESS.fullmatch(path.name)
        if found is None:
            continue
        try:
            os.kill(int(found[1]), 0)
        except ProcessLookupError:
            path.unlink(missing_ok=True)
        except OSError:
            continue


def _socket() -> socket.socket:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    made.setblocking(False)
    return made


class StopDoor(Closing):
    """Where a command that has links to `fleet` takes stops from other commands of this user, and passes them
    on over `bus`. A context manager. Without a private folder there is none.
    """

    def __init__(self, fleet: Fleet, bus: Publisher) -> None:
        self._bus, self._key = bus, key_expressions.stop(fleet.fleet.name)
        self._told = frozenset(
            key
            for robot in fleet.ids
            for key in (
                key_expressions.status(fleet.fleet.name, robot),
                key_expressions.plant_state(fleet.fleet.name, robot),
            )
        )
        self._path: Path | None = None
        self._stops: dict[str, tuple[bytes, float]] = {}
        """By who gave it: a stop, and until when it is said."""
        self._again_s, self._pause_s = 0.0, again_s(fleet)
        self._socket = _socket()
        with suppress(OSError, NotPrivateError):
            _tidy(private_folder())
            path = private_folder() / f"{_name(fleet)}-{os.getpid()}.sock"
            path.unlink(missing_ok=True)  # of a process of the same number that was killed
            self._socket.bind(str(path))
            self._path = path

    def close(self) -> None:
        """Takes none any more."""
        self._socket.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def step(self) -> list[Stop]:
        """Takes what has come, and says what is to be said; gives the stops that are new."""
        if self._path is None:
            return []
        new = []
        for _ in range(TAKEN_MAX):
            try:
                payload, sender = self._socket.recvfrom(_DATAGRAM_MAX)
                message = decode(payload)
            except Malformed:
                continue
            except OSError:
                break
            if isinstance(message, Stop):
                if payload != self._stops.get(sender, (b"", 0.0))[0]:
                    new.append(message)
                    self._again_s = 0.0
                self._stops[sender] = payload, time.monotonic() + FOLLOW_S
        now_s = time.monotonic()
        if self._stops and now_s >= self._again_s:
            self._again_s = now_s + self._pause_s
            self._stops = {sender: stop for sender, stop in self._stops.items() if now_s < stop[1]}
            for payload, _ in self._stops.values():
                self._bus.publish(self._key, payload)
        return new

    def heard(self, key: str, payload: bytes) -> None:
        """Passes on what a robot says to those whose stop is being said."""
        if not self._stops or key not in self._told:
            return
        data = msgpack.packb((key, payload))
        for sender in self._stops:
            with suppress(OSError):  # it has ended, or is slow: what comes next says the same
                self._socket.sendto(data, sender)


class LiveWay:
    """The way over the links of live operators of `fleet`, if there are any on this machine."""

    troubles: Sequence[str] = ()

    def __init__(self, fleet: Fleet) -> None:
        self._doors: list[Path] = []
        self._path: Path | None = None
        self._socket = _socket()
        with suppress(OSError, NotPrivateError):
            folder = private_folder()
            self._doors = list(folder.glob(f"{_name(fleet)}-*.sock"))
            path = folder / f"asks-{os.getpid()}-{id(self):x}.sock"
            path.unlink(missing_ok=True)
            self._socket.bind(str(path))
            self._path = path
            for size in (socket.SO_RCVBUF, socket.SO_SNDBUF):
                self._socket.setsockopt(socket.SOL_SOCKET, size, 1 << 20)

    def send(self, stop: Stop) -> None:
        """See `deploy.session.stop.Way`."""
        for door in self._doors:
            try:
                self._socket.sendto(encode(stop), str(door))
            except ConnectionRefusedError:
                door.unlink(missing_ok=True)  # of one that was killed
            except OSError:
                continue

    def collect(self, stopping: Stopping) -> None:
        """See `deploy.session.stop.Way`."""
        now_ns = time.time_ns()
        for key, message in self._heard():
            stopping.feed(now_ns, key, message, WAY)

    def _heard(self) -> Iterator[tuple[str, Status | PlantState]]:
        while True:
            try:
                key, payload = msgpack.unpackb(self._socket.recv(_DATAGRAM_MAX))
                message = decode(payload)
            except OSError:
                return
            except (ValueError, TypeError):
                continue
            if isinstance(message, Status | PlantState):
                yield key, message

    @property
    def busy(self) -> bool:
        """See `deploy.session.stop.Way`."""
        return False

    def close(self) -> None:
        """See `deploy.session.stop.Way`."""
        self._socket.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)
