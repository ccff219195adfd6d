"""Locks a connection for one bridge, among the programs of one user on one machine."""

from __future__ import annotations

import fcntl
import os
import re
from hashlib import sha256

from handfast.agent.runtime.runtime_folder import private_folder
from handfast.bridges.mavlink.transport.connection_string import Connection, Unusable


class InUse(Unusable):
    """Another process has it; the text names that process."""


def _name(connection: Connection, system: int | None) -> str:
    """Name of the lock's file: the same for all ways to write one connection, as far as can be known."""
    if connection.kind == "serial":
        text = os.path.realpath(connection.device)
    else:
        text = connection.text.replace(":localhost:", ":127.0.0.1:")
        if connection.kind != "udpin" and system is not None:
            text += f"-system-{system}"
    readable = re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")[-60:]
    return f"{readable}-{sha256(text.encode()).hexdigest()[:8]}.lock"


def lock_file(name: str) -> int:
    """Handle of the lock file `name` of this user, which is locked until that is closed, or the process ends,
    however it ends. The file stays: to remove it would be a race with the next holder.

    Raises:
        InUse: another process has it.
        OSError: there is no private folder for locks.
    """
    handle = os.open(private_folder() / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        holder = os.pread(handle, 20, 0).decode("ascii", errors="replace").strip()
        os.close(handle)
        whose = f" (process {holder})" if holder.isdigit() else ""
        raise InUse(f"another handfast program uses it{whose}") from None
    os.ftruncate(handle, 0)
    os.pwrite(handle, f"{os.getpid()}\n".encode("ascii"), 0)
    return handle


class ConnectionLock:
    """The lock of a connection, held until `close`, or until the process ends, however it ends.

    Args:
        system: which vehicle behind it is meant, where that is said. A router serves several bridges at one
            place, each for a vehicle of its own; a serial port or a listening one can be had once only.

    Raises:
        InUse: another bridge has it.
        OSError: there is no private folder for locks.
    """

    def __init__(self, connection: Connection, system: int | None = None) -> None:
        self._handle = lock_file(_name(connection, system))

    def close(self) -> None:
        """Lets go."""
        os.close(self._handle)
