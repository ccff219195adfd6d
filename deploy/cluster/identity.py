"""What decides the bytes that a run leaves, of this installation: who differs in it must not share a sweep.

Standard library and our own packages only: a worker imports it before anything else is asked of it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Final

from handfast.agent.common.errors import MissingPackageError
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.console.data_files import ROOT
from handfast.deploy.console.sources import sources_digest

LIBRARIES: Final = ("numpy", "msgpack", "pymap3d")
"""Others' packages that have a part in the numbers and bytes of a run."""
NEEDED: Final = ("cryptography", "mcap", "orjson", "pymavlink", "tomli_w", "zenoh")
"""Others' packages that a run may import besides, in any version: as they are imported."""
SOURCES: Final = "sources"
CHANGED: Final = "changed since it started"
"""In the place of the digest of a process that has imported others than there are now."""
THERE: Final = "there"
NONE: Final = "none"
INSTALL: Final = "pip install 'handfast[cluster]'"


def identity() -> Mapping[str, str]:
    """Versions by name, of Python, handfast and `LIBRARIES`, which of `NEEDED` are there, and a digest of our
    sources."""
    return {
        "Python": f"{sys.version_info[0]}.{sys.version_info[1]}",
        "handfast": handfast_version(),
        **_packages(),
        SOURCES: sources_digest(ROOT),
    }


def refuse_lacking() -> None:
    """Raises `MissingPackageError` where this installation lacks a package that workers must have."""
    if lacking := _lacking(_packages()):
        raise MissingPackageError(f"--cluster needs the {_named(lacking)}: {INSTALL}")


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """What `there` has otherwise than `here`, and what to do about it, in words; empty when nothing."""
    said = []
    # One of other sources may not speak of all that this one asks for.
    silent = NONE if there.get(SOURCES) == here.get(SOURCES) else THERE
    answers = {name: there.get(name, silent) for name in here}
    if lacking := _lacking(answers):
        said.append(f"it lacks the {_named(lacking)}: {INSTALL}")
    for name, value in here.items():
        other = answers[name]
        if other in (value, THERE) or name in lacking or name in NEEDED:
            continue
        if name == SOURCES:
            do = "start it again" if other == CHANGED else "install the same there and start it again"
            said.append(f"its sources of handfast are others ({other}, here {value}): {do}")
        elif name == "Python":
            said.append(f"it has Python {other}, here is {value}: start it with Python {value}")
        elif name == "handfast":
            said.append(f"it has handfast {other}, here is {value}: install the same there")
        else:
            said.append(
                f"it has {name} {other}, here is {value}: pip install {name}=={value} there, or "
                f"{name}=={other} here"
            )
    return "; ".join(said)


def _lacking(found: Mapping[str, str]) -> list[str]:
    """Packages that an installation says it lacks."""
    return [name for name in (*LIBRARIES, *NEEDED) if found.get(name) == NONE]


def _named(names: list[str]) -> str:
    return f"package{'s' * (len(names) > 1)} {', '.join(names)}"


def _packages() -> dict[str, str]:
    return {name: _version(name) for name in LIBRARIES} | {
        name: NONE if find_spec(name) is None else THERE for name in NEEDED
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return NONE
