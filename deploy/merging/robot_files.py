"""Files that robots' computers recorded (`agent.recorder`), in folders that were fetched.

A recording is believed about its own robot only. Its folder says which robot that is, and messages that this
robot could not have sent are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import merge as merged
from pathlib import Path
from typing import Final

from mcap.records import Attachment, Chunk, Metadata

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import TIME_NS_MAX, Message
from handfast.agent.recorder.folder import recording_files
from handfast.agent.recorder.message_file import FLEET_ATTACHMENT, RUN_METADATA
from handfast.agent.recorder.recorder import (
    ORDER_METADATA,
    About,
    Received,
    order_keys,
    order_of,
)
from handfast.deploy.recording.mcap_reader import McapFile
from handfast.deploy.recording.mcap_records import Records
from handfast.deploy.recording.run_files import RecordingError

GAP_NS: Final = NS_PER_S
"""A robot that is not recorded for this long is missing."""


class MergeError(RuntimeError):
    """Recordings that no run can be made of; the text is one clear message."""


@dataclass
class RobotFile:
    """One file of a recording.

    Attributes:
        about: None where the beginning of the file is damaged.
        stretches: times (first, last ns) in which it has messages without a gap of `GAP_NS`.
        orders: orders as they were received, not verified yet.
    """

    path: Path
    about: About | None = None
    stretches: list[tuple[int, int]] = field(default_factory=list)
    orders: list[Received] = field(default_factory=list)

    @property
    def robot(self) -> int:
        return self.about.robot if self.about else 0

    @property
    def first_ns(self) -> int:
        return self.stretches[0][0]

    @property
    def last_ns(self) -> int:
        return max(last for _, last in self.stretches)

    def overlaps(self, since_ns: int, until_ns: int) -> bool:
        return any(first <= until_ns and last >= since_ns for first, last in self.stretches)


@dataclass
class Damage:
    """Numbers, by robot, of damaged parts and of messages that are left out as they are not the robot's.

    `refused`: robots in whose folders were files of another robot.
    """

    pieces: Counter[int] = field(default_factory=Counter)
    foreign: Counter[int] = field(default_factory=Counter)
    refused: set[int] = field(default_factory=set)


def recordings(folders: Mapping[int, Path], damage: Damage) -> list[RobotFile]:
    """Return the files with messages in the folders of robots, by the robots' ids.

    A file whose beginning is damaged is taken for one of the fleet that its neighbour in the folder names.

    Raises:
        MergeError: a folder or a file cannot be read.
    """
    found: list[RobotFile] = []
    for robot, folder in folders.items():
        try:
            files = [scan(path) for path in recording_files(folder)]
        except OSError as error:
            raise MergeError(f"cannot read {error.filename or folder}: {error.strerror or error}") from None
        known = next((file.about for file in files if file.about and file.robot == robot), None)
        for file in files:
            if file.about is not None and file.robot != robot:
                damage.refused.add(robot)
                continue
            file.about = known = file.about or known
            if file.about is not None and file.stretches:
                keys = order_keys(file.about.fleet, robot)
                file.orders = [order for order in file.orders if order[1] in keys]
                found.append(file)
    return found


def scan(path: Path) -> RobotFile:
    """Read all of a file but its messages.

    Raises:
        OSError: the file cannot be read.
    """
    found = RobotFile(path)
    run: Mapping[str, str] = {}
    with open(path, "rb") as stream:
        for record in Records(stream, wants=lambda chunk: False):
            if isinstance(record, Chunk):
                first_ns, last_ns = record.message_start_time, record.message_end_time
                if found.stretches and 0 <= first_ns - found.stretches[-1][1] < GAP_NS:
                    first_ns = found.stretches.pop()[0]
                found.stretches += [(first_ns, last_ns)] if first_ns <= last_ns <= TIME_NS_MAX else []
                continue
            try:
                if isinstance(record, Attachment) and record.name == FLEET_ATTACHMENT:
                    text = record.data.decode(errors="replace")
                    found.about = About(run["fleet"], run["digest"], int(run["robot"]), run["version"], text)
                elif isinstance(record, Metadata) and record.name == RUN_METADATA:
                    run = record.metadata
                elif isinstance(record, Metadata) and record.name == ORDER_METADATA:
                    found.orders.append(order_of(record.metadata))
            except (KeyError, ValueError):
                continue  # no recorder wrote that
    return found


def by_time(
    files: Iterable[RobotFile],
    since_ns: int,
    until_ns: int,
    damage: Damage,
    keys: frozenset[str] | None = None,
) -> Iterator[Received]:
    """The messages in files but orders, in the order of reception, with a chunk of each robot in memory.

    Args:
        keys: all others are skipped; None for all keys of the robots' own.

    Raises:
        MergeError: a file cannot be read.
    """
    by_robot: dict[int, list[RobotFile]] = {}
    for file in sorted(files, key=lambda file: file.first_ns):
        by_robot.setdefault(file.robot, []).append(file)
    return merged(*(_messages(each, since_ns, until_ns, damage, keys) for each in by_robot.values()))


def _messages(
    files: Sequence[RobotFile], since_ns: int, until_ns: int, damage: Damage, keys: frozenset[str] | None
) -> Iterator[Received]:
    """The messages of one robot's agent and plant, without orders, which others gave."""

    def wants(chunk: Chunk) -> bool:
        return bool(chunk.message_start_time <= until_ns and chunk.message_end_time >= since_ns)

    for file in files:
        assert file.about is not None
        own = frozenset(key_expressions.said_by(file.about.fleet, file.robot))
        orders = order_keys(file.about.fleet, file.robot)
        reader = McapFile(file.path, wants, keys)
        try:
            for received_ns, key, message in reader.read():
                if since_ns <= received_ns <= until_ns and key not in orders:
                    if payload := _encoded(message) if key in own else b"":
                        yield received_ns, key, payload
                    else:
                        damage.foreign[file.robot] += 1
        except RecordingError as error:
            if isinstance(error.__cause__, OSError):
                raise MergeError(str(error)) from None
            damage.pieces[file.robot] += 1
        for lost in reader.lost:
            overlaps = (lost.until_ns or until_ns) >= since_ns and (lost.since_ns or since_ns) <= until_ns
            damage.pieces[file.robot] += overlaps


def _encoded(message: Message) -> bytes:
    """A message as it is on the bus, so that it is validated as from there; b"" where it cannot be."""
    try:
        return encode(message)
    except Exception:  # any type in any field, of a file that somebody made up
        return b""
