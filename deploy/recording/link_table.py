"""Directed links of a fleet, and what they did to messages on purpose, as columns: every decision of a run
(`agent.messages.types.LinkTrace`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.formation.points import Floats
from handfast.agent.messages.types import LOST, TOPICS


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


Ints = NDArray[np.int64]
Clock = tuple[int, float]
"""How far a clock is ahead (ns) and how much faster it goes, on purpose
(`agent.links.fault_plan.FaultPlan.clock`)."""
EXACT: Final[Clock] = (0, 0.0)


def true_ns(stamps_ns: Ints, clock: Clock, epoch_ns: int) -> Ints:
    """True times (n,) of stamps by a clock that was made wrong: the inverse of
    `agent.common.time.LocalTime`."""
    if clock == EXACT:
        return stamps_ns
    skew_ns, drift = clock
    since_epoch = stamps_ns - skew_ns - epoch_ns
    slowed: Ints = np.rint(since_epoch / (1.0 + drift)).astype(np.int64)
    return np.where(since_epoch > 0, slowed, since_epoch) + epoch_ns


@dataclass(frozen=True)
class LinkTable:
    """n decisions, by link and stamp; of a message that came twice the second copy follows the first.

    destination, source, topic (index into `TOPICS`), sequence, stamp_ns, what (bits of
    `agent.messages.types`), delay_us (-1 where lost): (n,) integers. t: (n,) s, true fleet time of the
    stamps.
    """

    destination: Ints
    source: Ints
    topic: Ints
    sequence: Ints
    stamp_ns: Ints
    what: Ints
    delay_us: Ints
    t: Floats

    @classmethod
    def empty(cls) -> LinkTable:
        """No decision."""
        none: Ints = np.zeros(0, dtype=np.int64)
        return cls(none, none, none, none, none, none, none, np.zeros(0))

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray[Any]) -> LinkTable:
        """Some of the rows."""
        return LinkTable(
            self.destination[rows],
            self.source[rows],
            self.topic[rows],
            self.sequence[rows],
            self.stamp_ns[rows],
            self.what[rows],
            self.delay_us[rows],
            self.t[rows],
        )

    def by_link(self) -> Iterator[tuple[Link, LinkTable]]:
        """Every link that has a decision, by topic, source and destination, and its rows."""
        if not len(self):
            return
        key = (self.topic * 10**4 + self.source) * 10**4 + self.destination
        bounds = [0, *(np.flatnonzero(np.diff(key)) + 1).tolist(), len(key)]
        for first, last in pairwise(bounds):
            link = Link(int(self.source[first]), int(self.destination[first]), TOPICS[int(self.topic[first])])
            yield link, self[first:last]

    @property
    def first_copies(self) -> NDArray[np.bool_]:
        """(n,): one row for each message, its only or first copy."""
        again = np.zeros(len(self), dtype=bool)
        if len(self) > 1:
            again[1:] = (
                (np.diff(self.stamp_ns) == 0)
                & (np.diff(self.topic) == 0)
                & (np.diff(self.source) == 0)
                & (np.diff(self.destination) == 0)
            )
        return ~again

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(n,): one row for each message of which no copy was let through, its only or first copy."""
        first = self.first_copies
        number = np.cumsum(first) - 1
        copies = np.bincount(number[self.delivered], minlength=int(first.sum()))
        lost: NDArray[np.bool_] = first & (copies[number] == 0)
        return lost

    def count(self, bit: int) -> int:
        """How many rows have a bit of `what`."""
        return int(np.count_nonzero(self.what & bit))

    @property
    def delivered(self) -> NDArray[np.bool_]:
        """(n,): the copies that were let through, sooner or later, whole or damaged."""
        let: NDArray[np.bool_] = (self.what & LOST) == 0
        return let
