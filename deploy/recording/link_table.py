"""What links did to messages on purpose, as columns: every decision of a run
(`agent.messages.types.LinkTrace`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent.formation.points import Floats
from agent.messages.types import DUPLICATED, LOST, TOPICS, LinkTrace
from deploy.recording.columns import Store
from deploy.recording.links import Link

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

    def count(self, bit: int) -> int:
        """How many rows have a bit of `what`."""
        return int(np.count_nonzero(self.what & bit))

    @property
    def delivered(self) -> NDArray[np.bool_]:
        """(n,): the copies that were let through, sooner or later, whole or damaged."""
        let: NDArray[np.bool_] = (self.what & LOST) == 0
        return let


class LinkRows:
    """Collects `LinkTrace` messages."""

    def __init__(self, store: Store) -> None:
        self._destination, self._source = store.column("H"), store.column("H")
        self._topic, self._what = store.column("B"), store.column("H")
        self._sequence, self._stamp_ns, self._delay_us = (store.column("q") for _ in range(3))

    def append(self, trace: LinkTrace) -> None:
        for entry in trace.entries:
            self._destination.append(trace.robot)
            self._source.append(entry.source)
            self._topic.append(entry.topic)
            self._sequence.append(entry.sequence)
            self._stamp_ns.append(entry.time_ns)
            self._what.append(entry.what)
            self._delay_us.append(entry.delay_us)

    def table(self, clocks: Mapping[int, Clock], epoch_ns: int) -> LinkTable:
        """All decisions so far; `clocks` by robot."""
        columns = (
            self._destination, self._source, self._topic, self._sequence, self._stamp_ns, self._what,
            self._delay_us,
        )  # fmt: skip
        destination, source, topic, sequence, stamp_ns, what, delay_us = (
            column.whole().astype(np.int64) for column in columns
        )
        times = stamp_ns.copy()
        for robot, clock in clocks.items():
            if clock != EXACT:
                own = source == robot
                times[own] = true_ns(times[own], clock, epoch_ns)
        table = LinkTable(
            destination, source, topic, sequence, stamp_ns, what, delay_us, (times - epoch_ns) / 1e9
        )
        return table[np.lexsort((what & DUPLICATED, stamp_ns, destination, source, topic))]
