"""The runs of this user that live on this machine.

Which fleets are up, as the operator noted it.
"""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.runtime.order_store import NotPrivateError
from handfast.deploy.inventory import registry
from handfast.deploy.inventory.registry import FleetUp, Registration, entries, note_down, note_up, running
from tests.unit.agent.fleet.test_hosts import HOSTS, LEFT, fleet


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


SOURCE = Path("/fleets/two.toml")
BOTH = ("left", "right")


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state"


def at(monkeypatch: pytest.MonkeyPatch, time: str) -> None:
    monkeypatch.setattr(registry.time, "strftime", lambda _: f"2026-11-20T{time}")


def all_up() -> list[FleetUp]:
    found, unreadable = registry.fleets_up()
    assert not unreadable
    return found


def hosts(record: FleetUp) -> dict[str, tuple[str, bool]]:
    return {host.name: (host.since[11:], host.complete) for host in record.hosts}


def moved(name: str) -> Fleet:
    """Robot 2 is on a third host."""
    return fleet(HOSTS + '[host.third]\naddress = "10.0.0.3"\n', LEFT, f'host = "{name}"')


def test_up_from_the_first_change_on_until_nothing_is_left(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at(monkeypatch, "10:00:00")
    note_up(fleet(), SOURCE, ["left"], complete=False)
    (record,) = all_up()
    assert (record.name, record.source, hosts(record)) == ("two", str(SOURCE), {"left": ("10:00:00", False)})
    at(monkeypatch, "10:00:05")
    note_up(fleet(), SOURCE, ["right"], complete=False)
    note_up(fleet(), SOURCE, BOTH, complete=True)
    (record,) = all_up()
    assert hosts(record) == {"left": ("10:00:00", True), "right": ("10:00:05", True)}
    assert (record.since, record.robots) == ("2026-11-20T10:00:00", [1, 2])
    assert load_fleet(record.fleet_file).agent_endpoint(2) == fleet().agent_endpoint(2)
    note_down(fleet(), ["left"])
    assert hosts(all_up()[0]) == {"right": ("10:00:05", True)}
    note_down(fleet(), ["right"])
    assert all_up() == []
    assert not list(state.rglob("*.toml"))


def test_a_host_that_the_file_has_no_more_is_not_forgotten() -> None:
    note_up(fleet(), SOURCE, BOTH, complete=True)
    note_up(moved("third"), SOURCE, ["left", "third"], complete=True)
    assert sorted(sorted(hosts(record)) for record in all_up()) == [["left", "third"], ["right"]]
    (old,) = [record for record in all_up() if "right" in hosts(record)]
    assert "right" in {robot.host for robot in load_fleet(old.fleet_file).robots}, "to take it down with"
    note_down(fleet(), BOTH)
    assert [sorted(hosts(record)) for record in all_up()] == [["third"]]


def test_a_file_that_moved_is_the_same_fleet() -> None:
    note_up(fleet(), SOURCE, BOTH, complete=True)
    note_up(fleet(), Path("/elsewhere/two.toml"), BOTH, complete=True)
    (record,) = all_up()
    assert record.source == "/elsewhere/two.toml"


def test_threads_and_commands_note_one_after_another() -> None:
    threads = [
        threading.Thread(target=note_up, args=(fleet(), SOURCE, [name]), kwargs={"complete": False})
        for name in BOTH * 4
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(hosts(all_up()[0])) == ["left", "right"]


def test_down_without_a_record_makes_none(state: Path) -> None:
    note_down(fleet(), BOTH)
    assert not state.exists()


@pytest.mark.parametrize(
    "text", ["{", "", "[]", '{"name": "two", "source": "", "hosts": []}', '{"name": 2}', "[" * 5000]
)
def test_a_damaged_record_is_told_and_kept(state: Path, text: str) -> None:
    note_up(fleet(), SOURCE, BOTH, complete=True)
    record = next(state.rglob("up.json"))
    record.write_text(text)
    assert registry.fleets_up() == (
        [],
        [
            f"whether two is up on hosts cannot be told: {record} is damaged; when you know that it is down, "
            "remove that folder"
        ],
    )
    note_up(fleet(), SOURCE, BOTH, complete=True)  # and made good by the next `up`
    assert json.loads(record.read_text())["name"] == "two"


def test_a_folder_that_cannot_be_looked_into(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def iterdir(folder: Path) -> None:
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr(Path, "iterdir", iterdir)
    says = f"[Errno 13] Permission denied: '{state / 'handfast' / 'fleets'}'"
    assert registry.fleets_up() == ([], [f"which fleets are up on hosts cannot be told: {says}"])


def test_what_cannot_be_written_is_an_error(state: Path) -> None:
    state.write_text("")
    with pytest.raises(OSError, match="Not a directory"):
        note_up(fleet(), SOURCE, BOTH, complete=True)
    assert registry.fleets_up() == ([], [])
