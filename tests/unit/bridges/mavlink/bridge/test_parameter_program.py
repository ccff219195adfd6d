"""The program that sets parameters in place of a bridge: what it takes and prints."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest

from bridges.mavlink.bridge import parameter_program
from bridges.mavlink.bridge.parameter_program import main
from bridges.mavlink.bridge.parameter_setup import Answer, Task, answers_of, tasks_to_json
from deploy.console.data_files import FLEETS

ROVERS = str(FLEETS / "rovers.toml")


def given(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(text))


def test_it_takes_tasks_and_prints_answers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tasks = {1: Task(("FS_ACTION",), {"FS_ACTION": (0.0, 2.0)}, 1)}
    answers = {1: Answer("", 1, {"FS_ACTION": 2.0})}

    def carry_out(fleet: object, asked: object, *_: object) -> dict[int, Answer]:
        assert asked == tasks
        return answers

    monkeypatch.setattr(parameter_program, "carry_out", carry_out)
    given(monkeypatch, json.dumps(tasks_to_json(tasks)))
    assert main(["--fleet", ROVERS]) == 0
    assert answers_of(json.loads(capsys.readouterr().out)) == answers


def test_a_robot_whose_vehicle_cannot_be_reached_is_answered_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given(monkeypatch, json.dumps(tasks_to_json({2: Task(("FS_ACTION",))})))
    assert main(["--fleet", ROVERS]) == 0
    (answer,) = answers_of(json.loads(capsys.readouterr().out)).values()
    assert answer.trouble == "the fleet file names no vehicle that can be reached", "run starts its simulator"


@pytest.mark.parametrize("text", ["", "[]", '{"1": 5}', '{"x": {}}'])
def test_what_are_no_tasks_is_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    given(monkeypatch, text)
    assert main(["--fleet", ROVERS]) == 2
    assert "no tasks: " in capsys.readouterr().err


def test_a_fleet_file_that_is_not_valid_is_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "bad.toml").write_text("fleet = 3")
    given(monkeypatch, "{}")
    assert main(["--fleet", str(tmp_path / "bad.toml")]) == 2
    assert "bad.toml" in capsys.readouterr().err
