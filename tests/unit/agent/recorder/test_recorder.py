"""What a robot's computer records of what it hears: chunks, orders, and what the disk does not take."""

from __future__ import annotations

import errno
import os
import shutil
import threading
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, load_fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Stop, Wrench
from handfast.agent.recorder import __main__
from handfast.agent.recorder.folder import FolderInUseError, RecordingFolder, recording_files
from handfast.agent.recorder.recorder import (
    FLUSH_BYTES,
    FLUSH_NS,
    KNOWN_BYTES,
    ORDER_METADATA,
    RETRY_NS,
    WAITING_BYTES,
    About,
    Received,
    RobotRecorder,
    known_orders,
    order_of,
)
from handfast.agent.transport.bus import BusError
from handfast.deploy.console.data_files import FLEETS

BEGUN_NS = 1_763_600_000_000_000_000
TOLD = key_expressions.relayed("delta", 3)
HAND = key_expressions.hand("delta", 3)
ORDER_KEYS = frozenset({TOLD})
WHO = About("delta", "0123456789abcdef", 3, "0.1.0", '[fleet]\nname = "delta"\n')


class Disk(RecordingFolder):
    """A folder on a disk that can be told to fail, or to stall."""

    error = 0
    stalls = False

    def append(self, data: bytes, **how: bool) -> None:
        while self.stalls:
            time.sleep(0.001)
        if self.error:
            self.end_file()
            raise OSError(self.error, os.strerror(self.error))
        super().append(data, **how)


class Bench:
    """A recorder, its disk and its log."""

    def __init__(self, path: Path, known: list[Received] | None = None, bytes_max: int = 16_000_000) -> None:
        self.log: list[str] = []
        self.disk = Disk(path, bytes_max, 0)
        self.recorder = RobotRecorder(self.disk, WHO, ORDER_KEYS, known or [], self.log.append)
        self.now_ns = BEGUN_NS

    def hear(self, payload: bytes, key: str = HAND, after_s: float = 0.0) -> None:
        self.now_ns += round(after_s * NS_PER_S)
        self.recorder.add(self.now_ns, key, payload)
        self.recorder.flush_if_due(self.now_ns)
        self.settle()

    def settle(self) -> None:
        while not self.recorder.is_idle and not self.disk.stalls:
            time.sleep(0.001)

    def flush(self) -> None:
        self.recorder.flush(self.now_ns)
        self.settle()

    def end(self) -> None:
        self.recorder.end_file(self.now_ns)

    def close(self) -> None:
        self.disk.stalls = False
        with self.recorder:
            self.settle()
        self.disk.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path / "recording")
    yield bench
    bench.close()


class File(NamedTuple):
    """Contents of a file: messages chunk by chunk, and orders; and whether it is complete."""

    chunks: list[list[Received]]
    orders: list[Received]
    whole: bool


def read(path: Path) -> File:
    found = File([], [], whole=False)
    topics: dict[int, str] = {}
    try:
        for record in StreamReader(BytesIO(path.read_bytes()), emit_chunks=True).records:
            if isinstance(record, Metadata) and record.name == ORDER_METADATA:
                found.orders.append(order_of(record.metadata))
            elif isinstance(record, Chunk):
                records = breakup_chunk(record, validate_crc=True)
                topics |= {each.id: each.topic for each in records if isinstance(each, Channel)}
                found.chunks.append(
                    [
                        (each.log_time, topics[each.channel_id], each.data)
                        for each in records
                        if isinstance(each, Message)
                    ]
                )
    except EndOfFile:
        return found
    return found._replace(whole=True)


def files(bench: Bench) -> list[File]:
    return [read(path) for path in recording_files(bench.disk.path)]


def messages(bench: Bench) -> list[Received]:
    return [message for file in files(bench) for chunk in file.chunks for message in chunk]


