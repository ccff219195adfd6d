"""Files that hold keys, for this user alone, and written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path
from typing import Final

BYTES_MAX: Final = 65_536
"""Of a file that is no list: keys and certificates are far smaller."""


def home_folder() -> Path:
    """This user's home. A user without one, as in many containers, gets a folder that does not exist: there
    is nothing in it, and writing to it fails with a reason."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/nonexistent")


class KeyFileError(ValueError):
    """A file or folder that cannot be used; the text says what to do, and never what is in it."""


def private_directory(path: Path) -> None:
    """Makes the folder, if need be, for this user alone; those above it, as the user makes folders.

    Raises:
        KeyFileError: it cannot be made, or others can look into it.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.stat()
    except OSError as error:
        raise KeyFileError(f"cannot make the folder {path}: {reason(error)}") from None
    if found.st_uid != os.getuid():
        raise KeyFileError(f"the folder {path} must belong to the user who starts this")
    if found.st_mode & 0o077:
        raise KeyFileError(f"others may look into {path}, which is for private keys: chmod 700 {path}")


def exists(path: Path) -> bool:
    """Whether it is there. `KeyFileError` when that cannot be found out."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise KeyFileError(f"cannot look for {path}: {reason(error)}") from None
    return True


def read(path: Path, *, private: bool = False, most: int = BYTES_MAX) -> bytes:
    """The bytes of a file.

    Args:
        private: it holds a private key, which others must not be able to read.
        most: the largest size that it may have.

    Raises:
        KeyFileError: it is not there, not a plain file, too large, or others may read or change it.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise KeyFileError(f"cannot read {path}: {reason(error)}") from None
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise KeyFileError(f"{path} must be a plain file")
        if found.st_uid not in (os.getuid(), 0):
            raise KeyFileError(f"{path} must belong to the user who starts this")
        if private and found.st_mode & 0o077:
            raise KeyFileError(f"others may read the private key {path}: chmod 600 {path}")
        if found.st_mode & 0o022:
            raise KeyFileError(f"others may change {path}: chmod go-w {path}")
        if found.st_size > most:
            raise KeyFileError(f"{path} has {found.st_size} bytes, more than it can have: put it away")
        return os.read(handle, most)
    finally:
        os.close(handle)


def write(path: Path, data: bytes, *, private: bool = False) -> None:
    """Writes a file, also over one that is there.

    Raises:
        KeyFileError: it cannot be written; what was there is then still there.
    """
    new = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        new.unlink(missing_ok=True)  # of a process of the same number that was killed
        handle = os.open(
            new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600 if private else 0o644
        )
        try:
            with open(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(handle)
            new.replace(path)
        except OSError:
            new.unlink(missing_ok=True)
            raise
        _sync(path.parent)
    except OSError as error:
        raise KeyFileError(f"cannot write {path}: {reason(error)}") from None


def move(source: Path, target: Path) -> None:
    """Renames a file, over `target` if that is there. `KeyFileError` when it cannot."""
    try:
        source.replace(target)
        _sync(target.parent)
    except OSError as error:
        raise KeyFileError(f"cannot write {target}: {reason(error)}") from None


def reason(error: OSError) -> str:
    """Why the system refused, in its own words."""
    return (error.strerror or str(error)).lower()


def _sync(folder: Path) -> None:
    with contextlib.suppress(OSError):  # some file systems cannot sync a folder
        handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
