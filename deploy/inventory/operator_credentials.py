"""Where an operator's keys and certificates are on this machine, and who the operator is."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from handfast.agent.security.identity import MAIN

OPERATOR: Final = "HANDFAST_OPERATOR"
KEYS: Final = "HANDFAST_KEYS"
"""Variables of the environment: who gives orders here, and the folder of that operator's keys."""
AUTHORITY_FILE: Final = "authority.pem"
"""Key and certificate of the authority, where it is on this machine."""
SHORT: Final = 16
"""Digits of a fingerprint that people compare."""


def keys_folder(fleet: str) -> Path:
    """Return the folder of a fleet's keys: the environment's, or one in the user's configuration folder."""
    given = os.environ.get(KEYS, "")
    if given:
        return Path(given).expanduser()
    base = os.environ.get("XDG_CONFIG_HOME", "")
    root = Path(base) if base.startswith("/") else Path.home() / ".config"
    return root / "handfast" / "keys" / fleet


def operator_name() -> str:
    """Return the name of the operator who gives orders here."""
    return os.environ.get(OPERATOR, "") or MAIN


def short(digits: str) -> str:
    """Return the part of a fingerprint that people compare."""
    return digits[:SHORT]
