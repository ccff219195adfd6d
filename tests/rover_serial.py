"""A serial cable of a simulated rover: a pseudo terminal under a name of its own, joined to a TCP port.

python rover_serial.py PATH PORT
"""

from __future__ import annotations

import fcntl
import os
import select
import socket
import struct
import sys
import threading
import tty
from contextlib import suppress
from pathlib import Path

LOOK_MS = 10
READ_BYTES = 4096
FRAME_BITS = 10
"""A start bit, eight of data, a stop bit."""
_TCGETS2, _SPEED_AT = 0x802C542A, 40


class SerialCable:
    """Joins the port `path` to a TCP port of this machine, from `plug_in` until `unplug`.

    A program that closes the port leaves a new pseudo terminal: a real port forgets its exclusive lock.

    Args:
        baud: speed of the rover's end; a program that reads at another speed gets garbage. None: any.
    """

    def __init__(self, path: Path, port: int, baud: int | None = None) -> None:
        self.baud = baud
        self._path, self._port = path, port
        self._master = -1
        self._rover: socket.socket | None = None
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def plug_in(self) -> None:
        """Make the port, and carry bytes in a thread."""
        self._ended.clear()
        self._make_port()
        self._thread = threading.Thread(target=self.carry, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Remove the port: the program that has it open loses it."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(5.0)
            self._thread = None
        self._path.unlink(missing_ok=True)
        if self._master >= 0:
            os.close(self._master)
        if self._rover is not None:
            self._rover.close()
        self._master, self._rover = -1, None

    def carry(self) -> None:
        """Carry bytes both ways until `unplug`."""
        if self._master < 0:
            self._make_port()
        opened = False
        while not self._ended.is_set():
            rover = self._rover or self._connect()
            poll = select.poll()
            poll.register(self._master, select.POLLIN)
            if rover is not None:
                poll.register(rover, select.POLLIN)
            events = dict(poll.poll(LOOK_MS))
            closed = events.get(self._master, 0) & select.POLLHUP
            if closed or rover is None:
                self._ended.wait(LOOK_MS / 1e3)  # POLLHUP is there at once, again and again
            if closed and opened:
                self._make_port()
            opened = not closed
            if rover is not None and rover.fileno() in events:
                self._from_rover(rover, opened=opened)
            if opened and self._master in events:
                self._to_rover(rover)

    def _from_rover(self, rover: socket.socket, *, opened: bool) -> None:
        data = b""
        with suppress(OSError):
            data = rover.recv(READ_BYTES)
        if not data:
            rover.close()
            self._rover = None
        elif opened:
            speed = speed_of(self._master)
            with suppress(OSError):  # what a program does not read is lost
                os.write(self._master, misread(data, self.baud or speed, speed))

    def _to_rover(self, rover: socket.socket | None) -> None:
        with suppress(OSError):
            data, speed = os.read(self._master, READ_BYTES), speed_of(self._master)
            if rover is not None:
                rover.sendall(misread(data, speed, self.baud or speed))

    def _connect(self) -> socket.socket | None:
        with suppress(OSError):
            self._rover = socket.create_connection(("127.0.0.1", self._port), 1.0)
        return self._rover

    def _make_port(self) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        new = self._path.with_name(f".{self._path.name}-{os.getpid()}")
        new.symlink_to(os.ttyname(slave))
        new.replace(self._path)
        os.close(slave)
        os.set_blocking(master, False)
        if self._master >= 0:
            os.close(self._master)
        self._master = master


def speed_of(terminal: int) -> int:
    """Return the speed that either end of a pseudo terminal was set to, in baud."""
    state = bytearray(44)
    fcntl.ioctl(terminal, _TCGETS2, state)
    (speed,) = struct.unpack_from("I", state, _SPEED_AT)
    return int(speed)


def misread(data: bytes, sent: int, read: int) -> bytes:
    """Return the bytes that a receiver at `read` baud finds in `data` sent at `sent` baud.

    It samples as a UART does, from the edge of a start bit, and ignores a missing stop bit.
    """
    if sent == read:
        return data
    bits = [bit for byte in data for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]
    step = sent / read
    out = bytearray()
    at = 0.0

    def level(place: float) -> int:
        return bits[int(place)] if place < len(bits) else 1

    while at < len(bits):
        if level(at):
            at = int(at) + 1.0
            continue
        out.append(sum(level(at + step * (1.5 + k)) << k for k in range(8)))
        at += step * (FRAME_BITS - 0.5)
        while not level(at):
            at = int(at) + 1.0
    return bytes(out)


if __name__ == "__main__":
    SerialCable(Path(sys.argv[1]), int(sys.argv[2])).carry()
