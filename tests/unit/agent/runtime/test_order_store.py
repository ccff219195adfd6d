"""Orders on the disk: written by a thread, read again whole or not at all."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.runtime import order_store
from handfast.agent.runtime.order_store import (
    FILE_BYTES_MAX,
    LOOK_PERIOD_NS,
    ORDERS_MAX,
    STOP_FILE,
    OrderFileError,
    OrderStore,
    packed,
    unpacked,
)
from handfast.agent.security.private_files import KeyFileError
from tests.process.harness import wait_for

ORDERS = (b"stop", b"\x00\xff")


class Lines(list[str]):
    def __call__(self, line: str) -> None:
        self.append(line)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "orders"


def written(store: OrderStore, orders: tuple[bytes, ...]) -> str:
    """Has them kept; what came of it."""
    store.keep(orders, orders)
    waiting = threading.Event()
    for _ in range(1000):
        done = store.done()
        if done is not None and done[0] is orders:
            return done[1]
        waiting.wait(0.005)
    raise AssertionError("nothing is written")


@given(st.lists(st.binary(max_size=80), max_size=ORDERS_MAX))
def test_what_is_packed_is_unpacked(orders: list[bytes]):
    assert unpacked(packed(orders)) == tuple(orders)


@given(st.binary(max_size=200), st.data())
def test_nothing_else_is(junk: bytes, data: st.DataObject):
    with pytest.raises(OrderFileError):
        unpacked(junk)
    whole = packed(ORDERS)
    at = data.draw(st.integers(0, len(whole) - 2))
    with pytest.raises(OrderFileError):
        unpacked(whole[:at])


@pytest.mark.parametrize("changes", [
    {"format": 2}, {"orders": ["c3RvcA=="]}, {"orders": 3}, {"orders": [3, 4]}, {"crc32": 0}, {"crc32": "a"},
])  # fmt: skip
def test_nor_is_what_was_changed(changes: dict[str, object]):
    with pytest.raises(OrderFileError):
        unpacked(json.dumps(json.loads(packed(ORDERS)) | changes).encode())


def test_what_one_process_keeps_the_next_one_reads(folder: Path):
    log = Lines()
    with OrderStore(folder, 1, "agent", log) as store:
        assert store.read() == ()
        assert written(store, ORDERS) == ""
        assert written(store, (b"later",)) == ""
    assert OrderStore(folder, 1, "agent", log).read() == (b"later",)
    assert OrderStore(folder, 1, "plant", log).read() == ()
    assert log == []
    assert folder.stat().st_mode & 0o777 == 0o700


def test_the_end_waits_for_the_disk(folder: Path):
    with OrderStore(folder, 1, "agent", Lines()) as store:
        for number in range(20):
            store.keep((b"%d" % number,), (b"%d" % number,))
    assert OrderStore(folder, 1, "agent", Lines()).read() == (b"19",)


def test_a_damaged_file_is_put_aside_and_said(folder: Path):
    log = Lines()
    with OrderStore(folder, 1, "agent", log) as store:
        written(store, ORDERS)
        path = folder / "robot-1-agent.json"
        path.write_bytes(path.read_bytes()[:-7])
        assert store.read() == ()
        assert (folder / "robot-1-agent.damaged").exists()
        assert store.read() == ()
    assert log == [f"cannot use the orders kept in {path}: it is damaged: it is not what was written"]


def test_a_file_that_is_too_large_or_others_may_change_is_not_taken(folder: Path):
    log = Lines()
    store = OrderStore(folder, 1, "agent", log)
    path = folder / "robot-1-agent.json"
    path.write_bytes(b" " * (FILE_BYTES_MAX + 1))
    assert store.read() == ()
    path.write_bytes(packed(ORDERS))
    path.chmod(0o666)
    assert store.read() == ()
    assert len(log) == 2


def test_a_folder_that_others_may_look_into_is_refused(folder: Path):
    folder.mkdir(mode=0o755)
    with pytest.raises(KeyFileError, match="chmod 700"):
        OrderStore(folder, 1, "agent", Lines())


def test_a_disk_that_is_full_is_said_and_tried_again(folder: Path, monkeypatch: pytest.MonkeyPatch):
    log, full, real = Lines(), threading.Event(), order_store.write
    full.set()

    def write(path: Path, data: bytes, *, private: bool = False) -> None:
        if full.is_set():
            raise KeyFileError(f"cannot write {path}: no space left on device")
        real(path, data, private=private)

    monkeypatch.setattr(order_store, "write", write)
    monkeypatch.setattr(order_store, "RETRY_S", 0.01)
    with OrderStore(folder, 1, "agent", log) as store:
        trouble = f"not on its disk: cannot write {folder / 'robot-1-agent.json'}: no space left on device"
        assert written(store, ORDERS) == trouble
        full.clear()
        while store.done() != (ORDERS, ""):
            threading.Event().wait(0.005)
    assert log == [trouble, f"orders are kept again in {folder / 'robot-1-agent.json'}"]
    assert OrderStore(folder, 1, "agent", Lines()).read() == ORDERS


def test_a_stop_that_somebody_lays_there_is_found_once(folder: Path):
    log = Lines()
    store, now_ns = OrderStore(folder, 1, "agent", log), 0

    def looked() -> tuple[bytes, ...]:
        nonlocal now_ns
        now_ns += LOOK_PERIOD_NS
        return store.stops(now_ns)

    assert looked() == ()
    path = folder / STOP_FILE
    path.write_bytes(packed((b"one",)))
    assert looked() == (b"one",)
    assert looked() == ()
    new = folder / "new"
    new.write_bytes(packed((b"two",)))
    os.replace(new, path)
    assert store.stops(now_ns + 1) == ()  # not in every tick
    assert looked() == (b"two",)
    path.write_bytes(b"nonsense" * 9)
    assert looked() == ()
    assert looked() == ()
    assert log == [f"ignored {path}: it is damaged: it is not what was written"]


def test_one_that_was_there_before_is_found_by_who_starts(folder: Path):
    OrderStore(folder, 1, "agent", Lines())
    (folder / STOP_FILE).write_bytes(packed((b"one",)))
    assert OrderStore(folder, 2, "agent", Lines()).stops(1) == (b"one",)


def test_a_stop_that_cannot_be_read_is_tried_again(folder: Path) -> None:
    log = Lines()
    store, path = OrderStore(folder, 1, "agent", log), folder / STOP_FILE
    path.write_bytes(packed([b"stop"]))
    path.chmod(0o666)
    for look in range(1, 4):
        assert store.stops(look * 10**9) == ()
    assert len(log) == 1
    assert f"cannot read {path}" in log[0]
    path.chmod(0o600)
    assert store.stops(9 * 10**9) == (b"stop",)


def test_a_folder_that_cannot_be_made_is_said_and_tried_again(tmp_path: Path) -> None:
    log, folder = Lines(), tmp_path / "orders"
    folder.write_text("in its place")
    with OrderStore(folder, 1, "agent", log) as store:
        assert log[0].endswith("operators' orders are not kept until it can be made")
        assert (store.read(), store.stops(1)) == ((), ())
        store.keep((b"stop",), (b"stop",))
        trouble = wait_for(store.done, "it was tried")[1]
        assert trouble.startswith(f"not on its disk: cannot make the folder {folder}")
        folder.unlink()
        assert wait_for(store.done, "it was tried again") == ((b"stop",), "")
    assert OrderStore(folder, 1, "agent", log).read() == (b"stop",)


def test_a_folder_that_is_removed_is_made_again(folder: Path) -> None:
    with OrderStore(folder, 1, "agent", Lines()) as store:
        folder.rmdir()
        store.keep((b"stop",), (b"stop",))
        assert wait_for(store.done, "it is kept") == ((b"stop",), "")
