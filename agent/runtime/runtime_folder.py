"""The folder on this machine in which one user's processes find each other: locks, lists, no secrets."""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path


class NotPrivateError(OSError):
    """What is there is no folder, or others may write to it; the text says what to do."""


def private_folder() -> Path:
    """The folder, made if need be. Nobody else may write there, or names in it would be anybody's to take.

    Raises:
        NotPrivateError: somebody else may, or it is no folder.
    """
    folder = Path(tempfile.gettempdir()) / f"handfast-{os.getuid()}"
    with suppress(FileExistsError):  # a file, or a link to nowhere: refused below
        folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise NotPrivateError(
            f"{folder} must be a folder of this user that nobody else may write to: remove it, "
            "or make it so (chmod 700)"
        )
    return folder
