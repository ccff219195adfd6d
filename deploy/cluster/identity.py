"""What decides the bytes that a run leaves, of this installation: who differs in it must not share a sweep.

Standard library and our own packages only: a worker imports it before anything else is asked of it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from agent.runtime.version import handfast_version
from deploy.console.data_files import ROOT
from deploy.console.sources import sources_digest

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