def test_a_message_is_on_the_disk_within_a_second(bench: Bench) -> None:
    sent = []
    for number in range(100):  # two seconds
        bench.hear(b"%d" % number, after_s=0.02)
        sent.append((bench.now_ns, HAND, b"%d" % number))
        there = messages(bench)
        assert there == sent[: len(there)]
        waits = sent[len(there) :]
        assert not waits or bench.now_ns - waits[0][0] < FLUSH_NS
    assert not any(file.whole for file in files(bench))
    bench.end()
    assert messages(bench) == sent
    assert [file.whole for file in files(bench)] == [True]
    assert all(chunk[-1][0] - chunk[0][0] < NS_PER_S for file in files(bench) for chunk in file.chunks)


def test_a_message_is_json_that_any_tool_reads(bench: Bench) -> None:
    wrench = Wrench(3, 7, BEGUN_NS, 1.5, -0.25, False)
    bench.hear(encode(wrench), key_expressions.wrench("delta", 3))
    bench.end()
    (path,) = recording_files(bench.disk.path)
    ((schema, channel, message),) = make_reader(BytesIO(path.read_bytes())).iter_messages()
    assert schema is not None
    assert (schema.name, schema.encoding) == ("handfast.Wrench", "jsonschema")
    assert (channel.topic, channel.message_encoding) == ("delta/robot/3/plant/wrench", "json")
    assert (message.sequence, message.publish_time) == (7, BEGUN_NS)
    assert b'"time_ns":%d' % BEGUN_NS in message.data


def test_silence_writes_nothing(bench: Bench) -> None:
    for _ in range(5):
        bench.now_ns += NS_PER_S
        bench.recorder.flush_if_due(bench.now_ns)
    bench.end()
    assert recording_files(bench.disk.path) == []


