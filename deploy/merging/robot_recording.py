"""What robots' computers recorded (`agent.recorder`), in folders that were brought here: what
there is of it, and its messages by time.

A recording is believed about its own robot only: whose it is its folder says, and what its robot could not
have said is left out.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.recorder.recorder import order_keys
from handfast.agent.recorder.segment_folder import segment_paths
from handfast.agent.recorder.segments import (
    ABOUT,
    KNOWN,
    MESSAGES,
    ORDERS,
    OVERFLOW,
    About,
    Received,
    Segment,
)

GAP_NS: Final = NS_PER_S
"""A robot is never silent for so long: something is missing."""


class MergeError(RuntimeError):
    """Recordings that no run can be made of; the text is one clear message."""


class Loss(NamedTuple):
    """Messages that are missing before `at_ns`; nobody knows how many with `overflow`."""

    at_ns: int
    messages: int
    overflow: bool


@dataclass(frozen=True)
class SegmentFile:
    """One segment: what the heads of its blocks say.

    `stretches` are the times (first, last ns) in which it has messages without a gap of `GAP_NS`; `orders`
    what came as an order, sealed or not, each once: nobody has looked at it yet.
    """

    path: Path
    about: About
    messages: int
    stretches: Sequence[tuple[int, int]]
    losses: Sequence[Loss] = ()
    orders: Sequence[bytes] = ()

    @property
    def first_ns(self) -> int:
        return self.stretches[0][0]

    @property
    def last_ns(self) -> int:
        return max(last for _, last in self.stretches)

    def overlaps(self, since_ns: int, until_ns: int) -> bool:
        return any(first_ns <= until_ns and last_ns >= since_ns for first_ns, last_ns in self.stretches)


@dataclass
class Damage:
    """How many damaged pieces, and messages that are not its own, were found in each robot's recording."""

    pieces: dict[int, int] = field(default_factory=dict)
    foreign: dict[int, int] = field(default_factory=dict)

    def add(self, robot: int, pieces: int, foreign: int) -> None:
        if pieces:
            self.pieces[robot] = self.pieces.get(robot, 0) + pieces
        if foreign:
            self.foreign[robot] = self.foreign.get(robot, 0) + foreign


class Recordings(NamedTuple):
    """All segments that hold messages. `refused`: robots in whose folders were segments of another robot."""

    segments: Sequence[SegmentFile]
    refused: Sequence[int]


def recordings(folders: Mapping[int, Path]) -> Recordings:
    """The segments in the folders of robots, by their ids.

    A segment that lost its first block belongs to whom its neighbour in the folder belongs to.

    Raises:
        MergeError: a folder or a file cannot be read.
    """
    found: list[SegmentFile] = []
    refused = []
    for robot, folder in folders.items():
        try:
            segments = [(path, about_of(path)) for path in segment_paths(folder)]
            known = next((about for _, about in segments if about is not None and about.robot == robot), None)
            for path, about in segments:
                if about is not None and about.robot != robot:
                    refused.append(robot)
                    continue
                known = about or known
                if known is not None and (segment := scan(path, known)).messages:
                    found.append(segment)
        except OSError as error:
            raise MergeError(f"cannot read {error.filename or folder}: {error.strerror or error}") from None
    return Recordings(found, sorted(set(refused)))


def about_of(path: Path) -> About | None:
    """What a segment's first block tells, None where it is damaged.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as stream:
        segment = Segment(stream)
        block = next(segment.blocks(), None)
        return segment.about(block) if block is not None and block.kind == ABOUT else None


def scan(path: Path, about: About) -> SegmentFile:
    """What the heads of one segment's blocks say, and what came as orders.

    Raises:
        OSError: it cannot be read.
    """
    messages = 0
    stretches: list[tuple[int, int]] = []
    losses: list[Loss] = []
    orders: dict[bytes, None] = {}  # a set in the order of time
    wanted = order_keys(about.fleet, about.robot)
    with open(path, "rb") as stream:
        segment = Segment(stream)
        for block in segment.blocks():
            if block.kind == ABOUT:
                continue
            if block.kind == KNOWN or block.flags & ORDERS:
                orders |= {payload: None for _, key, payload in segment.messages(block) if key in wanted}
            if block.kind == KNOWN:
                continue
            messages += block.messages
            if stretches and 0 <= block.first_ns - stretches[-1][1] < GAP_NS:
                stretches[-1] = (stretches[-1][0], block.last_ns)
            else:
                stretches.append((block.first_ns, block.last_ns))
            if block.lost or block.flags & OVERFLOW:
                losses.append(Loss(block.first_ns, block.lost, bool(block.flags & OVERFLOW)))
    return SegmentFile(path, about, messages, stretches, losses, list(orders))


def by_time(
    segments: Sequence[SegmentFile], since_ns: int, until_ns: int, damage: Damage
) -> Iterator[Received]:
    """The messages of all segments but orders, in the order of their reception, with a block of each robot in
    memory.

    Raises:
        MergeError: a file cannot be read.
    """
    waiting = sorted(segments, key=lambda segment: segment.first_ns, reverse=True)
    heads: list[tuple[int, int, Received, Iterator[Received]]] = []
    begun = 0
    while waiting or heads:
        while waiting and (not heads or waiting[-1].first_ns <= heads[0][0]):
            messages = _messages(waiting.pop(), since_ns, until_ns, damage)
            begun += 1
            if (first := next(messages, None)) is not None:
                heapq.heappush(heads, (first[0], begun, first, messages))
        if heads:
            _, number, received, messages = heads[0]
            yield received
            if (following := next(messages, None)) is not None:
                heapq.heapreplace(heads, (following[0], number, following, messages))
            else:
                heapq.heappop(heads)


def _messages(segment: SegmentFile, since_ns: int, until_ns: int, damage: Damage) -> Iterator[Received]:
    """What the robot's agent and plant said; orders, which others gave, are left out."""
    own = frozenset(key_expressions.said_by(segment.about.fleet, segment.about.robot))
    orders = order_keys(segment.about.fleet, segment.about.robot)
    foreign = 0
    try:
        with open(segment.path, "rb") as stream:
            reader = Segment(stream)
            for block in reader.blocks():
                if block.kind == MESSAGES and block.first_ns <= until_ns and block.last_ns >= since_ns:
                    for received in reader.messages(block):
                        if not since_ns <= received[0] <= until_ns or received[1] in orders:
                            continue
                        if received[1] in own:
                            yield received
                        else:
                            foreign += 1
            damage.add(segment.about.robot, reader.damaged, foreign)
    except OSError as error:
        raise MergeError(f"cannot read {segment.path}: {error.strerror or error}") from None
