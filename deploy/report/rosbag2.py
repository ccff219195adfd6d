"""A run as a bag of ROS 2: a folder with ``metadata.yaml`` and one MCAP file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from handfast.agent.runtime.version import handfast_version
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report.ros_messages import LATCHED, LOG, STORE, VOLATILE, Stream, streams
from handfast.deploy.report.whole_file import uninterrupted
from handfast.deploy.verdict.run_result import RunResult

METADATA_FILE: Final = "metadata.yaml"
VERSION: Final = 8
"""Of the metadata: the last one whose QoS profiles Humble reads; Iron, Jazzy and later ones read it too."""
_END_NS: Final = 2**31 * 1_000_000_000
"""From then on (2038) builtin_interfaces/Time has no seconds."""

_FOREVER: Final = QosTime(9_223_372_036, 854_775_807)  # RMW_DURATION_INFINITE


def _profile(depth: int, durability: QosDurability, lifespan: QosTime = _FOREVER) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE,
        durability,
        _FOREVER,
        lifespan,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


PROFILES: Final[Mapping[str, Qos]] = {
    VOLATILE: _profile(100, QosDurability.VOLATILE),
    LATCHED: _profile(1, QosDurability.TRANSIENT_LOCAL),
    LOG: _profile(1000, QosDurability.TRANSIENT_LOCAL, QosTime(10, 0)),  # rmw_qos_profile_rosout_default
}


def write_bag(result: RunResult, bag: Path) -> None:
    """Writes the bag of a run to the folder `bag`, in the place of the one that this wrote before.

    Whatever happens, there is a whole bag or the one from before.

    Raises:
        RecordingError: there is nothing to write, or `bag` holds something else; one line.
        OSError: it cannot be written.
    """
    recording = result.recording
    if recording.epoch_ns is None:
        raise RecordingError("there is no bag of this run: it was never begun, so nobody knows its time")
    if not any(len(robot.body) for robot in recording.robots.values()):
        raise RecordingError("there is no bag of this run: it has no pose of any robot")
    _refuse_other(bag)
    found = streams(result)
    if any(stream.times_ns[0] < 0 or stream.times_ns[-1] >= _END_NS for stream in found):
        raise RecordingError("there is no bag of this run: ROS 2 knows no times before 1970 or after 2038")
    about = {
        "handfast": handfast_version(),
        "fleet": recording.fleet.fleet.name,
        "mode": recording.mode,
        "epoch_ns": str(recording.epoch_ns),
    }
    with _whole(bag) as part:
        _write(part, found, about)


def _write(folder: Path, found: Sequence[Stream], about: Mapping[str, str]) -> None:
    """Writes all messages in the order of time, so that a reader has to keep few of them."""
    writer = Writer(folder, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    for key, value in about.items():
        writer.set_custom_data(key, value)
    times_ns = np.concatenate([stream.times_ns for stream in found])
    sources = np.repeat(np.arange(len(found)), [len(stream.times_ns) for stream in found])
    order = np.argsort(times_ns, kind="stable")
    with writer:
        connections: dict[str, Connection] = {}
        for stream in found:
            if stream.topic not in connections:
                connections[stream.topic] = writer.add_connection(
                    stream.topic, stream.type, typestore=STORE, offered_qos_profiles=[PROFILES[stream.qos]]
                )
        targets = [(connections[stream.topic], stream.messages) for stream in found]
        for source, time_ns in zip(sources[order].tolist(), times_ns[order].tolist(), strict=True):
            connection, messages = targets[source]
            writer.write(connection, time_ns, next(messages))


def _refuse_other(bag: Path) -> None:
    """Refuses to replace what is not a bag as `_write` writes it."""
    if not bag.is_symlink() and not bag.exists():
        return
    ours = {METADATA_FILE, f"{bag.name}.mcap"}
    if bag.is_symlink() or not bag.is_dir() or {each.name for each in bag.iterdir()} - ours:
        raise RecordingError(
            f"{bag} is not a bag of handfast alone: name another folder with --out, or remove it"
        )


@contextmanager
def _whole(bag: Path) -> Iterator[Path]:
    """A folder aside that takes the place of `bag` once it is whole, and is gone if it never is."""
    bag.parent.mkdir(parents=True, exist_ok=True)
    aside = TemporaryDirectory(prefix=f".{bag.name}-", dir=bag.parent, ignore_cleanup_errors=True)
    part, before = Path(aside.name) / bag.name, Path(aside.name) / "before"
    try:
        yield part
        with uninterrupted():
            if bag.exists():
                bag.rename(before)
            try:
                part.rename(bag)
            except BaseException:
                if before.exists():
                    before.rename(bag)
                raise
    finally:
        with uninterrupted():
            aside.cleanup()
