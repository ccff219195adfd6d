"""Which fleets are up, as the operator noted it."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.inventory import fleets_up
from handfast.deploy.inventory.fleets_up import FleetUp, note_down, note_up
from tests.unit.agent.fleet.test_hosts import HOSTS, LEFT, fleet

SOURCE = Path("/fleets/two.toml")
BOTH = ("left", "right")


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state"


def at(monkeypatch: pytest.MonkeyPatch, time: str) -> None:
    monkeypatch.setattr(fleets_up.time, "strftime", lambda _: f"2026-11-20T{time}")


def all_up() -> list[FleetUp]:
    found, unreadable = fleets_up.fleets_up()
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


def test_keys_to_log_in_with_are_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    note_up(fleet(HOSTS + 'key = "id"\n'), SOURCE, BOTH, complete=True)
    assert load_fleet(all_up()[0].fleet_file).hosts[1].key == str(tmp_path / "id")


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
    assert fleets_up.fleets_up() == (
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
    assert fleets_up.fleets_up() == ([], [f"which fleets are up on hosts cannot be told: {says}"])


def test_what_cannot_be_written_is_an_error(state: Path) -> None:
    state.write_text("")
    with pytest.raises(OSError, match="Not a directory"):
        note_up(fleet(), SOURCE, BOTH, complete=True)
    assert fleets_up.fleets_up() == ([], [])
