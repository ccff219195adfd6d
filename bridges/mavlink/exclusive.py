"""One bridge to a connection: a lock among the programs of one user on one machine."""

from __future__ import annotations

import fcntl
import os
import re
import stat
import tempfile
from hashlib import sha256
from pathlib import Path

from bridges.mavlink.connection import Connection


class InUse(OSError):
    """Another process has it; the text names that process."""


def _folder() -> Path:
    """A folder that nobody else may write to, or names in it would be anybody's to take."""
    folder = Path(tempfile.gettempdir()) / f"handfast-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise OSError(f"{folder} must be a folder that only this user may write to: remove it")
    return folder


def _name(connection: Connection) -> str:
    """The same for all ways to write one connection, as far as can be told."""
    if connection.kind == "serial":
        text = os.path.realpath(connection.device)
    else:
        text = connection.text.replace(":localhost:", ":127.0.0.1:")
    readable = re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")[-60:]
    return f"{readable}-{sha256(text.encode()).hexdigest()[:8]}.lock"


class Hold:
    """A connection held until `close`, or until the process ends, however it ends.

    Raises:
        InUse: another bridge has it.
        OSError: there is no private folder for locks.
    """

    def __init__(self, connection: Connection) -> None:
        path = _folder() / _name(connection)
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.pread(self._handle, 20, 0).decode("ascii", errors="replace").strip()
            os.close(self._handle)
            whose = f" (process {holder})" if holder.isdigit() else ""
            raise InUse(f"another handfast program uses it{whose}") from None
        os.ftruncate(self._handle, 0)
        os.pwrite(self._handle, f"{os.getpid()}\n".encode("ascii"), 0)

    def close(self) -> None:
        """Lets go. The file stays: to remove it would be a race with the next holder."""
        os.close(self._handle)
