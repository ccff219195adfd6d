"""The incoming links of one node, which fail on purpose: late, lost, twice, damaged, out of order (PURE).

A link is (source robot, destination robot, topic). Faults are applied by the receiver: a publication fans
out, and only its receiver knows the link. What happens to one is a function of the seed, the link and the
message's sequence number, whatever came before or beside it; a delay counts from the message's stamp (an
injected error of either clock is allowed for). So the same scenario gives the same fate in a run and in its
simulation. Only the queue of a rate limit remembers what came before on its link. Every decision is kept for
the recording (`LinkTrace`).
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Mapping, Sequence
from math import dist
from typing import Final, NamedTuple

from handfast.agent.common import random_streams
from handfast.agent.common.models import new
from handfast.agent.common.time import NS_PER_S, LocalTime
from handfast.agent.impairments.impairments import LIMIT, Delay
from handfast.agent.links.fault_plan import NONE, FaultPlan, LinkEffects, LinkRules
from handfast.agent.messages.types import (
    CORRUPTED,
    DUPLICATED,
    LOST,
    OVERFLOW,
    RANGE,
    REORDERED,
    TOPICS,
    TRACE_MAX,
    Beacon,
    Decision,
    HandState,
    LinkTrace,
    PlantState,
    Wrench,
)

TRACE_PERIOD_NS: Final = NS_PER_S // 5
"""Decisions wait at most so long before they are published, ns."""
_LOST_US: Final = -1

Sample = HandState | PlantState | Wrench | Beacon
"""What links carry; all have a robot, a sequence number and a stamp."""


class Arrival(NamedTuple):
    """A message whose time has come: its key and bytes; `message` is None when the bytes were damaged."""

    key: str
    payload: bytes
    message: Sample | None


class _Streams(dict[str, int]):
    """The streams of draws of one link by what they are for, each made when it is needed first: a robot has
    two links from every other one, and hardly any of them ever fails."""

    def __init__(self, seed: int, source: int, destination: int, topic: str) -> None:
        super().__init__()
        self._link = seed, "link", source, destination, topic

    def __missing__(self, purpose: str) -> int:
        self[purpose] = made = random_streams.stream(*self._link, purpose)
        return made


class _Link:
    """One incoming link: its rules, its streams of draws, and what waits on it."""

    def __init__(self, plan: FaultPlan, source: int, destination: int, topic: int) -> None:
        self.source, self.destination, self.topic = source, destination, topic
        self._plan = plan
        self.rules: LinkRules
        self._theirs: LocalTime | None
        self._ours: LocalTime | None
        self.refresh()
        self.waiting = 0
        self._streams = _Streams(plan.seed, source, destination, TOPICS[topic])
        self._free_ns = 0
        self._departures: deque[int] = deque()

    def refresh(self) -> None:
        self.rules = self._plan.rules_of_link(self.source, self.destination, TOPICS[self.topic])
        own = self.source == self.destination  # a plant's clock is its agent's
        self._theirs = None if own else self._plan.local_time(self.source)
        self._ours = None if own else self._plan.local_time(self.destination)

    def sent_ns(self, stamp_ns: int) -> int:
        """When a message was sent, by the receiver's clock as far as its error is an injected one."""
        if self._theirs is not None:
            stamp_ns = self._theirs.true_ns(stamp_ns)
        return stamp_ns if self._ours is None else self._ours.local_ns(stamp_ns)

    def delay_ns(self, delay: Delay | None, sequence: int, purpose: str) -> int:
        """The drawn delay of one message."""
        if delay is None:
            return 0
        return round(delay.sample(self._streams[purpose], sequence) * NS_PER_S)

    def decide(
        self, effects: LinkEffects, sequence: int, sent_ns: int, size: int, distance: float | None
    ) -> list[tuple[int, int, int]]:
        """What becomes of one message: for each copy (what, ns after it was sent, flipped bit or -1)."""
        streams = self._streams
        lost = effects.loss is not None and effects.loss.lost(streams["loss"], sequence)
        twice = effects.duplicate is not None and effects.duplicate.happens(streams["duplicate"], sequence)
        if lost and not twice:
            return [(LOST, _LOST_US, -1)]
        extra_ns = 0
        if effects.range is not None and distance is not None:
            tried = effects.range.attempt(streams["range"], sequence, distance)
            if tried is None:  # no copy gets further than its signal
                return [(RANGE | LOST, _LOST_US, -1)]
            extra_ns = round(tried * NS_PER_S)
        copies = [("delay", 0)]
        if twice and not lost:  # as in netem, a message that is both lost and doubled comes once
            copies.append(("second delay", DUPLICATED))
        bit = -1
        if effects.corrupt is not None:
            bit = effects.corrupt.bit(streams["corrupt"], sequence, size)
        out: list[tuple[int, int, int]] = []
        for purpose, marks in copies:
            if bit >= 0:
                marks |= CORRUPTED
            queued_ns = self._queue_ns(effects, sent_ns, size)
            # Messages in delay are bounded, too: a long delay must not fill the memory.
            if queued_ns is None or self.waiting + len(out) >= LIMIT:
                out.append((marks | LOST | OVERFLOW, _LOST_US, -1))
                continue
            delay_ns = self.delay_ns(effects.delay, sequence, purpose)
            if (
                delay_ns
                and effects.reorder is not None
                and effects.reorder.happens(streams["reorder"], sequence)
            ):
                delay_ns = 0
                marks |= REORDERED
            due_ns = sent_ns + queued_ns + delay_ns + extra_ns
            out.append((marks, due_ns - sent_ns, bit))
        return out

    def moved(self, by_ns: int) -> None:
        self._free_ns += by_ns
        self._departures = deque(each + by_ns for each in self._departures)

    def _queue_ns(self, effects: LinkEffects, sent_ns: int, size: int) -> int | None:
        """How long a message waits for, and takes on, a link of limited rate; None when the queue is full."""
        if effects.rate is None:
            return 0
        departures = self._departures
        while departures and departures[0] <= sent_ns:
            departures.popleft()
        if len(departures) >= effects.rate.limit:
            return None
        self._free_ns = max(self._free_ns, sent_ns) + round(effects.rate.transmission_s(size) * NS_PER_S)
        departures.append(self._free_ns)
        return self._free_ns - sent_ns


