"""The folder of a robot's recording: how large it gets, what it does about a disk that is full or broken."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from handfast.agent.recorder import folder as recording_folder
from handfast.agent.recorder.folder import FolderInUseError, RecordingFolder, recording_files

BLOCK = b"b" * 100_000


def contents(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in recording_files(folder)]


def on_disk(folder: Path) -> int:
    return sum(map(len, contents(folder)))


def fails(number: int) -> Callable[..., Any]:
    def call(*_: object) -> Any:
        raise OSError(number, os.strerror(number))

    return call


def disk_with(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(recording_folder.os, "statvfs", lambda _: SimpleNamespace(f_bavail=free, f_frsize=1))


def test_data_are_appended_to_one_file(tmp_path: Path) -> None:
    with RecordingFolder(tmp_path / "a" / "b", 16_000_000, 0) as folder:
        folder.append(b"one")
        assert contents(folder.path) == [b"one"], "on the disk at once"
        folder.append(b"two")
    assert contents(folder.path) == [b"onetwo"]


def test_a_new_start_begins_a_new_file(tmp_path: Path) -> None:
    for _ in range(2):
        with RecordingFolder(tmp_path, 16_000_000, 0) as folder:
            folder.append(b"one")
            folder.end_file()
            folder.append(b"two")
    assert contents(tmp_path) == [b"one", b"two", b"one", b"two"]


def test_it_never_takes_more_than_its_share(tmp_path: Path) -> None:
    most = 1_000_000
    with RecordingFolder(tmp_path, most, 0) as folder:
        for count in range(1, 41):
            folder.append(BLOCK, ends=folder.is_full_with(len(BLOCK)))
            assert on_disk(tmp_path) <= most
            newest = recording_files(tmp_path)[-1].read_bytes()
            assert newest.endswith(BLOCK), "the newest is always there"
            assert on_disk(tmp_path) >= min(count * len(BLOCK), most // 2), "the oldest goes, not all"


def test_only_recordings_are_removed(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"x" * 2_000_000)
    with RecordingFolder(tmp_path, 1_000_000, 0) as folder:
        for _ in range(20):
            folder.append(BLOCK, ends=folder.is_full_with(len(BLOCK)))
    assert (tmp_path / "notes.txt").exists()


def test_the_reserve_of_the_disk_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RecordingFolder(tmp_path, 16_000_000, 5_000_000) as folder:
        disk_with(monkeypatch, 6_000_000)
        folder.append(b"one")
        disk_with(monkeypatch, 5_000_000)
        with pytest.raises(OSError, match="5 MB are free, 5 MB are kept for others") as caught:
            folder.append(b"two")
        assert caught.value.errno in recording_folder.PASSING
        disk_with(monkeypatch, 6_000_000)
        folder.append(b"three")
    assert contents(tmp_path) == [b"one", b"three"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT])
def test_a_disk_that_takes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    with RecordingFolder(tmp_path, 16_000_000, 0) as folder:
        for ready in ("", "one"):
            with monkeypatch.context() as broken:
                broken.setattr(recording_folder, "_to_disk", fails(number))
                with pytest.raises(OSError) as caught:
                    folder.append(b"lost")
            assert caught.value.errno == number
            assert b"lost" not in b"".join(contents(tmp_path)), f"after {ready!r}"
            folder.append(b"one")
    assert [content[-3:] for content in contents(tmp_path)] == [b"one", b"one"]


def test_a_disk_that_takes_a_piece(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RecordingFolder(tmp_path, 16_000_000, 0) as folder:
        folder.append(b"one")
        resource.setrlimit(resource.RLIMIT_FSIZE, (5, limits[1]))
        try:
            with pytest.raises(OSError, match="only 2 of 3 bytes"):
                folder.append(b"two")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        folder.append(b"three")
    assert contents(tmp_path) == [b"one", b"three"]


def test_one_at_a_time(tmp_path: Path) -> None:
    with (
        RecordingFolder(tmp_path, 16_000_000, 0),
        pytest.raises(FolderInUseError, match="another process is recording there"),
    ):
        RecordingFolder(tmp_path, 16_000_000, 0)
    RecordingFolder(tmp_path, 16_000_000, 0).close()
