"""The liveliness tokens that a node watches: all of a small fleet, in a large one those of who matters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from handfast.agent.transport.bus import Bus, Presence

KEPT: Final = 6
"""So many that are not wanted any more are watched on: in a formation that moves the same ones come near and
go again, and each that is watched anew is asked for at a router."""


class Watches:
    """What is watched on `bus`, and may become something else."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._wanted: Sequence[str] = ()
        self._watches: dict[str, Presence] = {}
        self._kept: dict[str, Presence] = {}
        """What is not wanted any more, the oldest first."""

    def update(self, wanted: Sequence[str]) -> Sequence[tuple[str, bool]]:
        """Changes since the last call, as `Presence.update`.

        Args:
            wanted: key expressions of the tokens, another object when they have changed.
        """
        changes: list[tuple[str, bool]] = []
        if wanted is not self._wanted:
            self._wanted = wanted
            changes = self._want(wanted)
        for presence in self._watches.values():
            changes += presence.update()
        for presence in self._kept.values():
            presence.update()
        return changes

    def _want(self, wanted: Sequence[str]) -> list[tuple[str, bool]]:
        """Watches other ones; what is there of those that were kept."""
        for key in [key for key in self._watches if key not in wanted]:
            self._kept[key] = self._watches.pop(key)
        there: list[tuple[str, bool]] = []
        for key in wanted:
            if key in self._watches:
                continue
            kept = self._kept.pop(key, None)
            if kept is not None:
                kept.update()
                there += [(token, True) for token in sorted(kept.alive)]
            self._watches[key] = kept or self._bus.watch(key)
        for key in list(self._kept)[:-KEPT]:
            self._kept.pop(key).close()
        return there
