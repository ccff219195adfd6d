"""The liveliness tokens that a node watches: all of a small fleet, in a large one those of who matters."""

from __future__ import annotations

from collections.abc import Sequence

from agent.runtime.bus import Bus, Presence


class Watches:
    """What is watched on `bus`, and may become something else."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._wanted: Sequence[str] = ()
        self._watches: dict[str, Presence] = {}

    def update(self, wanted: Sequence[str]) -> Sequence[tuple[str, bool]]:
        """Changes since the last call, as `Presence.update`.

        Args:
            wanted: key expressions of the tokens, another object when they have changed.
        """
        if wanted is not self._wanted:
            self._wanted = wanted
            for key in self._watches.keys() - set(wanted):
                self._watches.pop(key).close()
            for key in wanted:
                if key not in self._watches:
                    self._watches[key] = self._bus.watch(key)
        changes: list[tuple[str, bool]] = []
        for presence in self._watches.values():
            changes += presence.update()
        return changes