class LinkEmulator:
    """All incoming links of one node of robot `robot`.

    Give every message of a link to `take`; at every tick deliver what is `due` and publish what is `traced`.
    While `idle` is True nothing happens to any message, and none need come here.
    """

    def __init__(self, plan: FaultPlan, robot: int, sources: Mapping[str, Sequence[int]]) -> None:
        """`sources`: by topic, the robots whose messages come here."""
        self.plan: Final = plan
        self.robot: Final = robot
        self._sources = [(TOPICS.index(topic), each) for topic, robots in sources.items() for each in robots]
        self._links: dict[tuple[int, int], _Link] = {}
        """Those on which something may have happened: a node has two for every robot there is, and a rule is
        for few."""
        self._order = 0
        self._pending: list[tuple[int, int, _Link, Arrival]] = []
        self._trace: list[Decision] = []
        self._trace_due_ns: int | None = None
        self._trace_sequence = 0
        self._changes = plan.changes
        self._ruled = self._rule()
        self.idle = not self._ruled

    def _rule(self) -> bool:
        """Takes over the plan's rules; whether they may do anything to any message."""
        plan, links = self.plan, self._links
        for link in links.values():
            link.refresh()
        if plan.rules_links:
            for topic, source in self._sources:
                if (topic, source) not in links and plan.is_ruled(source, self.robot, TOPICS[topic]):
                    self._link(topic, source)
        return any(not link.rules.idle for link in links.values())

    def _link(self, topic: int, source: int) -> _Link:
        link = self._links.get((topic, source))
        if link is None:
            link = self._links[topic, source] = _Link(self.plan, source, self.robot, topic)
        return link

    def refresh(self) -> None:
        """Takes over the plan's rules; to be called when they have changed."""
        if self._changes != self.plan.changes:
            self._changes = self.plan.changes
            self._ruled = self._rule()
        self.idle = not (self._ruled or self._pending or self._trace)

    def take(
        self,
        key: str,
        payload: bytes,
        topic: int,
        message: Sample,
        own_position: tuple[float, float] | None = None,
    ) -> bool:
        """Decides on one message that has come; True when it is to be delivered at once, as it is.

        Args:
            topic: index into `TOPICS`.
            own_position: (x, y), m, W, for a range channel; None while not known: it then does nothing.
        """
        link = self._links.get((topic, message.robot))
        if link is None or link.rules.idle:
            return True
        sequence, stamp_ns = message.sequence, message.time_ns
        effects = link.rules.effects(stamp_ns)
        if effects is NONE:
            return True
        distance = None
        if effects.range is not None and own_position is not None and isinstance(message, HandState | Beacon):
            distance = dist((message.x, message.y), own_position)
        sent_ns = link.sent_ns(stamp_ns)
        for what, delay_ns, bit in link.decide(effects, sequence, sent_ns, len(payload), distance):
            delay_us = delay_ns // 1000 if not what & LOST else _LOST_US
            entry = new(Decision, (message.robot, topic, sequence, stamp_ns, what, delay_us))
            if what & LOST:
                self._trace.append(entry)
                continue
            arrival = new(Arrival, (key, payload, message))
            if bit >= 0:
                arrival = Arrival(key, _flipped(payload, bit), None)
            self._trace.append(entry)
            self._wait(link, sent_ns + delay_ns, arrival)
        return False

    def _wait(self, link: _Link, due_ns: int, arrival: Arrival) -> None:
        link.waiting += 1
        self._order += 1
        heapq.heappush(self._pending, (due_ns, self._order, link, arrival))

    def moved(self, by_ns: int) -> None:
        """The node's clock is read `by_ns` later from now on: what waits does not wait longer or shorter."""
        self._pending = [(due_ns + by_ns, *rest) for due_ns, *rest in self._pending]  # type: ignore[misc]
        if self._trace_due_ns is not None:
            self._trace_due_ns += by_ns
        for link in self._links.values():
            link.moved(by_ns)

    def due(self, now_ns: int) -> list[Arrival]:
        """Messages whose time has come at `now_ns`, the earliest first."""
        out = []
        while self._pending and self._pending[0][0] <= now_ns:
            _, _, link, arrival = heapq.heappop(self._pending)
            link.waiting -= 1
            out.append(arrival)
        return out

    def traced(self, now_ns: int, *, flush: bool = False) -> list[LinkTrace]:
        """The decisions since the last call, to publish: when there are enough, it is time, or to `flush`."""
        if not self._trace:
            self.refresh()
            return []
        if self._trace_due_ns is None:
            self._trace_due_ns = now_ns + TRACE_PERIOD_NS
        if not flush and len(self._trace) < TRACE_MAX // 2 and now_ns < self._trace_due_ns:
            return []
        self._trace_due_ns = None
        out = []
        for first in range(0, len(self._trace), TRACE_MAX):
            entries = tuple(self._trace[first : first + TRACE_MAX])
            out.append(LinkTrace(self.robot, self._trace_sequence, now_ns, entries))
            self._trace_sequence += 1
        self._trace.clear()
        self.refresh()
        return out


def _flipped(payload: bytes, bit: int) -> bytes:
    damaged = bytearray(payload)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)
