"""Random choices from a seed, the same on every machine and in every version of Python."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from handfast.agent.common.random_streams import stream, uniform

T = TypeVar("T")
Tables = dict[str, Any]
"""Tables of a fleet file, as a TOML parser returns them."""
Choice = Sequence[tuple[T, float]]
"""Items with their weights."""
Range = tuple[float, float]


class Dice:
    """Draws from the stream that `key` names. Different keys give independent streams."""

    def __init__(self, *key: int | str) -> None:
        self._stream = stream("dice", *key)
        self._count = 0

    def share(self) -> float:
        """Return a number uniform in [0, 1)."""
        self._count += 1
        return uniform(self._stream, self._count)

    def between(self, low: float, high: float, digits: int = 3) -> float:
        """Return a number uniform in [low, high], rounded to `digits` decimal places."""
        return round(low + (high - low) * self.share(), digits)

    def whole(self, low: int, high: int) -> int:
        """Return an integer uniform in low..high, both included."""
        return low + int((high - low + 1) * self.share())

    def chance(self, probability: float) -> bool:
        """Return True with this probability."""
        return self.share() < probability

    def pick(self, items: Sequence[T]) -> T:
        """Return one of `items`, which must not be empty."""
        return items[int(len(items) * self.share())]

    def weighted(self, items: Choice[T]) -> T:
        """Return one of the items, each as often as its weight says."""
        left = self.share() * sum(weight for _, weight in items)
        for item, weight in items:
            left -= weight
            if left < 0.0:
                return item
        return items[-1][0]

    def some(self, items: Sequence[T], count: int) -> list[T]:
        """Return `count` of `items` in their order, none twice."""
        left = list(range(len(items)))
        chosen = sorted(left.pop(self.whole(0, len(left) - 1)) for _ in range(min(count, len(items))))
        return [items[index] for index in chosen]
