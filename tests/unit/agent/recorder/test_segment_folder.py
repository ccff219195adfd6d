"""The folder of a robot's recording: how large it gets, what it does about a disk that is full or broken."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from handfast.agent.recorder import segment_folder
from handfast.agent.recorder.segment_folder import FolderInUseError, SegmentFolder, segment_paths

BLOCK = b"b" * 100_000


def first(number: int) -> bytes:
    return b"first of %d" % number


def contents(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in segment_paths(folder)]


def on_disk(folder: Path) -> int:
    return sum(map(len, contents(folder)))


def fails(number: int) -> Callable[..., Any]:
    def call(*_: object) -> Any:
        raise OSError(number, os.strerror(number))

    return call


def disk_with(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(segment_folder.os, "statvfs", lambda _: SimpleNamespace(f_bavail=free, f_frsize=1))


def test_blocks_are_appended_to_one_segment(tmp_path: Path) -> None:
    with SegmentFolder(tmp_path / "a" / "b", 16_000_000, 0) as folder:
        folder.append(b"one", first)
        assert contents(folder.path) == [b"first of 1one"], "on the disk at once"
        folder.append(b"two", first)
    assert contents(folder.path) == [b"first of 1onetwo"]


def test_a_new_start_begins_a_new_segment(tmp_path: Path) -> None:
    for _ in range(2):
        with SegmentFolder(tmp_path, 16_000_000, 0) as folder:
            folder.append(b"one", first)
            folder.end_segment()
            folder.append(b"two", first)
    assert contents(tmp_path) == [b"first of 1one", b"first of 2two", b"first of 3one", b"first of 4two"]


def test_it_never_takes_more_than_its_share(tmp_path: Path) -> None:
    most = 1_000_000
    with SegmentFolder(tmp_path, most, 0) as folder:
        for count in range(1, 41):
            folder.append(BLOCK, first)
            assert folder.total_bytes == on_disk(tmp_path) <= most
            newest = segment_paths(tmp_path)[-1].read_bytes()
            assert newest.endswith(BLOCK), "the newest is always there"
            assert on_disk(tmp_path) >= min(count * len(BLOCK), most // 2), "the oldest goes, not all"


def test_a_smaller_share_than_before_is_kept_from_the_first_block_on(tmp_path: Path) -> None:
    with SegmentFolder(tmp_path, 4_000_000, 0) as folder:
        for _ in range(30):
            folder.append(BLOCK, first)
    with SegmentFolder(tmp_path, 1_200_000, 0) as folder:
        folder.append(BLOCK, first)
        assert on_disk(tmp_path) <= 1_200_000


def test_a_name_never_comes_again(tmp_path: Path) -> None:
    """Whoever has copied a segment may take one of the same name for the same, grown."""
    names = set()
    for _ in range(5):
        with SegmentFolder(tmp_path, 16_000_000, 0) as folder:
            folder.append(b"one", first)
        (path,) = segment_paths(tmp_path)
        names.add(path.name)
        path.unlink()
    assert len(names) == 5


def test_only_segments_are_removed(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"x" * 2_000_000)
    with SegmentFolder(tmp_path, 1_000_000, 0) as folder:
        for _ in range(20):
            folder.append(BLOCK, first)
    assert (tmp_path / "notes.txt").exists()


def test_a_segment_that_somebody_removed_is_not_missed(tmp_path: Path) -> None:
    with SegmentFolder(tmp_path, 1_000_000, 0) as folder:
        for _ in range(5):
            folder.append(BLOCK, first)
        segment_paths(tmp_path)[0].unlink()
        for _ in range(20):
            folder.append(BLOCK, first)
        assert on_disk(tmp_path) <= 1_000_000


def test_a_segment_that_goes_while_the_folder_is_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with SegmentFolder(tmp_path, 16_000_000, 0) as folder:
        folder.append(b"one", first)
        folder.end_segment()
        folder.append(b"two", first)
    oldest = segment_paths(tmp_path)[0]
    numbered = segment_folder._numbered

    def then_it_goes(path: Path) -> list[tuple[int, Path]]:
        found = numbered(path)
        oldest.unlink(missing_ok=True)
        return found

    monkeypatch.setattr(segment_folder, "_numbered", then_it_goes)
    with SegmentFolder(tmp_path, 16_000_000, 0) as folder:
        assert folder.total_bytes == on_disk(tmp_path)


def test_a_descriptor_is_closed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that a failed close freed may be somebody else's by now."""
    close, closed = os.close, []

    def fails_after(file: int) -> None:
        closed.append(file)
        close(file)
        raise OSError(errno.EIO, "Input/output error")

    folder = SegmentFolder(tmp_path, 16_000_000, 0)
    folder.append(b"one", first)
    with monkeypatch.context() as broken:
        broken.setattr(segment_folder.os, "close", fails_after)
        folder.end_segment()
        folder.end_segment()
    assert len(closed) == 1
    folder.append(b"two", first)
    folder.close()
    assert contents(tmp_path) == [b"first of 1one", b"first of 2two"]


def test_the_reserve_of_the_disk_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with SegmentFolder(tmp_path, 16_000_000, 5_000_000) as folder:
        disk_with(monkeypatch, 6_000_000)
        folder.append(b"one", first)
        disk_with(monkeypatch, 5_000_000)
        with pytest.raises(OSError, match="5 MB are free, 5 MB are kept for others") as caught:
            folder.append(b"two", first)
        assert caught.value.errno in segment_folder.PASSING
        disk_with(monkeypatch, 6_000_000)
        folder.append(b"three", first)
    assert contents(tmp_path) == [b"first of 1one", b"first of 2three"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT])
def test_a_disk_that_takes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    with SegmentFolder(tmp_path, 16_000_000, 0) as folder:
        for ready in ("", "one"):
            with monkeypatch.context() as broken:
                broken.setattr(segment_folder, "_to_disk", fails(number))
                with pytest.raises(OSError) as caught:
                    folder.append(b"lost", first)
            assert caught.value.errno == number
            assert b"lost" not in b"".join(contents(tmp_path)), f"after {ready!r}"
            folder.append(b"one", first)
    assert [content[-3:] for content in contents(tmp_path)] == [b"one", b"one"]


def test_a_disk_that_takes_a_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    with SegmentFolder(tmp_path, 16_000_000, 0) as folder:
        folder.append(b"one", first)
        with monkeypatch.context() as full:
            full.setattr(segment_folder.os, "write", lambda file, data: write(file, data[:2]))
            with pytest.raises(OSError, match="only 2 of 3 bytes"):
                folder.append(b"two", first)
        folder.append(b"three", first)
    assert contents(tmp_path) == [b"first of 1one", b"first of 2three"]


def test_a_leftover_that_cannot_be_removed_is_not_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with SegmentFolder(tmp_path, 16_000_000, 0) as folder:
        with monkeypatch.context() as broken:
            broken.setattr(segment_folder, "_to_disk", fails(errno.EIO))
            broken.setattr(Path, "unlink", fails(errno.EIO))
            with pytest.raises(OSError):
                folder.append(b"lost", first)
        folder.append(b"one", first)
    assert contents(tmp_path)[-1] == b"first of 2one"


def test_one_at_a_time(tmp_path: Path) -> None:
    with (
        SegmentFolder(tmp_path, 16_000_000, 0),
        pytest.raises(FolderInUseError, match="another process is recording there"),
    ):
        SegmentFolder(tmp_path, 16_000_000, 0)
    SegmentFolder(tmp_path, 16_000_000, 0).close()


def test_a_file_in_its_place(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        SegmentFolder(tmp_path / "file", 16_000_000, 0)
