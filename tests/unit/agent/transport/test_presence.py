"""What is watched changes, and nothing else is."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.transport.presence import KEPT, Watches

pytestmark = pytest.mark.patches


class Presences:
    """A bus that has a presence for each key that is watched: what is there comes first, as of Zenoh."""

    def __init__(self) -> None:
        self.there = set("abcdefghijklmnop")
        self.watched: dict[str, list[tuple[str, bool]]] = {}
        self.asked: list[str] = []
        self.closed: list[str] = []

    def change(self, key: str, *, here: bool) -> None:
        (self.there.add if here else self.there.discard)(key)
        if key in self.watched:
            self.watched[key].append((key, here))

    def watch(self, key: str) -> Any:
        bus = self
        bus.asked.append(key)
        bus.watched[key] = [(key, True)] if key in bus.there else []

        class One:
            def __init__(self) -> None:
                self.alive: set[str] = set()

            def update(self) -> list[tuple[str, bool]]:
                changes, bus.watched[key] = bus.watched[key], []
                for token, here in changes:
                    (self.alive.add if here else self.alive.discard)(token)
                return changes

            def close(self) -> None:
                bus.closed.append(key)
                del bus.watched[key]

        return One()


def test_what_is_wanted_is_watched_and_what_is_not_any_more_is_not_told() -> None:
    bus = Presences()
    watches = Watches(bus)  # type: ignore[arg-type]
    assert list(watches.update(())) == []
    first = ("a", "b")
    assert list(watches.update(first)) == [("a", True), ("b", True)]
    bus.change("a", here=False)
    assert list(watches.update(first)) == [("a", False)]
    assert list(watches.update(("b", "c"))) == [("c", True)]
    bus.change("a", here=True)
    bus.change("b", here=False)
    assert list(watches.update(())) == []


def test_who_comes_near_and_goes_again_is_not_asked_for_each_time() -> None:
    bus = Presences()
    watches = Watches(bus)  # type: ignore[arg-type]
    assert list(watches.update(("a",))) == [("a", True)]
    for _ in range(5):
        assert list(watches.update(("a", "b"))) == [("b", True)]
        assert list(watches.update(("a",))) == []
    assert bus.asked == ["a", "b"]
    bus.change("b", here=False)
    assert list(watches.update(("a", "b"))) == [], "it went while it was not wanted"
    bus.change("b", here=True)
    assert list(watches.update(("a",))) == []
    assert list(watches.update(("a", "b"))) == [("b", True)]


def test_no_more_are_kept_than_may_be() -> None:
    bus = Presences()
    watches = Watches(bus)  # type: ignore[arg-type]
    for key in "abcdefghijklmnop":
        watches.update((key,))
    assert len(bus.watched) == 1 + KEPT
    assert bus.closed == list("abcdefghi")
