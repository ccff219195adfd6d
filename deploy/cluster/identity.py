"""What decides the bytes that a run leaves, of this installation: who differs in it must not share a sweep.

Standard library and our own packages only: a worker imports it before anything else is asked of it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from agent.runtime.version import handfast_version
from deploy.console.data_files import ROOT

PACKAGES: Final = ("agent", "plant", "bridges", "deploy")
MODULE: Final = "handfast.py"
LIBRARIES: Final = ("numpy", "msgpack")
"""Others' packages that have a part in the numbers and bytes of a run."""
SOURCES: Final = "sources"


def identity() -> Mapping[str, str]:
    """Versions by name, of Python, handfast and `LIBRARIES`, and a digest of our sources."""
    return {
        "Python": f"{sys.version_info[0]}.{sys.version_info[1]}",
        "handfast": handfast_version(),
        **{name: _version(name) for name in LIBRARIES},
        SOURCES: sources_digest(ROOT),
    }


def sources_digest(root: Path) -> str:
    """16 hex digits over the names and contents of our Python files below `root`."""
    found = blake2b(digest_size=8)
    for path in _sources(root):
        data = path.read_bytes()
        found.update(f"{path.relative_to(root).as_posix()}\0{len(data)}\0".encode())
        found.update(data)
    return found.hexdigest()


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """What `there` has otherwise than `here`, in words; empty when nothing."""
    said = []
    for name, value in here.items():
        other = there.get(name, "none")
        if other == value:
            continue
        if name == SOURCES:
            said.append(f"its sources of handfast are others ({other}, here {value})")
        else:
            said.append(f"it has {name} {other}, here is {value}")
    return "; ".join(said)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def _sources(root: Path) -> Iterator[Path]:
    for package in PACKAGES:
        yield from sorted(path for path in (root / package).rglob("*.py") if path.is_file())
    yield root / MODULE
