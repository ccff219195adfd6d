"""The program that drives the runs of a campaign. It must be the same everywhere, from start to end.

Every worker of a cluster imports this module before it drives anything.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Final, Generic, TypeVar

from handfast.agent.common.errors import Error
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.console.data_files import ROOT
from handfast.deploy.console.sources import sources_digest
from handfast.deploy.hosts.bundle import files_of_plugins
from handfast.deploy.simulate.worker_pool import GoOn, Refused, Work

LIBRARIES: Final = ("numpy", "msgpack", "pymap3d", "pymavlink", "cryptography")
"""Packages that take part in a run. Their versions must be the same everywhere."""
SOURCES: Final = "sources"

T = TypeVar("T")


class ClusterError(Error):
    """The cluster cannot be used; the text is one line."""


def identity(plugins: Iterable[str] = ()) -> dict[str, str]:
    """Return the versions by name, and a digest of our sources and of the `plugins` (`plugins_of`)."""
    return {
        "Python": f"{sys.version_info[0]}.{sys.version_info[1]}",
        "handfast": handfast_version(),
        **{name: _version(name) for name in LIBRARIES},
        SOURCES: program_digest(plugins),
    }


def program_digest(plugins: Iterable[str]) -> str:
    """Return 16 hex digits over our Python files and those of plugins.

    A plugin counts with its top-level package or its file, but not with what that imports in turn.
    """
    return sources_digest(ROOT, files_of_plugins(plugins)[0])


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Say what differs between two identities; empty if nothing does."""
    return ", ".join(
        f"{name} {there.get(name, 'unknown')} instead of {value}"
        for name, value in here.items()
        if there.get(name) != value
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


_checked: Final[list[Mapping[str, str]]] = []
"""Programs that this process had before and after its first run, which imports the rest of them."""


@dataclass(frozen=True, slots=True)
class SameProgram(Generic[T]):
    """A `Work` that only the given program drives.

    A worker imports what it needs when it starts and with its first run, and it may start late, to replace
    one that died. So it compares the program before and after its first run.
    """

    work: Work[T]
    program: Mapping[str, str]
    plugins: tuple[str, ...]

    def execute(self, number: int, go_on: GoOn) -> T:
        """Drive a run of the work.

        Raises:
            Refused: the program is another one.
        """
        if self.program in _checked:
            return self.work.execute(number, go_on)
        self._compare()
        result = self.work.execute(number, go_on)
        self._compare()
        _checked.append(self.program)
        return result

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> T:
        return self.work.unfinished(number, reason, wall_s, timed_out=timed_out)

    def _compare(self) -> None:
        if text := differences(self.program, identity(self.plugins)):
            raise Refused(f"the program is not the one that this command began with: {text}")
