"""The runs of this user that live on this machine."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from handfast.agent.runtime.runtime_folder import NotPrivateError
from handfast.deploy.inventory import registry
from handfast.deploy.inventory.registry import Registration, entries, running


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty private folder instead of the user's."""
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setattr(registry, "private_folder", lambda: private)
    return private


def a_run(tmp_path: Path, name: str, folder: str) -> Registration:
    return Registration(name, tmp_path / folder, tmp_path / folder / "fleet.toml")


def test_known_while_it_lives(tmp_path: Path, folder: Path) -> None:
    with a_run(tmp_path, "pair", "a"), a_run(tmp_path, "delta", "b"):
        assert [run.name for run in running()] == ["delta", "pair"]
        assert str(running()[1]).startswith(f"pair ({tmp_path / 'a'}, since ")
    assert list(folder.iterdir()) == []
    assert running() == []


def test_what_a_killed_run_left_is_removed(tmp_path: Path, folder: Path) -> None:
    with a_run(tmp_path, "pair", "a"):
        entry = next(folder.iterdir())
        text = entry.read_text()
        # A dead process holds no lock, whoever has its number now.
        (folder / "run-1-1.json").write_text(text)
        assert [run.folder for run in running()] == [json.loads(text)["folder"]]
        assert [path.name for path in folder.iterdir()] == [entry.name]


def test_one_whose_file_an_editor_replaced_is_told(tmp_path: Path, folder: Path) -> None:
    with a_run(tmp_path, "pair", "a"):
        entry = next(folder.iterdir())
        edited = folder / "edited"
        edited.write_text(entry.read_text())
        edited.rename(entry)  # without the lock
        found, unreadable = entries()
        assert found == []
        assert f"the run of process {os.getpid()} cannot be told" in unreadable[0]
        # Of this process's number, but from before it was there.
        before = folder / f"run-{os.getpid()}-1.json"
        before.write_text(entry.read_text())
        assert len(entries()[1]) == 1
        assert not before.exists()
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    "text",
    [
        '{"name": "pair"}',
        "{",
        "",
        "[" * 5000,
        '{"name": 5, "pid": 1, "folder": "", "fleet_file": "", "started": ""}',
        '{"name": "a", "pid": "1", "folder": "", "fleet_file": "", "started": ""}',
        '{"name": "a", "pid": 1, "folder": "", "fleet_file": "", "started": "", "new": 1}',
        '{"name": "a", "pid": PID, "folder": "\\u0000", "fleet_file": "", "started": ""}',
        '{"name": "a\\u001b", "pid": PID, "folder": "", "fleet_file": "", "started": ""}',
        '{"name": "a", "pid": 10000000000000000000000, "folder": "", "fleet_file": "", "started": ""}',
    ],
)
def test_a_live_run_whose_entry_says_nothing_is_told(tmp_path: Path, folder: Path, text: str) -> None:
    with a_run(tmp_path, "pair", "a"), a_run(tmp_path, "delta", "b"):
        entry = min(folder.iterdir(), key=lambda path: int(path.stem.split("-")[2]))
        entry.write_text(text.replace("PID", str(os.getpid())))
        runs, unreadable = entries()
        assert [run.name for run in runs] == ["delta"]
        assert unreadable == [
            f"the run of process {os.getpid()} cannot be told: {entry} is damaged, or another version's; "
            f"Ctrl-C where it was started, or `kill -INT {os.getpid()}`, stops it"
        ]
        assert entry.exists()


def test_what_is_no_file_is_no_run(folder: Path) -> None:
    (folder / "run-1-2.json").mkdir()
    (folder / "run-1-3.json").symlink_to(folder / "none")
    os.mkfifo(folder / "run-1-4.json")
    assert entries() == ([], [])


def test_a_folder_that_is_not_this_users_is_not_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def private_folder() -> Path:
        raise NotPrivateError("/tmp/x must be a folder of this user")

    monkeypatch.setattr(registry, "private_folder", private_folder)
    assert entries() == ([], ["which fleets run here cannot be told: /tmp/x must be a folder of this user"])
    with pytest.raises(NotPrivateError):
        a_run(tmp_path, "pair", "a")
