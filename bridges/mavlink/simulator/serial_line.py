"""A serial port of a simulated rover: a pseudo terminal under a name of its own, no faster than a line.

Whoever opens the name meets what a radio or a UART gives: bytes at the line's speed, none of what was said
before he came, and garbage when he reads at another speed.
"""

from __future__ import annotations

import errno
import fcntl
import os
import select
import struct
import sys
import termios
import tty
from collections.abc import Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Final, NamedTuple

from handfast.bridges.mavlink.simulator.settings import SettingsError
from handfast.bridges.mavlink.simulator.uart import HANDED_ON_NS, Wire, misread
from handfast.bridges.mavlink.transport.lock import lock_file

BAUD_MIN: Final = 1200
BAUD_MAX: Final = 4_000_000
SEND_ROOM: Final = 512
"""Of the vehicle's buffer, bytes: ArduPilot's HAL_UART_MIN_TX_SIZE. What does not fit is left out."""
RECEIVE_ROOM: Final = 4096
"""Of the driver's buffer at the other end, bytes: Linux's UART_XMIT_SIZE."""
PSEUDO_TERMINALS: Final = "/dev/pts/"
_TCGETS2: Final = 0x802C542A
_SPEED_AT: Final = 40


class SerialEndpoint(NamedTuple):
    """A serial port under the name `path`."""

    path: str
    baud: int

    @property
    def listens(self) -> bool:
        """As a port that others come to."""
        return True

    def __str__(self) -> str:
        return f"serial:{self.path}:{self.baud}"


def parse_serial(text: str) -> SerialEndpoint:
    """An endpoint of ``serial:PATH:BAUD``. Raises `SettingsError`."""
    path, _, digits = text.removeprefix("serial:").rpartition(":")
    if not (path.startswith("/") and path.isprintable() and digits.isascii() and digits.isdigit()):
        raise SettingsError(f"{text!r} is not serial:PATH:BAUD, as serial:/dev/shm/rover:57600")
    if not BAUD_MIN <= int(digits) <= BAUD_MAX:
        raise SettingsError(f"{text!r}: the speed is from {BAUD_MIN} to {BAUD_MAX} baud")
    return SerialEndpoint(path, int(digits))


def speed_of(terminal: int) -> int:
    """The speed that a terminal was set to, in baud; of a pseudo terminal, whichever end is asked."""
    if sys.platform != "linux":
        return int(termios.tcgetattr(terminal)[5])
    state = bytearray(44)
    fcntl.ioctl(terminal, _TCGETS2, state)
    (speed,) = struct.unpack_from("I", state, _SPEED_AT)
    return int(speed)


class SerialLine:
    """A `bridges.mavlink.simulator.sockets.Line` that others open as a serial port.

    Its own end is open only: so it is seen whether somebody has the other, and nobody takes this program for
    one that has.

    Raises:
        SettingsError: the name is taken, or cannot be made.
    """

    def __init__(self, endpoint: SerialEndpoint) -> None:
        self.endpoint = endpoint
        self.is_open = True  # a serial port does not know who listens
        self._out = Wire(endpoint.baud, SEND_ROOM)
        self._in = Wire(endpoint.baud, RECEIVE_ROOM)
        self._looked_ns, self._answered = 0, False
        self._lock = self._handle = -1
        try:
            mark = sha256(os.path.abspath(endpoint.path).encode()).hexdigest()[:16]
            self._lock = lock_file(f"rover-simulator-{mark}.lock")
            self._plug_in()
        except OSError as error:
            self._let_go()
            why = str(error) if error.errno is None else error.strerror
            raise SettingsError(f"cannot listen on {endpoint}: {why}") from None
        except SettingsError:
            self._let_go()
            raise

    def _plug_in(self) -> None:
        """Makes the port anew, under its name."""
        handle, other = os.openpty()
        try:
            tty.setraw(other)
            device = os.ttyname(other)
            _name(Path(self.endpoint.path), device)
        except BaseException:
            os.close(handle)
            raise
        finally:
            os.close(other)
        if self._handle >= 0:
            os.close(self._handle)
        os.set_blocking(handle, False)
        self._handle, self._device = handle, device
        self._poller = select.poll()
        self._poller.register(handle, 0)

    def _left(self) -> None:
        """Who had it has closed it. A real port forgets then that it was his alone, a pseudo terminal does
        not: it is told to, or, where this user may not, made anew.
        """
        with suppress(OSError):
            try:
                other = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            except OSError:
                self._plug_in()
            else:
                fcntl.ioctl(other, termios.TIOCNXCL)
                os.close(other)

    def watched(self) -> int:
        """See `Line`."""
        return self._handle

    @property
    def due_ns(self) -> int | None:
        """See `Line`: what somebody says is on its way from when he says it."""
        looks = self._looked_ns + HANDED_ON_NS if self._answered else None
        return min(
            (due for due in (self._out.due_ns, self._in.due_ns, looks) if due is not None), default=None
        )

    def receive(self, now_ns: int) -> bytes:
        """See `Line`; what was sent goes on its way, too."""
        self._deliver(now_ns)
        self._looked_ns = now_ns
        try:
            while data := os.read(self._handle, RECEIVE_ROOM):
                self._in.put(misread(data, speed_of(self._handle), self.endpoint.baud), now_ns)
        except OSError as error:
            answered = error.errno == errno.EAGAIN  # else nobody has opened it
            if self._answered and not answered:
                self._left()
            self._answered = answered
        return self._in.take(now_ns)

    def send(self, messages: Sequence[bytes], now_ns: int) -> None:
        """See `Line`."""
        self._deliver(now_ns)
        for message in messages:
            self._out.put(message, now_ns)

    def _deliver(self, now_ns: int) -> None:
        data = self._out.take(now_ns)
        if data and not self._poller.poll(0):  # POLLHUP: nobody has opened it
            with suppress(OSError):  # who does not read loses it
                os.write(self._handle, misread(data, self.endpoint.baud, speed_of(self._handle)))

    def restart(self) -> None:
        """See `Line`; the port stays, as one of a UART does."""
        self._out.clear()
        self._in.clear()

    def close(self) -> None:
        """See `Line`."""
        path = Path(self.endpoint.path)
        with suppress(OSError):
            if os.readlink(path) == self._device:
                path.unlink()
        self._let_go()

    def _let_go(self) -> None:
        for handle in (self._handle, self._lock):
            if handle >= 0:
                os.close(handle)
        self._handle = self._lock = -1


def _name(path: Path, device: str) -> None:
    """Makes `path` a link to `device`, in place of one of a simulator that was killed."""
    ours = path.is_symlink() and (os.readlink(path).startswith(PSEUDO_TERMINALS) or not path.exists())
    if os.path.lexists(path) and not ours:
        raise SettingsError(f"{path} is there, and is no link of a rover simulator: it is left as it is")
    new = path.with_name(f".{path.name}-{os.getpid()}")
    new.symlink_to(device)
    try:
        os.replace(new, path)
    except OSError:
        new.unlink()
        raise
