"""Directed links of a fleet: who hears whom, on which topic."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple


class Link(NamedTuple):
    """A directed link: what robot `destination` hears from robot `source`; `topic` is one of `TOPICS`."""

    source: int
    destination: int
    topic: str

    def __str__(self) -> str:
        return f"{self.source}→{self.destination}" + (f" {self.topic}" if self.topic != "hand" else "")


def links_of(ids: Iterable[int], edges: Iterable[tuple[int, int]]) -> Iterator[Link]:
    """Every link that a fleet with these edges always has: both ways along each edge, and between each agent
    and its plant."""
    for i, j in edges:
        yield Link(i, j, "hand")
        yield Link(j, i, "hand")
    for robot in ids:
        yield Link(robot, robot, "state")
        yield Link(robot, robot, "wrench")
