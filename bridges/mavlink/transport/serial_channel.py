"""A serial port as a channel: opened exclusively, and watched for what comes that is no MAVLink."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import termios
from typing import Final

from handfast.bridges.mavlink.transport import port_diagnosis
from handfast.bridges.mavlink.transport.channels import READ_BYTES, Stream, would_wait
from handfast.bridges.mavlink.transport.connection_string import Connection, Unusable
from handfast.bridges.mavlink.transport.line_contents import LineContents

QUEUE_S: Final = 0.25
"""More than this waiting in a serial port's buffer: what is sent would come too late, and is dropped."""
GONE: Final = "the device is gone"
_BITS: Final = 10


class Serial(Stream):
    """A serial device, opened so that no other program can.

    Raises:
        OSError: it cannot be opened; the text says why, and what to do.
    """

    def __init__(self, connection: Connection, baud: int) -> None:
        super().__init__()
        try:
            import serial
        except ModuleNotFoundError:
            raise Unusable("serial devices need pyserial: pip install 'handfast[rover]'") from None
        self._baud = baud
        device = connection.device
        found = port_diagnosis.before_opening(device)
        if found is not None:
            raise found.error
        try:
            self._port = serial.Serial(device, baud, timeout=0, exclusive=True)
        except serial.SerialException as error:
            raise port_diagnosis.refused(device, _number(error)).error from None
        except ValueError:
            raise Unusable(f"it cannot be set to {baud} baud") from None
        self._handle = self._port.fileno()
        with contextlib.suppress(OSError):  # pyserial's lock keeps only those out who ask for it
            fcntl.ioctl(self._handle, termios.TIOCEXCL)
        self._console = port_diagnosis.console_note(device)
        self._contents = LineContents(baud)

    @property
    def note(self) -> str:
        """See `Channel`."""
        return self._contents.note or self._console

    @property
    def trouble(self) -> str:
        """See `Channel`."""
        return self._contents.trouble

    def fileno(self) -> int:
        return int(self._handle)

    def read(self, now_ns: int) -> bytes:
        try:
            data = os.read(self._handle, READ_BYTES)
        except OSError as error:
            if would_wait(error):
                return b""
            raise OSError(GONE) from None
        if not data:  # readable, and yet nothing: that is how an unplugged one looks
            raise OSError(GONE)
        self._contents.take(now_ns, data)
        return data

    def look(self, now_ns: int) -> None:
        """See `Channel`."""
        self._contents.look(now_ns)

    def _put(self, data: bytes) -> int:
        try:
            if self._port.out_waiting * _BITS > self._baud * QUEUE_S:
                return 0
            return os.write(self._handle, data)
        except OSError as error:
            if would_wait(error):
                return 0
            raise OSError(GONE) from None

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


def _number(error: OSError) -> int:
    """The `errno` behind what pyserial raises."""
    cause = error.__context__
    if error.errno is None and isinstance(cause, termios.error):
        return int(cause.args[0])
    return error.errno or errno.EINVAL
