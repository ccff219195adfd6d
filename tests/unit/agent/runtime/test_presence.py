"""What is watched changes, and nothing else is."""

from __future__ import annotations

from typing import Any

from agent.runtime.presence import Watches


class Presences:
    """A bus that has a presence for each key that is watched."""

    def __init__(self) -> None:
        self.changes: dict[str, list[tuple[str, bool]]] = {}
        self.closed: list[str] = []

    def watch(self, key: str) -> Any:
        bus, self.changes[key] = self, [(key, True)]

        class One:
            def update(self) -> list[tuple[str, bool]]:
                changes, bus.changes[key] = bus.changes[key], []
                return changes

            def close(self) -> None:
                bus.closed.append(key)

        return One()


def test_what_is_wanted_is_watched_and_what_is_not_any_more_is_left() -> None:
    bus = Presences()
    watches = Watches(bus)  # type: ignore[arg-type]
    assert list(watches.update(())) == []
    first = ("a", "b")
    assert list(watches.update(first)) == [("a", True), ("b", True)]
    bus.changes["a"].append(("a", False))
    assert list(watches.update(first)) == [("a", False)]
    assert list(watches.update(("b", "c"))) == [("c", True)]
    assert bus.closed == ["a"]
    bus.changes["a"].append(("a", True))
    bus.changes["b"].append(("b", False))
    assert list(watches.update(())) == []
    assert sorted(bus.closed) == ["a", "b", "c"]
