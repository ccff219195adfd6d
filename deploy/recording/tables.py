"""What each robot of a run sent, and what links did to messages on purpose, as columns of numbers over
time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.formation.points import Floats
from handfast.agent.messages.declaration import Field, declared
from handfast.agent.messages.types import LOST, TOPICS, Message, NeighbourStatus


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


NEIGHBOUR: Final = np.dtype([(name, np.int64) for name in NeighbourStatus._fields])
"""A row of `agent.messages.types.Status.neighbours`."""
NO_INTS: Final[Ints] = np.zeros(0, dtype=np.int64)
_HEAD: Final = ("robot", "sequence", "time_ns")


def columns(kind: type[Message]) -> tuple[Field, ...]:
    """What a table holds of a robot's messages: their numbers and truth values, but who sent it and when."""
    return tuple(
        each for each in declared(kind) if each.kind in (int, float, bool) and each.name not in _HEAD
    )


class Table:
    """Columns over time: `t` (n,) s ascending, `values` (n, k), and ``table["x"]`` (n,).

    `stamps_ns`, `sequences` (n,): as they stood in the messages; empty where a row is no message of its own.
    `t` is true time where a clock was made to go wrong on purpose, the stamps are not.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        t: Floats,
        values: Floats,
        stamps_ns: Ints = NO_INTS,
        sequences: Ints = NO_INTS,
    ) -> None:
        self.names, self.t, self.values = names, t, values
        self.stamps_ns, self.sequences = stamps_ns, sequences

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, name: str) -> Floats:
        return self.values[:, self.names.index(name)]

    def only(self, wanted: NDArray[np.bool_]) -> Table:
        """The rows where `wanted` (n,) is True; this table when all are."""
        if wanted.all():
            return self
        stamps, sequences = (each[wanted] if len(each) else each for each in (self.stamps_ns, self.sequences))
        return Table(self.names, self.t[wanted], self.values[wanted], stamps, sequences)

    def filled(self, other: Table, longer_s: float) -> Table:
        """This table, and the rows of another one of the same columns from where it has none for longer."""
        after = np.searchsorted(self.t, other.t)
        bounds = np.concatenate([[-np.inf], self.t, [np.inf]])
        lacks = (bounds[after + 1] - bounds[after] > longer_s) & (bounds[after + 1] != other.t)
        if not lacks.any():
            return self
        more = other.only(lacks)
        order = np.argsort(np.concatenate([self.t, more.t]), kind="stable")
        mine, theirs = ((each.t, each.values, each.stamps_ns, each.sequences) for each in (self, more))
        return Table(self.names, *(np.concatenate(pair)[order] for pair in zip(mine, theirs, strict=True)))


class Change(NamedTuple):
    """An agent came from state `before` ("" when nothing is known of it) to `state` at `t_s`; `row` names the
    row of `agent.supervision.state_machine.TRANSITIONS` that led there."""

    t_s: float
    before: str
    state: str
    row: str
    reason: str


@dataclass(frozen=True)
class StatusTable:
    """The statuses of one agent: n of them, with all ticks and ages that they hold, in order.

    t (n,) s; states, reasons, transitions: n texts; mission_versions, order_versions (n,); counters: n
    dictionaries of totals; tick_us, ages_us: all values of all statuses, microseconds, of which status k
    holds ``tick_counts[k]`` and ``age_counts[k]``. Ages of neighbours that were never heard are left out.

    The ages of a tick come in the order of the neighbours' numbers, those of a status tick by tick.
    """

    t: Floats
    states: Sequence[str]
    reasons: Sequence[str]
    transitions: Sequence[str]
    mission_versions: Ints
    order_versions: Ints
    counters: Sequence[Mapping[str, int]]
    tick_us: Ints
    tick_counts: Ints
    ages_us: Ints
    age_counts: Ints
    neighbours: NDArray[Any] = field(default_factory=lambda: np.zeros(0, dtype=NEIGHBOUR))
    """(rows,) of `NEIGHBOUR`: those of all statuses one after the other."""
    neighbour_counts: Ints = field(default_factory=lambda: NO_INTS)
    """(n,): how many of these rows each status has."""

    def __len__(self) -> int:
        return len(self.t)

    def ages_between(self, start: float, end: float) -> Ints:
        """Ages (us) in the statuses of fleet time (start, end]."""
        return self.ages_us[np.repeat((self.t > start) & (self.t <= end), self.age_counts)]

    @cached_property
    def tick_max_us(self) -> Floats:
        """(n,): the longest tick of each status, us; NaN where it has none."""
        return _greatest(self.tick_us, self.tick_counts)

    @cached_property
    def age_max_us(self) -> Floats:
        """(n,): the greatest age in each status, us; NaN where it has none."""
        return _greatest(self.ages_us, self.age_counts)

    def totals(self) -> Mapping[str, int]:
        """What was counted by the last status, empty without one.

        An agent that was started again counts from 0: what it had counted before is added.
        """
        totals: Counter[str] = Counter()
        for before, counters in pairwise(self.counters):
            if any(counters.get(name, 0) < value for name, value in before.items()):
                totals.update(before)
        if self.counters:
            totals.update(self.counters[-1])
        return dict(totals)

    def at(self, t: float) -> tuple[str, str] | None:
        """State and reason at fleet time `t`: those of the last status until then, else of the first."""
        if not self.states:
            return None
        index = max(int(np.searchsorted(self.t, t, side="right")) - 1, 0)
        return self.states[index], self.reasons[index]

    def changes(self) -> list[Change]:
        """The states one after the other: an agent sends a status of its own for every change, at once."""
        out: list[Change] = []
        before = ""
        for t, now, row, reason in zip(
            self.t.tolist(), self.states, self.transitions, self.reasons, strict=True
        ):
            if now != before:
                out.append(Change(t, before, now, row, reason))
            before = now
        return out

    def periods(self, state: str) -> list[tuple[float, float | None, str]]:
        """Times in a state: (start s, end s or None when it lasted to the last status, first reason)."""
        changes = self.changes()
        ends = [*(change.t_s for change in changes[1:]), None]
        return [
            (change.t_s, end, change.reason)
            for change, end in zip(changes, ends, strict=False)
            if change.state == state
        ]


def _greatest(values: Ints, counts: Ints) -> Floats:
    """Greatest of each status's values, NaN where it has none."""
    found = np.full(len(counts), np.nan)
    some = counts > 0
    if some.any():
        starts = (np.cumsum(counts) - counts)[some]
        found[some] = np.maximum.reduceat(values, starts)
    return found
