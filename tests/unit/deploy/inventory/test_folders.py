"""handfast.deploy.inventory.folders: names of new folders, and folders that are in the way."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.folders import cache_folder, out_folder, refuse_full, refuse_unwritable


def test_a_folder_is_the_one_that_is_named_or_has_the_name_and_the_time() -> None:
    assert out_folder("there", "delta") == out_folder(Path("there"), "delta") == Path("there")
    assert re.fullmatch(r"runs/delta-\d{8}-\d{6}", out_folder(None, "delta").as_posix())
    assert re.fullmatch(r"sweeps/delta-\d{8}-\d{6}", out_folder("", "delta", "sweeps").as_posix())


def test_drives_that_begin_within_a_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "strftime", lambda _: "20261126-120000")
    names = []
    for _ in range(3):
        folder = out_folder(None, "delta", str(tmp_path))
        folder.mkdir()
        names.append(folder.name)
    first = "delta-20261126-120000"
    assert names == [first, f"{first}-2", f"{first}-3"]


def test_what_is_there_and_not_an_empty_folder_is_refused(tmp_path: Path) -> None:
    refuse_full(tmp_path)
    refuse_full(tmp_path / "new")
    (tmp_path / "file").write_text("x")
    for full in (tmp_path, tmp_path / "file"):
        with pytest.raises(InputError, match=f"^{full} is not an empty folder: name another one with --out"):
            refuse_full(full)


def test_caches_are_where_the_user_keeps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    assert cache_folder("wheels") == Path("/elsewhere/handfast/wheels")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder("wheels") == Path.home() / ".cache/handfast/wheels"


def test_a_folder_that_cannot_be_written_into_is_refused_and_nothing_is_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    for out in ("new", "new/below", "."):
        refuse_unwritable(tmp_path / out)
    for out in ("file", "file/below", "gone/below", "n" * 300):
        with pytest.raises(InputError, match=rf"^cannot make the folder {tmp_path}/{out}: .*: name another"):
            refuse_unwritable(tmp_path / out)
    with pytest.raises(InputError, match=r"^cannot make the folder /proc/x: .*: name"):
        refuse_unwritable(Path("/proc/x"))
    with pytest.raises(InputError, match=r"^cannot write into /proc/sys: name another folder"):
        refuse_unwritable(Path("/proc/sys"))  # not even root can
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "gone"]
