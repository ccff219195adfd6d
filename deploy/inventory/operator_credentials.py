"""Where an operator's credentials are on this machine, and those of earlier authorities, until they are no
longer needed.

A robot believes one authority. When that is replaced, and until `handfast up` has reached every robot, some
have the new one and some still the one before: an operator who is to stop all of them needs credentials of
both. So the folder as it was is kept, in ``earlier/``, by the fingerprint of its authority.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Final

from handfast.agent.security import private_files
from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE, authority_of
from handfast.agent.security.identity import MAIN

OPERATOR: Final = "HANDFAST_OPERATOR"
KEYS: Final = "HANDFAST_KEYS"
"""Variables of the environment: who gives orders here, and the folder of that operator's keys."""
AUTHORITY_FILE: Final = "authority.pem"
"""Key and certificate of the authority, where it is on this machine."""
SHORT: Final = 16
"""So many digits of a fingerprint tell authorities apart, for people and in names of folders."""
_EARLIER: Final = "earlier"
_FORMER: Final = "former"
_KEPT: Final = ("*.operator.*.key", "*.operator.*.crt", "*.router.*.key", "*.router.*.crt")


def keys_folder(fleet: str) -> Path:
    """Where the keys of a fleet are: as the environment says, else in the user's folder for configuration."""
    given = os.environ.get(KEYS, "")
    if given:
        return Path(given).expanduser()
    base = os.environ.get("XDG_CONFIG_HOME", "")
    root = Path(base) if base.startswith("/") else Path.home() / ".config"
    return root / "handfast" / "keys" / fleet


def operator_name() -> str:
    """Who gives orders here."""
    return os.environ.get(OPERATOR, "") or MAIN


def short(digits: str) -> str:
    """A fingerprint as people compare it."""
    return digits[:SHORT]


def keep_as_earlier(folder: Path) -> None:
    """Keeps what is in `folder`, before another authority takes the place of the one that is known there.

    Raises:
        handfast.agent.security.private_files.KeyFileError: it cannot be read or written.
    """
    known = authority_of(folder)
    _keep_certificate(folder, short(known))
    target = folder / _EARLIER / short(known)
    if not known or private_files.exists(target):
        return
    private_files.private_directory(target.parent)
    new = target.with_name(f".{target.name}.new")
    shutil.rmtree(new, ignore_errors=True)  # what was interrupted
    private_files.private_directory(new)
    names = [AUTHORITY_FILE, AUTHORITY_CERTIFICATE]
    names += [path.name for pattern in _KEPT for path in folder.glob(pattern) if ".next." not in path.name]
    for name in names:
        if private_files.exists(folder / name):
            private = name.endswith((".key", ".pem"))
            data = private_files.read(folder / name, private=private)
            private_files.write(new / name, data, private=private)
    private_files.move(new, target)


def _keep_certificate(folder: Path, name: str) -> None:
    """Keeps an authority's certificate for good: what was sealed under it is in recordings."""
    if name and private_files.exists(folder / AUTHORITY_CERTIFICATE):
        private_files.private_directory(folder / _FORMER)
        data = private_files.read(folder / AUTHORITY_CERTIFICATE)
        private_files.write(folder / _FORMER / f"{name}.crt", data)


def former_certificates(folder: Path) -> list[Path]:
    """Certificates of all authorities of before, as files."""
    return sorted((folder / _FORMER).glob("*.crt"))


def earlier_folders(folder: Path) -> list[Path]:
    """Folders with credentials of earlier authorities, which some robots may still have."""
    try:
        current = short(authority_of(folder))
        found = sorted((folder / _EARLIER).iterdir())
    except (OSError, private_files.KeyFileError):
        return []
    return [path for path in found if path.is_dir() and path.name[0] != "." and path.name != current]


def drop_earlier(folder: Path) -> None:
    """Forgets earlier authorities: every robot has the one of now, or is given up."""
    with suppress(FileNotFoundError):
        shutil.rmtree(folder / _EARLIER)
