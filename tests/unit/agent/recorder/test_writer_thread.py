"""A disk that stalls does not keep a recorder from hearing."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.recorder import __main__, writer_thread
from handfast.agent.recorder.recorder import RobotRecorder
from handfast.agent.recorder.segments import MESSAGES, OVERFLOW
from handfast.agent.recorder.writer_thread import RecorderThread
from tests.unit.agent.recorder.test_recorder import BEGUN_NS, HAND, ORDER_KEYS, TOLD, WHO, Disk, blocks

TICK_NS = NS_PER_S // 20


class Stalling(Disk):
    """A disk that stalls until it is told to go on."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, 16_000_000, 0)
        self.asked, self.goes_on = threading.Event(), threading.Event()

    def append(self, block: bytes, first: object) -> None:
        self.asked.set()
        assert self.goes_on.wait(30.0)
        super().append(block, first)


class Bench:
    def __init__(self, path: Path) -> None:
        self.path, self.log = path, list[str]()
        self.disk = Stalling(path)
        self.recorder = RobotRecorder(self.disk, WHO, ORDER_KEYS, [], self.log.append)
        self.thread = RecorderThread(self.recorder)
        self.now_ns = BEGUN_NS

    def hear(self, *payloads: bytes, key: str = HAND, **told: Any) -> None:
        self.now_ns += TICK_NS
        self.thread.hear(self.now_ns, [(key, payload) for payload in payloads], **told)

    def stall(self) -> None:
        """Says something until the disk has to take it, which it does not."""
        self.hear(b"first")
        for _ in range(20):
            self.hear(b"more")
        assert self.disk.asked.wait(10.0)

    @property
    def kept(self) -> list[tuple[int, str, bytes]]:
        return [m for block, messages in blocks(self.path) if block.kind == MESSAGES for m in messages]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path / "recording")
    yield bench
    bench.disk.close()


def test_what_is_heard_while_the_disk_stalls_has_the_time_of_its_reception(bench: Bench) -> None:
    with bench.thread:
        bench.stall()
        for number in range(100):  # five seconds
            bench.hear(b"%d" % number)
        bench.disk.goes_on.set()
    times = [at_ns for at_ns, _, _ in bench.kept]
    assert times == [BEGUN_NS + number * TICK_NS for number in range(1, 122)]
    assert bench.log == []
    assert max(b.last_ns - b.first_ns for b, _ in blocks(bench.path)) < NS_PER_S


def test_what_there_is_no_room_for_is_counted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_thread, "WAITING_BYTES_MAX", 20_000)
    with bench.thread:
        bench.stall()
        for _ in range(100):
            bench.hear(b"x" * 750)
        assert bench.thread._bytes <= 20_000
        bench.hear(b"", key=TOLD)
        bench.disk.goes_on.set()
        while bench.thread._waiting:
            bench.thread._changed.acquire()
            bench.thread._changed.release()
        bench.hear(b"after")
    found = blocks(bench.path)
    lost = sum(block.lost for block, _ in found)
    assert lost > 50
    assert lost + len(bench.kept) == 21 + 100 + 2
    assert bench.log == [f"the disk was too slow: {lost} messages were not kept"]
    assert bench.recorder.lost == 0


def test_silence_while_the_disk_stalls_takes_no_memory(bench: Bench) -> None:
    with bench.thread:
        bench.stall()
        waiting = len(bench.thread._waiting)
        for _ in range(1000):
            bench.hear()
        assert len(bench.thread._waiting) <= waiting + 1
        bench.disk.goes_on.set()


def test_an_overflow_and_a_clock_that_is_set_are_told_in_their_place(bench: Bench) -> None:
    bench.disk.goes_on.set()
    with bench.thread:
        bench.hear(b"before", step_s=-3600.0)
        bench.now_ns -= 3600 * NS_PER_S
        bench.hear(b"after", overflow=True)
    assert [(block.flags, messages[0][2]) for block, messages in blocks(bench.path)] == [
        (0, b"before"), (OVERFLOW, b"after"),
    ]  # fmt: skip
    assert bench.log == ["this computer's clock was set by -3600.000 s"]


def test_a_folder_that_is_gone_ends_the_process(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.disk.goes_on.set()
    shutil.rmtree(bench.path)
    monkeypatch.setattr(__main__, "POLL_S", 0.0)
    bus: Any = SimpleNamespace(drain=lambda: [(HAND, bytes(100_000))])
    shutdown: Any = SimpleNamespace(asked=False, look_for_parent=lambda: None)
    service: Any = SimpleNamespace(lives=lambda _: None)
    with bench.thread, pytest.raises(FileNotFoundError):
        __main__.record(bus, 10, bench.thread, shutdown, service)


def test_all_is_on_the_disk_at_an_orderly_end(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.disk.goes_on.set()
    came = iter([[(HAND, b"one")], [(HAND, b"two")]])
    bus: Any = SimpleNamespace(drain=lambda: next(came))
    shutdown: Any = SimpleNamespace(asked=False)
    shutdown.look_for_parent = lambda: setattr(shutdown, "asked", True)
    service: Any = SimpleNamespace(lives=lambda _: None, stopping=lambda: None)
    with bench.thread:
        __main__.record(bus, 10, bench.thread, shutdown, service)
        assert [payload for _, _, payload in bench.kept] == [b"one", b"two"]
