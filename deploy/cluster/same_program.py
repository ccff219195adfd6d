"""Which program drives a campaign, and runs that no other one drives: files may change while it goes on."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.data_files import ROOT
from handfast.deploy.console.sources import sources_digest
from handfast.deploy.hosts.artifacts.plugin_files import files_of_plugins
from handfast.deploy.simulate.worker_pool import GoOn, Refused, Work

T = TypeVar("T")

_looked_at: set[str] = set()
"""Digests whose files this process has found before and after its first run, which imports them."""


def program_digest(fleets: Iterable[Fleet]) -> str:
    """16 hex digits over our Python files and those of the plugins that fleets name: of each plugin its
    top-level package, or its file; what that imports besides is not in it."""
    return sources_digest(ROOT, files_of_plugins(fleets)[0])


@dataclass(frozen=True, slots=True)
class SameProgram(Generic[T]):
    """A `Work` that is driven on this machine by the files of a `digest` alone.

    A worker imports what it needs when it starts and with its first run, and may start late, in the place of
    one that has died: it looks before and after that.
    """

    work: Work[T]
    digest: str
    fleets: tuple[Fleet, ...]

    def execute(self, number: int, go_on: GoOn) -> T:
        """As of the work.

        Raises:
            Refused: the files are others.
        """
        if self.digest in _looked_at:
            return self.work.execute(number, go_on)
        self._look()
        result = self.work.execute(number, go_on)
        self._look()
        _looked_at.add(self.digest)
        return result

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> T:
        return self.work.unfinished(number, reason, wall_s, timed_out=timed_out)

    def _look(self) -> None:
        if program_digest(self.fleets) != self.digest:
            raise Refused("Python files of handfast, or of a plugin, have changed since this command began")
