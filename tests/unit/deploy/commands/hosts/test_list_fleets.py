"""`handfast status`: what runs here, what is up, and what of that is not true any more."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import tomli_w

from handfast.agent.fleet.loading import to_dict
from handfast.deploy.cli import main
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory import registry
from handfast.deploy.inventory.registry import Registration
from tests.unit.agent.fleet.test_hosts import fleet
from tests.unit.deploy.test_cli import OPERATORS, without

PID = os.getpid()


@pytest.fixture(autouse=True)
def private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "private").mkdir()
    monkeypatch.setattr(registry, "private_folder", lambda: tmp_path / "private")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "private"


def a_run(tmp_path: Path, name: str, *, attached: bool = False) -> Registration:
    folder = tmp_path / name
    folder.mkdir()
    (folder / "fleet.toml").write_text((FLEETS / "pair.toml").read_text().replace('"pair"', f'"{name}"'))
    return Registration(name, folder, folder / "fleet.toml", FLEETS / "pair.toml", attached=attached)


def up(tmp_path: Path, *names: str, complete: bool = True) -> Path:
    file = tmp_path / "two.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet())))
    registry.note_up(fleet(), file, names, complete=complete)
    return file


def listed(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> str:
    assert main(["status", *arguments]) == status
    return capsys.readouterr().out


def test_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert listed(capsys) == "no fleet runs here, and none is up on hosts\n"
    assert json.loads(listed(capsys, "--json")) == {"fleets": [], "unreadable": []}


def test_a_row_for_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = up(tmp_path, "left", "right")
    with a_run(tmp_path, "pair"), a_run(tmp_path, "by-hand", attached=True):
        rows = {row["fleet"]: row for row in json.loads(listed(capsys, "--json"))["fleets"]}
        text = listed(capsys).splitlines()
    assert {name: (row["hosts"], row["state"], row["robots"]) for name, row in rows.items()} == {
        "by-hand": (None, "driven", [1, 2]),
        "pair": (None, "running", [1, 2]),
        "two": (["left", "right"], "up", [1, 2]),
    }
    assert (rows["pair"]["processes"], rows["pair"]["folder"]) == ([PID], str(tmp_path / "pair"))
    assert rows["pair"]["source"] == str(FLEETS / "pair.toml")
    assert (rows["two"]["stop"], rows["two"]["down"]) == ("handfast stop two", f"handfast down {file}")
    assert rows["two"]["source"] == str(file)
    heading, _, pair, two, down = text
    assert [line[heading.index("stop it with") :].split("  ")[0] for line in (pair, two)] == [
        "handfast stop pair",
        "handfast stop two",
    ]
    assert down == f"take two down with: handfast down {file}"


def test_a_fleet_file_that_lacks_a_host_does_not_take_it_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = up(tmp_path, "left", "right")
    file.write_text(file.read_text().replace('host = "right"', 'host = "left"'))
    (row,) = json.loads(listed(capsys, "--json"))["fleets"]
    assert row["down"] == f"handfast down {row['fleet_file']}"
    assert Path(row["fleet_file"]).is_relative_to(tmp_path / "state")


def test_a_host_on_which_up_did_not_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    up(tmp_path, "left")
    up(tmp_path, "right", complete=False)
    (row,) = json.loads(listed(capsys, "--json"))["fleets"]
    assert row["state"] == "up (perhaps not on right)"


def test_one_that_is_paused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("handfast.deploy.processes.running.state_of", lambda pid: {PID: "paused"}[pid])
    with a_run(tmp_path, "pair"):
        assert "running (PAUSED: `fg` there)" in listed(capsys)


def test_what_a_killed_run_left_is_gone(
    tmp_path: Path, private: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with a_run(tmp_path, "pair"):
        text = next(private.iterdir()).read_text()
    (private / "run-1-1.json").write_text(text)
    assert listed(capsys) == "no fleet runs here, and none is up on hosts\n"
    assert list(private.iterdir()) == []


def test_what_is_damaged_is_said(tmp_path: Path, private: Path, capsys: pytest.CaptureFixture[str]) -> None:
    up(tmp_path, "left")
    record = next((tmp_path / "state").rglob("up.json"))
    record.write_text("")
    with a_run(tmp_path, "pair"):
        next(private.iterdir()).write_text("{")
        assert main(["status"]) == 1
        out, err = capsys.readouterr()
        assert out == "no fleet runs here, and none is up on hosts\n"
        assert err.splitlines()[0].startswith(f"handfast: the run of process {PID} cannot be told: ")
        assert err.splitlines()[1].startswith("handfast: whether two is up on hosts cannot be told: ")
        assert len(json.loads(listed(capsys, "--json", status=1))["unreadable"]) == 2


def test_it_needs_none_of_the_operators_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    ran = without(OPERATORS, "status")
    assert (ran.returncode, ran.stdout) == (0, "no fleet runs here, and none is up on hosts\n"), ran.stderr
