"""Folders that commands make: caches, what is remembered, and what ``--out`` names."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from itertools import chain, count
from pathlib import Path

from handfast.deploy.console.arguments import InputError


def cache_folder(kind: str) -> Path:
    """Where this user keeps what need not be fetched again."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "handfast" / kind


def state_folder(kind: str) -> Path:
    """Where this user keeps what later commands must know."""
    base = os.environ.get("XDG_STATE_HOME", "")
    root = Path(base) if base.startswith("/") else Path.home() / ".local" / "state"
    return root / "handfast" / kind


def out_folder(out: str | Path | None, name: str, above: str = "runs") -> Path:
    """The folder that is named, or one of a name and the time, that is not there yet: two drives may begin
    within a second."""
    if out:
        return Path(out)
    base = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    names = chain([base], (f"{base}-{number}" for number in count(2)))
    return next(path for each in names if not (path := Path(above) / each).exists())


def refuse_unwritable(out: Path) -> None:
    """Refuses a folder that can be neither made nor written into, and leaves none; raises `InputError`."""
    path = out.absolute()
    new = [each for each in (path, *path.parents) if not os.path.lexists(each)]
    try:
        path.mkdir(parents=True, exist_ok=True)
        writable = os.access(path, os.W_OK | os.X_OK)
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise InputError(f"cannot make the folder {out}: {why}: name another one with --out") from None
    finally:
        for each in new:
            with suppress(OSError):
                each.rmdir()
    if not writable:
        raise InputError(f"cannot write into {out}: name another folder with --out")


def refuse_full(out: Path) -> None:
    """Refuses what is there and no empty folder; raises `InputError`."""
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out} is not an empty folder: name another one with --out, or remove it")
    except OSError as error:
        raise InputError(f"cannot look into {out}: {(error.strerror or str(error)).lower()}") from None
