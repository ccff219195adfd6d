"""Tables that grow message by message: what is collected of a run, until somebody asks for its tables.

They are apart from `deploy.recording.tables` because these are compiled (`make compiled`), and tables go
through pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import itemgetter
from struct import Struct
from typing import Any, Final

import numpy as np

from handfast.agent.messages.types import DUPLICATED, HandState, LinkTrace, Message, Multiplier, Status
from handfast.deploy.recording.columns import Store
from handfast.deploy.recording.tables import (
    EXACT,
    NEIGHBOUR,
    Clock,
    LinkTable,
    StatusTable,
    Table,
    columns,
    true_ns,
)

_INTEGER_MAX: Final = 2**62
_PAIR: Final = Struct("2d").pack


class Rows:
    """One growing table: times and a flat row of numbers (`columns`) for every message of one robot."""

    def __init__(self, kind: type[Message], robot: int, store: Store) -> None:
        self.kind: type = kind
        self.robot = robot
        self.names = tuple(column.name for column in columns(kind))
        self.times, self._values = store.column("q"), store.column("d")
        self._sequences = store.column("q")
        self._numbers = itemgetter(*map(kind._fields.index, self.names))
        # Packed and then appended as bytes: an array takes numbers one by one.
        self._pack = Struct(f"{len(self.names)}d").pack

    def is_of(self, message: Any) -> bool:
        """Whether it is a message of this table."""
        is_kind = type(message) is self.kind
        return is_kind and bool(message.robot == self.robot)

    def append(self, message: Any) -> None:
        self._sequences.append(message.sequence)
        self.times.append(message.time_ns)
        self._values.append_bytes(self._pack(*self._numbers(message)))

    def table(self, epoch_ns: int, clock: Clock) -> Table:
        times, sequences = self.times.whole(), self._sequences.whole()
        values = self._values.whole().reshape(len(times), len(self.names))
        if len(times) > 1 and not (times[1:] > times[:-1]).all():
            times, order = np.unique(times, return_index=True)
            values, sequences = values[order], sequences[order]
        return Table(self.names, (true_ns(times, clock, epoch_ns) - epoch_ns) / 1e9, values, times, sequences)


class HandRows(Rows):
    """The growing table of one robot's hand states, and a second one of their multipliers."""

    def __init__(self, robot: int, store: Store) -> None:
        super().__init__(HandState, robot, store)
        self._multiplier_times, self._multipliers = store.column("q"), store.column("d")

    def append(self, message: HandState) -> None:
        super().append(message)
        for pair in message.multipliers:
            self._multiplier_times.append(message.time_ns)
            self._multipliers.append_bytes(_PAIR(*pair))

    def multipliers(self, epoch_ns: int, clock: Clock) -> Table:
        times = true_ns(self._multiplier_times.whole(), clock, epoch_ns)
        values = self._multipliers.whole().reshape(len(times), 2)
        order = np.argsort(times, kind="stable")
        return Table(Multiplier._fields, (times[order] - epoch_ns) / 1e9, values[order])


def _bounded(value: int) -> int:
    """What int64 holds: numbers in a status are only known to be integers; none that is true is so large."""
    return max(-_INTEGER_MAX, min(value, _INTEGER_MAX))


class StatusRows:
    """The growing table of one agent's statuses, which `table` makes a `StatusTable`."""

    def __init__(self, robot: int, store: Store) -> None:
        self.robot = robot
        self.times = store.column("q")
        self._state_rows = store.records()
        self._missions, self._orders = store.column("q"), store.column("q")
        self._ticks, self._tick_counts = store.column("q"), store.column("q")
        self._ages, self._age_counts = store.column("q"), store.column("q")
        self._neighbours, self._neighbour_counts = store.column("q"), store.column("q")

    def is_of(self, message: Any) -> bool:
        """Whether it is a message of this table."""
        return type(message) is Status and message.robot == self.robot

    def append(self, message: Any) -> None:
        ticks = [value for value in message.tick_us if 0 <= value < _INTEGER_MAX]
        ages = [value for value in message.ages_us if 0 <= value < _INTEGER_MAX]
        self.times.append(message.time_ns)
        counters = {name: _bounded(value) for name, value in message.counters}
        self._state_rows.append((message.state, message.reason, message.transition, counters))
        self._missions.append(_bounded(message.mission_version))
        self._orders.append(_bounded(message.order_version))
        self._ticks.extend(ticks)
        self._tick_counts.append(len(ticks))
        self._ages.extend(ages)
        self._age_counts.append(len(ages))
        for entry in message.neighbours:
            self._neighbours.extend(map(_bounded, entry))
        self._neighbour_counts.append(len(message.neighbours))

    def table(self, epoch_ns: int, clock: Clock) -> StatusTable:
        stamps = self.times.whole()
        times = true_ns(stamps, clock, epoch_ns)
        rows = self._state_rows.whole()
        states, reasons, transitions, counters = zip(*rows, strict=True) if rows else ((), (), (), ())
        if (np.diff(stamps) < 0).any():
            times = np.maximum.accumulate(times)  # a clock that went back: keep the order of arrival
        return StatusTable(
            (times - epoch_ns) / 1e9,
            states,
            reasons,
            transitions,
            self._missions.whole(),
            self._orders.whole(),
            counters,
            self._ticks.whole(),
            self._tick_counts.whole(),
            self._ages.whole(),
            self._age_counts.whole(),
            self._neighbours.whole().view(NEIGHBOUR),
            self._neighbour_counts.whole(),
        )


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
