"""`handfast up` notes what it brings up, and a disk that is full keeps no fleet from coming up."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.deploy.commands.hosts.up import Notes
from handfast.deploy.inventory.registry import fleets_up
from tests.unit.agent.fleet.test_hosts import fleet


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state"


def test_what_is_up_is_noted(tmp_path: Path) -> None:
    notes = Notes(fleet(), tmp_path / "two.toml")
    notes.up([], complete=True)
    assert fleets_up() == ([], [])
    notes.up(["left"], complete=False)
    notes.up(["left"], complete=True)
    ((record,), _) = fleets_up()
    assert [(host.name, host.complete) for host in record.hosts] == [("left", True)]
    assert notes.problems == []


def test_what_cannot_be_noted_is_said_once(tmp_path: Path, state: Path) -> None:
    state.write_text("")
    notes = Notes(fleet(), tmp_path / "two.toml")
    notes.up(["left"], complete=False)
    notes.up(["right"], complete=False)
    (problem,) = notes.problems
    assert problem.startswith(
        "`handfast status` does not know that it is up: cannot note it: [Errno 20] Not a dir"
    )
