"""Keys that only their user can read, and timestamps that never come twice."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from handfast.agent.security.private_files import KeyFileError
from handfast.bridges.mavlink.session import identity
from handfast.bridges.mavlink.session.identity import (
    AHEAD,
    EPOCH_S,
    STEPS_PER_S,
    SigningError,
    Timestamps,
    load_key,
    make_key,
)

NOW_NS = (EPOCH_S + 1000) * 1_000_000_000
NOW = 1000 * STEPS_PER_S


def write(path: Path, data: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(data)
    path.chmod(mode)
    return path


def test_a_made_key_is_read_back_and_only_its_users(tmp_path: Path) -> None:
    path = tmp_path / "key"
    key = make_key(path)
    assert len(key) == 32
    assert load_key(path) == key
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(SigningError, match="is there already"):
        make_key(path)
    assert load_key(path) == key
    assert make_key(tmp_path / "other") != key


@pytest.mark.parametrize("data", [b"", bytes(31), bytes(33), b"g" * 64, b"0" * 63, bytes(10_000)])
def test_anything_else_is_no_key(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(SigningError, match="must be 32 bytes or 64 hexadecimal digits"):
        load_key(write(tmp_path / "key", data))


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o601])
def test_a_key_that_others_may_use_is_refused(tmp_path: Path, mode: int) -> None:
    path = write(tmp_path / "key", bytes(32), mode)
    with pytest.raises(SigningError, match=f"chmod 600 {path}"):
        load_key(path)


def test_a_key_must_be_a_plain_file(tmp_path: Path) -> None:
    with pytest.raises(SigningError, match="plain file"):
        load_key(tmp_path)
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(SigningError, match="plain file"):  # and does not wait for a writer
        load_key(tmp_path / "pipe")
    with pytest.raises(SigningError, match="no such file"):
        load_key(tmp_path / "none")


def test_timestamps_follow_the_clock_and_never_come_twice(tmp_path: Path) -> None:
    stamps = Timestamps(tmp_path / "state" / "stamp", NOW_NS)
    taken = [
        stamps.next(NOW_NS),
        stamps.next(NOW_NS),
        stamps.next(NOW_NS - 10**12),
        stamps.next(NOW_NS + 10**9),
    ]
    assert taken == [NOW + 1, NOW + 2, NOW + 3, NOW + STEPS_PER_S]
    assert stamps.next(NOW_NS, at_least=NOW + 2 * STEPS_PER_S) == NOW + 2 * STEPS_PER_S
    stamps.close()


def stored(path: Path) -> int:
    return int(path.read_text())


def wait_stored(path: Path, least: int) -> None:
    """The thread writes when it gets round to it; a test waits for the file, not for a time."""
    pause = threading.Event()
    while stored(path) < least:
        pause.wait(0.002)


def test_after_a_crash_the_next_process_begins_later_whatever_the_clock_says(tmp_path: Path) -> None:
    path = tmp_path / "stamp"
    first = Timestamps(path, NOW_NS)
    used = 0
    for second in range(60):  # never closed in between: as if killed after any of them
        used = first.next(NOW_NS + second * 10**9)
        if second % 5 == 0:
            wait_stored(path, used)
        assert stored(path) > used - AHEAD
    first.close()
    second_process = Timestamps(path, NOW_NS - 10**15)
    assert second_process.next(NOW_NS - 10**15) > used
    second_process.close()


def test_a_disk_that_fails_is_told_and_does_not_stop_the_stamps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stamps = Timestamps(tmp_path / "stamp", NOW_NS)
    tried = threading.Event()

    def fail(path: Path, value: int) -> None:
        tried.set()
        raise KeyFileError(f"cannot write {path}: no space left on device")

    monkeypatch.setattr(identity, "_write", fail)
    late_ns = NOW_NS + 15 * 10**9
    assert stamps.next(late_ns) == NOW + 15 * STEPS_PER_S
    assert tried.wait(10)
    stamps.close()
    assert "no space left on device" in stamps.trouble


def test_a_damaged_or_unreachable_file_is_told(tmp_path: Path) -> None:
    path = write(tmp_path / "stamp", b"\xff\x00")
    with pytest.raises(SigningError, match="is damaged"):
        Timestamps(path, NOW_NS)
    with pytest.raises(SigningError, match="cannot keep the signing timestamp"):
        Timestamps(path / "below", NOW_NS)
