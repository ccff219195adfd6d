"""Random choices from a seed, the same on every machine and in every version of Python (PURE)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from agent.common.random_streams import stream, uniform

T = TypeVar("T")
Tables = dict[str, Any]
"""Of a fleet file, as TOML has them."""


class Dice:
    """Draws one after the other from the stream that `key` names; another key is another stream."""

    def __init__(self, *key: int | str) -> None:
        self._stream = stream("dice", *key)
        self._count = 0

    def share(self) -> float:
        """Uniform in [0, 1)."""
        self._count += 1
        return uniform(self._stream, self._count)

    def between(self, low: float, high: float, digits: int = 3) -> float:
        """Uniform in [low, high], rounded to so many digits: a text that is written has no more."""
        return round(low + (high - low) * self.share(), digits)

    def whole(self, low: int, high: int) -> int:
        """Uniform in low..high, both included."""
        return low + int((high - low + 1) * self.share())

    def chance(self, probability: float) -> bool:
        return self.share() < probability

    def pick(self, items: Sequence[T]) -> T:
        """One of `items`, which must not be empty."""
        return items[int(len(items) * self.share())]

    def weighted(self, items: Sequence[tuple[T, float]]) -> T:
        """One of the first elements, by the weights that are the second."""
        left = self.share() * sum(weight for _, weight in items)
        for item, weight in items:
            left -= weight
            if left < 0.0:
                return item
        return items[-1][0]

    def some(self, items: Sequence[T], count: int) -> list[T]:
        """`count` of `items`, none twice, in their order."""
        left = list(range(len(items)))
        chosen = sorted(left.pop(self.whole(0, len(left) - 1)) for _ in range(min(count, len(items))))
        return [items[index] for index in chosen]
