"""`handfast preflight --set-parameters`, with vehicles that only seem to be there."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from bridges.mavlink.bridge.parameter_setup import UNREAD, Answer, Task
from deploy.cli import main
from deploy.console.data_files import FLEETS
from deploy.drive.preflight_parameters import OldValues
from deploy.drive.vehicle_checks import OK, Line

FINE = {"FS_ACTION": 2.0, "FS_THR_ENABLE": 1.0, "FS_EKF_ACTION": 1.0, "FS_EKF_THRESH": 0.8}
RISKY = FINE | {"FS_CRASH_CHECK": 0.0, "BATT_FS_LOW_ACT": 0.0, "BATT_FS_CRT_ACT": 0.0, "BATT_MONITOR": 4.0}


class Vehicles:
    """Robots 1 and 2 of a fleet of three.

    Attributes:
        values: by robot.
        trouble: by robot, why nothing is done with it.
        keeps: parameters that no vehicle lets be changed.
        unread: parameters that are set and not read back.
        tasks: those that were carried out.
    """

    def __init__(self) -> None:
        self.values: dict[int, dict[str, float]] = {1: dict(RISKY), 2: dict(RISKY)}
        self.trouble: dict[int, str] = {}
        self.keeps: set[str] = set()
        self.unread: set[str] = set()
        self.tasks: list[Mapping[int, Task]] = []

    def carry_out(self, _fleet: object, tasks: Mapping[int, Task], *_: object) -> dict[int, Answer]:
        self.tasks.append(tasks)
        return {robot: self._answer(robot, task) for robot, task in tasks.items()}

    def _answer(self, robot: int, task: Task) -> Answer:
        if robot in self.trouble:
            return Answer(self.trouble[robot], robot)
        has = self.values[robot]
        lacking = {
            name: f"was sent, and it keeps {has[name]:g}" for name in task.wanted if name in self.keeps
        }
        has |= {name: value for name, (_, value) in task.wanted.items() if name not in lacking}
        values = {name: has.get(name) for name in task.names}
        for name in self.unread & set(task.wanted):
            values[name], lacking[name] = None, UNREAD
        return Answer("", robot, values, lacking)

    @property
    def changed(self) -> list[str]:
        return [name for tasks in self.tasks for task in tasks.values() for name in task.wanted]


@pytest.fixture
def vehicles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Vehicles:
    raw: dict[str, Any] = tomllib.loads((FLEETS / "rovers.toml").read_text(encoding="utf-8"))
    raw["fleet"]["name"] = "three"
    raw["formation"] |= {"edges": [[1, 2], [2, 3], [1, 3]], "offsets": [[0.0, 0.0], [3.0, 0.0], [1.5, 2.6]]}
    raw["robot"] = raw["robot"][:3]
    raw["robot_defaults"]["mavlink"]["connection"] = "tcp:127.0.0.1:5760"
    for number, robot in enumerate(raw["robot"], 1):
        robot["mavlink"] = {"system": number}
    raw["robot"][2]["plant"] = "unicycle"
    (tmp_path / "three.toml").write_text(tomli_w.dumps(raw))
    there = Vehicles()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr("bridges.mavlink.bridge.parameter_setup.carry_out", there.carry_out)
    return there


def preflight(*arguments: str) -> int:
    return main(["preflight", "three.toml", *arguments])


def test_what_is_risky_is_shown_set_read_back_and_kept(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicles.values[2]["FS_CRASH_CHECK"] = 1.0
    assert preflight("--set-parameters", "--yes") == 0
    out = capsys.readouterr().out
    assert "robot 3: no vehicle that is reached by MAVLink: left alone" in out
    assert "1      FS_CRASH_CHECK   0   1         it drives on against an obstacle\n" in out
    assert "robot 1: set and read back: FS_CRASH_CHECK 1, BATT_FS_LOW_ACT 2\n" in out
    assert "robot 2: set and read back: BATT_FS_LOW_ACT 2\n" in out
    assert "--restore-parameters sets it back" in out
    assert OldValues("three", 1).values == {"FS_CRASH_CHECK": 0.0, "BATT_FS_LOW_ACT": 0.0}
    assert set(vehicles.changed) == {"FS_CRASH_CHECK", "BATT_FS_LOW_ACT"}, "and never anything else"


def test_a_second_run_keeps_the_first_old_values_and_they_can_be_set_back(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str]
) -> None:
    assert preflight("--set-parameters", "--yes") == 0
    vehicles.values[1]["FS_CRASH_CHECK"] = 0.0
    vehicles.values[1]["BATT_FS_LOW_ACT"] = 3.0  # somebody has set it to what is risky again
    assert preflight("--set-parameters", "--yes") == 0
    assert OldValues("three", 1).values["BATT_FS_LOW_ACT"] == 0.0
    capsys.readouterr()
    assert preflight("--restore-parameters", "--yes") == 0
    assert "robot 1: set and read back: FS_CRASH_CHECK 0, BATT_FS_LOW_ACT 0" in capsys.readouterr().out
    assert vehicles.values == {1: RISKY, 2: RISKY}
    assert not OldValues("three", 1).path.exists()
    assert preflight("--restore-parameters", "--yes") == 0
    assert "robot 1: nothing was set that is to be set back" in capsys.readouterr().out


def test_what_is_right_already_is_not_touched(vehicles: Vehicles, capsys: pytest.CaptureFixture[str]) -> None:
    right = RISKY | {"FS_CRASH_CHECK": 1.0, "BATT_FS_LOW_ACT": 2.0}
    vehicles.values = {1: dict(right), 2: dict(right)}
    assert preflight("--set-parameters", "--yes") == 0
    assert "robot 1: nothing to set" in capsys.readouterr().out
    assert not OldValues("three", 1).path.parent.exists()


def test_one_that_cannot_be_set_is_named_and_the_others_are_set(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicles.trouble[2] = "it is armed: disarm it first"
    assert preflight("--set-parameters", "--yes") == 1
    out = capsys.readouterr().out
    assert "robot 2: NOT DONE: it is armed: disarm it first\n" in out
    assert "robot 1: set and read back" in out
    assert not OldValues("three", 2).path.exists()


def test_one_that_keeps_its_value_is_named_and_has_no_old_one(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicles.keeps = {"FS_CRASH_CHECK"}
    assert preflight("--set-parameters", "--yes") == 1
    assert "robot 1: NOT DONE: FS_CRASH_CHECK was sent, and it keeps 0\n" in capsys.readouterr().out
    assert OldValues("three", 1).values == {"BATT_FS_LOW_ACT": 0.0}


def test_what_is_not_set_back_stays_kept(vehicles: Vehicles) -> None:
    assert preflight("--set-parameters", "--yes") == 0
    vehicles.keeps = {"FS_CRASH_CHECK"}
    assert preflight("--restore-parameters", "--yes") == 1
    assert OldValues("three", 1).values == {"FS_CRASH_CHECK": 0.0}


def test_of_what_is_not_read_back_the_old_value_stays_kept(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicles.unread = {"FS_CRASH_CHECK"}
    assert preflight("--set-parameters", "--yes") == 1
    assert f"robot 1: NOT DONE: FS_CRASH_CHECK {UNREAD}\n" in capsys.readouterr().out
    assert OldValues("three", 1).values["FS_CRASH_CHECK"] == 0.0
    vehicles.unread = set()
    assert preflight("--restore-parameters", "--yes") == 0
    assert vehicles.values == {1: RISKY, 2: RISKY}


def test_what_is_kept_is_said_before_the_next_look_and_the_next_set(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = [Line("link", OK, "heard", "")]
    monkeypatch.setattr("deploy.commands.local.preflight._here", lambda *_: {1: fine, 2: fine, 3: []})
    assert preflight() == 0
    assert "are kept" not in capsys.readouterr().out
    assert preflight("--set-parameters", "--yes") == 0
    assert "are kept" not in capsys.readouterr().out, "it says where, at its end"
    note = re.compile(
        r"^robots 1 and 2: values from before --set-parameters on \d{4}-\d\d-\d\d are kept: "
        r"--restore-parameters sets them back$",
        re.MULTILINE,
    )
    assert preflight() == 0
    assert len(note.findall(capsys.readouterr().out)) == 1
    assert preflight("--json") == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["passed"]
    assert note.search(told.err)
    assert preflight("--set-parameters", "--yes") == 0
    out = capsys.readouterr().out
    assert (len(note.findall(out)), out.count("--restore-parameters")) == (1, 1)
    assert preflight("--restore-parameters", "--yes") == 0
    assert "are kept" not in capsys.readouterr().out
    assert preflight() == 0
    assert "are kept" not in capsys.readouterr().out


def test_a_look_goes_on_where_what_is_kept_is_damaged(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = [Line("link", OK, "heard", "")]
    monkeypatch.setattr("deploy.commands.local.preflight._here", lambda *_: {1: fine, 2: fine, 3: []})
    assert preflight("--set-parameters", "--yes") == 0
    OldValues("three", 1).path.write_text("[]")
    assert preflight() == 0
    out = capsys.readouterr().out
    assert "robot-1.json is damaged" in out
    assert "robot 2: values from before" in out


def test_what_somebody_else_has_changed_since_is_left_alone_and_forgotten(
    vehicles: Vehicles, capsys: pytest.CaptureFixture[str]
) -> None:
    assert preflight("--set-parameters", "--yes") == 0
    vehicles.values[1]["FS_CRASH_CHECK"] = 2.0
    capsys.readouterr()
    assert preflight("--restore-parameters", "--yes") == 0
    out = capsys.readouterr().out
    assert (
        "robot 1: FS_CRASH_CHECK is 2, changed since by somebody else: left alone (before handfast: 0, "
        "no longer kept)\n" in out
    )
    assert "robot 1: set and read back: BATT_FS_LOW_ACT 0\n" in out
    assert vehicles.values == {1: RISKY | {"FS_CRASH_CHECK": 2.0}, 2: RISKY}
    assert not OldValues("three", 1).path.exists()


def test_nothing_is_forgotten_of_what_nobody_agreed_to_set_back(
    vehicles: Vehicles, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert preflight("--set-parameters", "--yes") == 0
    vehicles.values[1]["FS_CRASH_CHECK"] = 2.0
    capsys.readouterr()
    monkeypatch.setattr("deploy.commands.local.preflight_parameters._is_terminal", lambda: True)
    monkeypatch.setattr("deploy.commands.local.preflight_parameters._agreed", lambda *_: False)
    assert preflight("--restore-parameters") == 1
    assert "FS_CRASH_CHECK is 2, changed since by somebody else: left alone\n" in capsys.readouterr().out
    assert OldValues("three", 1).values == {"FS_CRASH_CHECK": 0.0, "BATT_FS_LOW_ACT": 0.0}


@pytest.mark.parametrize(("typed", "status"), [("yes\n", 0), ("y\n", 1), ("\n", 1), ("", 1)])
def test_a_person_is_asked_once(
    vehicles: Vehicles, typed: str, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading, writing = os.pipe()
    os.write(writing, typed.encode())
    os.close(writing)
    with open(reading) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        monkeypatch.setattr("deploy.commands.local.preflight_parameters._is_terminal", lambda: True)
        assert preflight("--set-parameters") == status
    assert bool(vehicles.changed) == (status == 0)
    assert OldValues("three", 1).path.exists() == (status == 0)


def test_without_a_terminal_it_says_so_before_anything_is_done(
    vehicles: Vehicles, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("deploy.commands.local.preflight_parameters._is_terminal", lambda: False)
    assert preflight("--set-parameters") == 2
    assert "add --yes" in capsys.readouterr().err
    assert vehicles.tasks == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--yes"], "--yes goes with"),
        (["--set-parameters", "--json", "--yes"], "--json and --each go with a look alone"),
    ],
)
def test_options_that_do_not_go_together(
    vehicles: Vehicles, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert preflight(*arguments) == 2
    assert words in capsys.readouterr().err
    assert vehicles.tasks == []
