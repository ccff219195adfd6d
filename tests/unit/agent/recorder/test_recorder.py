"""What a robot's computer records of what it hears: blocks, orders, and what the disk does not take."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, load_fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.recorder import __main__
from handfast.agent.recorder.recorder import (
    BLOCK_BYTES,
    BLOCK_NS,
    KNOWN_BYTES,
    RETRY_NS,
    RobotRecorder,
    known_orders,
)
from handfast.agent.recorder.segment_folder import FolderInUseError, SegmentFolder, segment_paths
from handfast.agent.recorder.segments import (
    ABOUT,
    KNOWN,
    MESSAGES,
    ORDERS,
    OVERFLOW,
    About,
    Block,
    Received,
    Segment,
)
from handfast.agent.transport.bus import BusError
from handfast.deploy.console.data_files import FLEETS

BEGUN_NS = 1_763_600_000_000_000_000
TOLD = key_expressions.relayed("delta", 3)
HAND = key_expressions.hand("delta", 3)
ORDER_KEYS = frozenset({TOLD})
WHO = About("delta", "0123456789abcdef", 3, "0.1.0", "boot", 0, 0, "")


class Disk(SegmentFolder):
    """A folder on a disk that can be told to fail."""

    error = 0

    def append(self, block: bytes, first: object) -> None:
        if self.error:
            self.end_segment()
            raise OSError(self.error, os.strerror(self.error))
        super().append(block, first)  # type: ignore[arg-type]


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

    def flush(self) -> None:
        self.recorder.flush(self.now_ns)


def blocks(path: Path) -> list[tuple[Block, list[Received]]]:
    """All blocks of messages and of known orders in a folder."""
    found = []
    for each in segment_paths(path):
        with open(each, "rb") as stream:
            segment = Segment(stream)
            for block in segment.blocks():
                if block.kind == ABOUT:
                    assert segment.about(block) == WHO._replace(
                        number=int(each.stem[:8]), begun_ns=block.first_ns
                    )
                else:
                    found.append((block, segment.messages(block)))
            assert (segment.damaged, segment.cut) == (0, False)
    return found


def test_a_block_is_on_the_disk_within_a_second(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    sent = []
    for number in range(100):  # two seconds
        bench.hear(b"%d" % number, after_s=0.02)
        sent.append((bench.now_ns, HAND, b"%d" % number))
        there = [received for _, messages in blocks(tmp_path) for received in messages]
        assert there == sent[: len(there)]
        waits = sent[len(there) :]
        assert not waits or bench.now_ns - waits[0][0] < BLOCK_NS
    bench.flush()
    assert [received for _, messages in blocks(tmp_path) for received in messages] == sent
    bench.disk.close()


def test_silence_writes_nothing(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    for _ in range(5):
        bench.now_ns += NS_PER_S
        bench.recorder.flush_if_due(bench.now_ns)
    bench.flush()
    assert segment_paths(tmp_path) == []
    bench.disk.close()


def test_a_flood_does_not_wait(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    for _ in range(2 * BLOCK_BYTES // 60_000 + 2):
        bench.hear(os.urandom(60_000))
    assert len(blocks(tmp_path)) == 2
    bench.disk.close()


def test_orders_are_marked_and_told_in_every_segment_that_follows(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.hear(b"stop", TOLD)
    told_ns = bench.now_ns
    bench.hear(b"a", after_s=1.0)
    bench.hear(b"b", after_s=1.0)
    bench.flush()
    assert [(block.kind, block.flags) for block, _ in blocks(tmp_path)] == [
        (KNOWN, 0), (MESSAGES, ORDERS), (MESSAGES, 0),
    ]  # fmt: skip
    bench.disk.end_segment()
    bench.hear(b"c", after_s=1.0)
    bench.flush()
    block, messages = blocks(tmp_path)[-2]
    assert (block.kind, messages) == (KNOWN, [(told_ns, TOLD, b"stop")])
    bench.disk.close()


def test_orders_outlive_the_process_and_their_segment(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.hear(b"mission", TOLD)
    bench.hear(b"noise")
    bench.flush()
    told_ns = bench.now_ns
    for _ in range(3):
        bench.disk.close()
        newest = segment_paths(tmp_path)[-1]
        bench = Bench(tmp_path, list(known_orders(newest, ORDER_KEYS)))
        newest.unlink()
        bench.hear(b"later", after_s=1.0)
        bench.flush()
    block, messages = blocks(tmp_path)[0]
    assert (block.kind, messages) == (KNOWN, [(told_ns, TOLD, b"mission")])
    bench.disk.close()


def test_of_many_orders_the_newest_are_known(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    for number in range(20):
        bench.hear(b"%02d" % number + bytes(KNOWN_BYTES // 10), TOLD)
    bench.hear(b"19" + bytes(KNOWN_BYTES // 10), TOLD)
    bench.flush()
    bench.disk.end_segment()
    bench.hear(b"c", after_s=1.0)
    bench.flush()
    _, known = blocks(tmp_path)[-2]
    assert [payload[:2] for _, _, payload in known] == [b"%02d" % number for number in range(11, 20)]
    bench.disk.close()


def test_a_full_disk_is_said_once_and_counted(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.hear(b"before", after_s=1.0)
    bench.flush()
    bench.disk.error = errno.ENOSPC
    for _ in range(20):
        bench.hear(b"lost", after_s=1.0)
    bench.hear(b"order", TOLD)
    said = f"not recording: {tmp_path} takes no more (No space left on device); tried again every 5 s"
    assert bench.log == [said]
    bench.disk.error = 0
    bench.now_ns += RETRY_NS
    bench.hear(b"also lost")  # with the order: in the block that was due
    bench.hear(b"after", after_s=1.0)
    bench.flush()
    found = blocks(tmp_path)
    lost = sum(block.lost for block, _ in found)
    kept = [payload for block, messages in found for _, _, payload in messages if block.kind == MESSAGES]
    assert lost + len(kept) == 24
    assert kept[0] == b"before"
    assert kept[-1] == b"after"
    assert bench.log[1:] == [f"recording again; {lost} messages were not kept"]
    assert bench.recorder.lost == 0
    assert [m for block, m in found if block.kind == KNOWN][-1][0][2] == b"order", "no order is lost"
    bench.disk.close()


def test_a_disk_that_fails_is_not_tried_all_the_time(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    tried = []
    bench.disk.append = lambda *_: tried.append(bench.now_ns) or _fail()  # type: ignore[method-assign, func-returns-value]
    for _ in range(30):
        bench.hear(b"lost", after_s=1.0)
    assert 30 * NS_PER_S // RETRY_NS - 2 <= len(tried) <= 30 * NS_PER_S // RETRY_NS
    assert len(bench.log) == 1
    bench.disk.close()


def _fail() -> None:
    raise OSError(errno.EIO, "Input/output error")


def test_a_clock_that_is_set_begins_a_segment(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.hear(b"before")
    bench.flush()
    bench.recorder.set_clock(-3600.0)
    bench.now_ns -= 3600 * NS_PER_S
    bench.hear(b"after")
    bench.flush()
    assert len(segment_paths(tmp_path)) == 2
    assert bench.log == ["this computer's clock was set by -3600.000 s"]
    bench.disk.close()


def test_a_clock_set_back_does_not_keep_a_disk_from_being_tried(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.disk.error = errno.EIO
    bench.hear(b"lost")
    bench.flush()
    bench.recorder.set_clock(-3600.0)
    bench.now_ns -= 3600 * NS_PER_S
    bench.disk.error = 0
    bench.hear(b"after")
    bench.flush()
    assert len(blocks(tmp_path)) == 1
    bench.disk.close()


def test_an_overflow_is_told(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.recorder.overflow()
    bench.hear(b"a")
    bench.flush()
    bench.hear(b"b")
    bench.flush()
    assert [block.flags for block, _ in blocks(tmp_path)] == [OVERFLOW, 0]
    bench.disk.close()


def test_a_folder_that_is_gone_is_not_waited_for(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "there")
    shutil.rmtree(tmp_path / "there")
    bench.hear(b"a")
    with pytest.raises(FileNotFoundError):
        bench.flush()
    bench.disk.close()


# --- the process ----------------------------------------------------------------------------------


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
    with SegmentFolder(tmp_path / "b", 16_000_000):
        status, line = said("--fleet", fleet, "--robot", "1", "--folder", str(tmp_path / "b"))
    assert (status, "another process is recording there" in line) == (1, True)
    assert issubclass(FolderInUseError, RuntimeError)


@pytest.mark.parametrize(
    ("number", "status"), [(errno.EACCES, 2), (errno.ENOTDIR, 2), (errno.ENOENT, 1), (errno.EMFILE, 1)]
)
def test_only_what_another_start_does_not_mend_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, status: int
) -> None:
    def cannot_be_made(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(__main__, "SegmentFolder", cannot_be_made)
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


def test_orders_are_known_though_the_newest_segment_is_cut(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.hear(b"mission", TOLD)
    bench.flush()
    told_ns = bench.now_ns
    bench.disk.end_segment()
    bench.hear(b"noise", after_s=1.0)
    bench.flush()
    bench.disk.close()
    newest = segment_paths(tmp_path)[-1]
    newest.write_bytes(newest.read_bytes()[:20])
    assert set(__main__.known(tmp_path, ORDER_KEYS)) == {(told_ns, TOLD, b"mission")}
    assert __main__.known(tmp_path / "none", ORDER_KEYS) == []


def test_a_minute_of_a_robot_waits_on_the_bus() -> None:
    def sized(rate: str) -> int:
        slow = ("control.plant_timeout_s=2", "control.wrench_timeout_s=2")
        return __main__.inbox_size(load_fleet(FLEETS / "pair.toml", [f"fleet.rate_hz={rate}", *slow]))

    assert sized("50") == 16_500
    assert sized("200") == 4 * sized("50")
    assert sized("1") == __main__.INBOX_MIN
