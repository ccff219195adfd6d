"""Ports for a fleet on this machine: free now, and not taken by another run between now and its start."""

from __future__ import annotations

import fcntl
import os
import socket
from typing import Final

from handfast.agent.common.errors import Error
from handfast.agent.fleet.hosts import PORT_MAX
from handfast.agent.runtime.runtime_folder import NotPrivateError, private_folder

BLOCK: Final = 128
"""Ports are reserved in blocks of this many."""


class NoPortsError(Error, RuntimeError):
    """No run of free ports is left."""


def _free(address: str, port: int) -> bool:
    """Whether nobody has the port, for TCP or UDP."""
    with socket.socket() as stream, socket.socket(type=socket.SOCK_DGRAM) as datagram:
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            stream.bind((address, port))
            datagram.bind((address, port))
        except OSError:
            return False
    return True


class Reservation:
    """`count` ports in a row on `address`, from `base` or the next free place after it.

    Between runs on one machine a lock on the block of ports decides, held until `close` or the
    end of the process; other programs are found by trying the ports.

    Raises:
        NoPortsError: when there is no room up to `PORT_MAX`.
    """

    def __init__(self, address: str, base: int, count: int) -> None:
        self._locks: list[int] = []
        first = base
        while base + count - 1 <= PORT_MAX:
            if self._lock(base, count):
                if all(_free(address, port) for port in range(base, base + count)):
                    self.base = base
                    return
                self.close()
            base += BLOCK
        raise NoPortsError(
            f"no {count} free ports in a row from {first} to {PORT_MAX} on {address}: "
            "end other runs, or set a lower [network] base_port"
        )

    def _lock(self, base: int, count: int) -> bool:
        try:
            folder = private_folder()
        except NotPrivateError as error:
            raise NoPortsError(str(error)) from None
        for block in range(base // BLOCK, (base + count - 1) // BLOCK + 1):
            handle = os.open(folder / f"ports-{block}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            self._locks.append(handle)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                self.close()
                return False
        return True

    def close(self) -> None:
        """Gives the ports back."""
        for handle in self._locks:
            os.close(handle)
        self._locks.clear()