def test_a_flood_does_not_wait(bench: Bench) -> None:
    for _ in range(2 * FLUSH_BYTES // 60_000 + 2):
        bench.hear(os.urandom(60_000))
    (file,) = files(bench)
    assert sum(len(payload) for chunk in file.chunks for _, _, payload in chunk) > 2 * FLUSH_BYTES - 120_000


def test_a_full_file_is_followed_by_another(tmp_path: Path) -> None:
    bench = Bench(tmp_path, bytes_max=4_000_000)
    for _ in range(60):
        bench.hear(os.urandom(100_000), after_s=1.0)
        assert sum(path.stat().st_size for path in recording_files(tmp_path)) <= 4_000_000
    found = files(bench)
    assert all(file.whole for file in found[:-1])
    assert len(found) >= 3
    assert all(path.stat().st_size < 1_300_000 for path in recording_files(tmp_path))
    bench.close()


def test_every_file_has_the_orders_from_before_it(bench: Bench) -> None:
    stop = encode(Stop(3, BEGUN_NS, "lunch"))
    bench.hear(stop, TOLD)
    told = bench.now_ns, TOLD, stop
    bench.hear(b"a", after_s=1.0)
    bench.hear(stop, TOLD, after_s=1.0)
    bench.end()
    bench.hear(b"c", after_s=1.0)
    bench.end()
    first, second = files(bench)
    assert (first.orders, second.orders) == ([told], [told])
    assert sum(key == TOLD for chunk in first.chunks for _, key, _ in chunk) == 2, "each time it was received"
    assert [key for chunk in second.chunks for _, key, _ in chunk] == [HAND]


def test_orders_outlive_the_process_and_their_file(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.hear(b"mission", TOLD)
    bench.hear(b"noise")
    bench.flush()
    told_ns = bench.now_ns
    for _ in range(3):
        bench.close()
        newest = recording_files(tmp_path)[-1]
        bench = Bench(tmp_path, known_orders(newest, ORDER_KEYS))
        newest.unlink()
        bench.hear(b"later", after_s=1.0)
        bench.flush()
    assert files(bench)[0].orders == [(told_ns, TOLD, b"mission")]
    bench.close()


def test_of_many_orders_the_newest_are_known(bench: Bench) -> None:
    for number in range(20):
        bench.hear(b"%02d" % number + bytes(KNOWN_BYTES // 10), TOLD)
    bench.hear(b"19" + bytes(KNOWN_BYTES // 10), TOLD)
    bench.end()
    bench.hear(b"c", after_s=1.0)
    bench.end()
    known = [payload[:2] for _, _, payload in files(bench)[-1].orders]
    assert known == [b"%02d" % number for number in range(11, 20)]


def test_a_full_disk_is_said_once_and_counted(bench: Bench) -> None:
    bench.hear(b"before", after_s=1.0)
    bench.flush()
    bench.disk.error = errno.ENOSPC
    for _ in range(20):
        bench.hear(b"lost", after_s=1.0)
    bench.hear(b"order", TOLD)
    said = f"not recording: {bench.disk.path} takes no more (No space left on device); tried again every 5 s"
    assert bench.log == [said]
    bench.disk.error = 0
    bench.now_ns += RETRY_NS
    for _ in range(3):
        bench.hear(b"after", after_s=1.0)
    bench.end()
    found = files(bench)
    kept = [payload for _, _, payload in messages(bench)]
    lost = 25 - len(kept)
    assert (kept[0], kept[-1]) == (b"before", b"after")
    assert bench.log[1:] == [f"recording again; {lost} messages were not kept"]
    assert bench.recorder.lost == 0
    assert [payload for _, _, payload in found[-1].orders] == [b"order"], "no order is lost"


def test_a_disk_that_fails_is_not_tried_all_the_time(bench: Bench) -> None:
    tried = []

    def fail(data: bytes, **_: bool) -> None:
        tried.append(data)
        raise OSError(errno.EIO, "Input/output error")

    bench.disk.append = fail  # type: ignore[method-assign]
    for _ in range(30):
        bench.hear(b"lost", after_s=1.0)
    assert 30 * NS_PER_S // RETRY_NS - 2 <= len(tried) <= 30 * NS_PER_S // RETRY_NS
    assert len(bench.log) == 1


def test_what_is_heard_while_the_disk_stalls_has_the_time_of_its_reception(bench: Bench) -> None:
    bench.disk.stalls = True
    for number in range(100):
        bench.hear(b"%d" % number, after_s=0.05)
    assert not bench.recorder.is_idle
    bench.disk.stalls = False
    bench.end()
    assert [at_ns for at_ns, _, _ in messages(bench)] == [
        BEGUN_NS + k * NS_PER_S // 20 for k in range(1, 101)
    ]
    assert bench.log == []


def test_what_there_is_no_room_for_while_the_disk_stalls_is_counted(bench: Bench) -> None:
    bench.disk.stalls = True
    bench.hear(b"first")
    bench.flush()
    count = WAITING_BYTES // 100_000 + 3
    for _ in range(count):
        bench.hear(bytes(100_000), after_s=1.0)
    bench.disk.stalls = False
    bench.settle()
    bench.hear(b"after", after_s=1.0)
    bench.end()
    lost = count + 2 - len(messages(bench))
    assert lost > count // 2
    assert bench.log == [
        "the disk is too slow: messages are not kept", f"recording again; {lost} messages were not kept"
    ]  # fmt: skip


@pytest.mark.parametrize("error", [0, errno.EIO])
def test_a_clock_that_is_set_begins_a_file(bench: Bench, error: int) -> None:
    bench.hear(b"before")
    bench.disk.error = error
    bench.flush()
    bench.recorder.set_clock(bench.now_ns, -3600.0)
    bench.disk.error = 0
    bench.now_ns -= 3600 * NS_PER_S
    bench.hear(b"after")
    bench.end()
    assert [payload for _, _, payload in messages(bench)] == ([] if error else [b"before"]) + [b"after"]
    assert len(files(bench)) == (1 if error else 2)
    assert "this computer's clock was set by -3600.000 s" in bench.log


def test_a_folder_that_is_gone_is_not_waited_for(bench: Bench) -> None:
    shutil.rmtree(bench.disk.path)
    bench.hear(b"a")
    with pytest.raises(FileNotFoundError):
        bench.end()


# --- the process ----------------------------------------------------------------------------------


def process(bench: Bench, came: list[list[tuple[str, bytes]]]) -> None:
    """Run the loop of the process until all that `came` is heard."""
    shutdown: Any = SimpleNamespace(asked=False)

    def drain() -> list[tuple[str, bytes]]:
        shutdown.asked = shutdown.asked or len(came) <= 1
        return came.pop(0) if came else []

    service: Any = SimpleNamespace(lives=lambda _: None, stopping=lambda: None)
    shutdown.look_for_parent = lambda: None
    __main__.record(SimpleNamespace(drain=drain), bench.recorder, shutdown, service)  # type: ignore[arg-type]


def test_all_is_on_the_disk_at_an_orderly_end(bench: Bench) -> None:
    threading.Timer(0.2, setattr, (bench.disk, "stalls", False)).start()
    bench.disk.stalls = True
    process(bench, [[(HAND, b"one")], [(HAND, b"two")]])
    assert [payload for _, _, payload in messages(bench)] == [b"one", b"two"]
    assert [file.whole for file in files(bench)] == [True]


def test_a_folder_that_is_gone_ends_the_process(bench: Bench) -> None:
    shutil.rmtree(bench.disk.path)
    with pytest.raises(FileNotFoundError):
        process(bench, [[(HAND, bytes(FLUSH_BYTES))]] * 3)


def test_about_names_the_fleet_as_the_mission_does() -> None:
    path = FLEETS / "delta.toml"  # not resolved
    fleet = load_fleet(path)
    about = __main__.about(fleet, path.read_text(), 3)
    assert about.digest == digest(resolved(fleet))
    assert (about.fleet, about.robot, about.fleet_toml) == ("delta", 3, path.read_text())


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fleet = str(FLEETS / "pair.toml")
    (tmp_path / "file").touch()

    def said(*arguments: str) -> tuple[int, str]:
        status = __main__.main(arguments)
        (line,) = capsys.readouterr().err.splitlines()
        return status, line

    status, line = said("--fleet", fleet, "--robot", "7", "--folder", str(tmp_path / "a"))
    assert (status, "there is no robot 7" in line) == (2, True)
    status, line = said("--fleet", fleet, "--robot", "1", "--folder", str(tmp_path / "file"))
    assert (status, line) == (2, f"robot 1 recorder: cannot record into {tmp_path / 'file'}: File exists")
    with RecordingFolder(tmp_path / "b", 16_000_000):
        status, line = said("--fleet", fleet, "--robot", "1", "--folder", str(tmp_path / "b"))
    assert (status, "another process is recording there" in line) == (1, True)
    assert issubclass(FolderInUseError, RuntimeError)


@pytest.mark.parametrize(
    ("number", "status"),
    [(errno.EACCES, 2), (errno.ENOTDIR, 2), (errno.ENOENT, 1), (errno.EMFILE, 1), (errno.ENOSPC, 1)],
)
def test_only_what_another_start_does_not_mend_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, status: int
) -> None:
    def cannot_be_made(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(__main__, "RecordingFolder", cannot_be_made)
    arguments = ["--fleet", str(FLEETS / "pair.toml"), "--robot", "1", "--folder", str(tmp_path / "a")]
    assert __main__.main(arguments) == status


def test_its_threads_are_nice_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def open_bus(*_: object, **__: object) -> None:
        done.append("bus")
        raise BusError("not here")

    monkeypatch.setattr(__main__.os, "nice", lambda _: done.append("nice"))
    monkeypatch.setattr(__main__, "open_bus", open_bus)
    arguments = ["--fleet", str(FLEETS / "pair.toml"), "--robot", "1", "--folder", str(tmp_path / "a")]
    assert __main__.main(arguments) == 1
    assert done == ["nice", "bus"]


def test_orders_are_known_though_the_newest_file_is_cut(bench: Bench) -> None:
    bench.hear(b"mission", TOLD)
    told_ns = bench.now_ns
    bench.end()
    bench.hear(b"noise", after_s=1.0)
    bench.end()
    newest = recording_files(bench.disk.path)[-1]
    newest.write_bytes(newest.read_bytes()[:20])
    assert __main__.known(bench.disk.path, ORDER_KEYS) == [(told_ns, TOLD, b"mission")]
    assert __main__.known(bench.disk.path / "none", ORDER_KEYS) == []
