"""Version of the program, found without loading anything heavy."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def handfast_version() -> str:
    """Version of the installed distribution, ``unknown`` when it runs from a bare checkout."""
    try:
        return version("handfast")
    except PackageNotFoundError:
        return "unknown"
