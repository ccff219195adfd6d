"""What vehicles had before their parameters were set, what to set, and how it is said."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest

from bridges.mavlink.bridge.parameter_setup import Answer, Task
from deploy.console.arguments import InputError
from deploy.drive.preflight_parameters import (
    OldValues,
    Row,
    changed_since,
    kept_notes,
    rows_to_restore,
    rows_to_set,
    sentences,
    table,
    tasks_for,
)


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "handfast/parameters/two"


def test_the_first_old_values_count_until_they_are_forgotten(state: Path) -> None:
    old = OldValues("two", 3)
    assert (old.system, old.values, old.path) == (None, {}, state / "robot-3.json")
    assert old.keep(7, {"FS_ACTION": (1.0, 2.0), "FS_THR_ENABLE": (0.0, 1.0)}) == [
        "FS_ACTION",
        "FS_THR_ENABLE",
    ]
    again = OldValues("two", 3)
    assert (again.system, again.values) == (7, {"FS_ACTION": 1.0, "FS_THR_ENABLE": 0.0})
    assert again.keep(7, {"FS_ACTION": (3.0, 2.0), "FS_EKF_ACTION": (2.0, 1.0)}) == ["FS_EKF_ACTION"]
    assert OldValues("two", 3).values == {"FS_ACTION": 1.0, "FS_THR_ENABLE": 0.0, "FS_EKF_ACTION": 2.0}
    again.forget(["FS_ACTION", "NO_SUCH"])
    assert set(OldValues("two", 3).values) == {"FS_THR_ENABLE", "FS_EKF_ACTION"}
    again.forget(["FS_THR_ENABLE", "FS_EKF_ACTION"])
    assert list(state.iterdir()) == []


def test_they_are_the_users_alone_and_whole_or_not_there(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = OldValues("two", 3)
    old.keep(7, {"FS_ACTION": (1.0, 2.0)})
    assert stat.S_IMODE(state.stat().st_mode) == 0o700
    assert stat.S_IMODE(old.path.stat().st_mode) == 0o600
    before = old.path.read_bytes()
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(InputError, match=r"nothing more is set: cannot write .*: no space left"):
        old.keep(7, {"FS_EKF_ACTION": (2.0, 1.0)})
    assert old.path.read_bytes() == before
    assert [path.name for path in state.iterdir()] == ["robot-3.json"]


@pytest.mark.parametrize("text", ["", "[]", '{"system": 1}', '{"system": "x", "values": {}}'])
def test_a_file_that_is_damaged_is_named(state: Path, text: str) -> None:
    OldValues("two", 3).keep(7, {"FS_ACTION": (1.0, 2.0)})
    (state / "robot-3.json").write_text(text)
    with pytest.raises(InputError, match=r"robot-3\.json is damaged"):
        OldValues("two", 3)
    (state / "robot-3.json").chmod(0o644)
    with pytest.raises(InputError, match="others may read"):
        OldValues("two", 3)


def test_what_is_set_and_what_is_set_back() -> None:
    answers = {
        1: Answer("", 1, {"FS_ACTION": 2.0, "FS_CRASH_CHECK": 0.0}),
        2: Answer("", 5, {"FS_ACTION": 3.0, "FS_CRASH_CHECK": None}),
        3: Answer("", 6, {"FS_ACTION": 2.0}),
    }
    rows = rows_to_set(answers)
    assert [row[:4] for row in rows] == [(1, "FS_CRASH_CHECK", 0.0, 1.0), (2, "FS_ACTION", 3.0, 2.0)]
    assert tasks_for(rows, answers) == {
        1: Task(("FS_CRASH_CHECK",), {"FS_CRASH_CHECK": (0.0, 1.0)}, 1),
        2: Task(("FS_ACTION",), {"FS_ACTION": (3.0, 2.0)}, 5),
    }
    old = {robot: OldValues("two", robot) for robot in answers}
    old[1].keep(1, {"FS_CRASH_CHECK": (0.0, 1.0)})
    old[2].keep(5, {"FS_ACTION": (1.0, 3.0), "FS_CRASH_CHECK": (0.0, 1.0)})
    assert [row[:4] for row in rows_to_restore(answers, old)] == [(2, "FS_ACTION", 3.0, 1.0)]


def test_they_are_shown_in_columns() -> None:
    assert table(
        [Row(1, "FS_EKF_THRESH", 0.0, 0.8, "it fails"), Row(12, "FS_ACTION", 3.0, 2.0, "it goes")]
    ) == [
        "robot  parameter      is  would be  why",
        "1      FS_EKF_THRESH  0   0.8       it fails",
        "12     FS_ACTION      3   2         it goes",
    ]


def test_what_became_of_each_is_said() -> None:
    task = Task(("A", "B"), {"A": (0.0, 1.0), "B": (0.0, 0.8)})
    assert sentences(task, Answer("", 1, {})) == ["set and read back: A 1, B 0.8"]
    assert sentences(task, Answer("", 1, {}, {"B": "was sent, and it keeps 0"})) == [
        "set and read back: A 1",
        "NOT DONE: B was sent, and it keeps 0",
    ]
    assert sentences(task, Answer("it is armed")) == ["NOT DONE: it is armed"]


def test_the_file_says_what_it_is(state: Path) -> None:
    OldValues("two", 3).keep(7, {"FS_ACTION": (1.0, 2.0)})
    content = json.loads((state / "robot-3.json").read_text())
    assert {"fleet", "robot", "system", "written", "values", "set"} == set(content)
    assert content["set"] == {"FS_ACTION": [2.0]}


def test_what_somebody_else_has_changed_since_is_not_set_back() -> None:
    old = {1: OldValues("two", 1)}
    old[1].keep(1, {"FS_ACTION": (1.0, 2.0), "FS_CRASH_CHECK": (0.0, 1.0)})
    found = {1: Answer("", 1, {"FS_ACTION": 2.0, "FS_CRASH_CHECK": 2.0})}
    assert [row[:4] for row in rows_to_restore(found, old)] == [(1, "FS_ACTION", 2.0, 1.0)]
    assert [row[:4] for row in changed_since(found, old)] == [(1, "FS_CRASH_CHECK", 2.0, 0.0)]
    again = {1: OldValues("two", 1)}
    again[1].keep(1, {"FS_CRASH_CHECK": (2.0, 3.0)})
    for value in (1.0, 3.0):  # either is ours: the last may have been sent in vain
        found = {1: Answer("", 1, {"FS_CRASH_CHECK": value})}
        assert [row[:4] for row in rows_to_restore(found, again)] == [(1, "FS_CRASH_CHECK", value, 0.0)]
        assert changed_since(found, {1: OldValues("two", 1)}) == []


def test_a_file_that_does_not_say_what_was_set_is_read(state: Path) -> None:
    old = OldValues("two", 3)
    old.keep(7, {"FS_ACTION": (1.0, 2.0)})
    content = json.loads(old.path.read_text())
    del content["set"]
    old.path.write_text(json.dumps(content))
    before = {3: OldValues("two", 3)}
    before[3].keep(7, {"FS_ACTION": (1.0, 2.0), "FS_CRASH_CHECK": (0.0, 1.0)})
    assert json.loads(old.path.read_text())["set"] == {"FS_CRASH_CHECK": [1.0]}
    found = {3: Answer("", 7, {"FS_ACTION": 3.0})}
    assert [row[:4] for row in rows_to_restore(found, before)] == [(3, "FS_ACTION", 3.0, 1.0)]
    assert changed_since(found, before) == []


def test_what_is_kept_is_said_once_with_the_day_it_was_first_set(state: Path) -> None:
    old = {robot: OldValues("two", robot) for robot in (1, 2, 3)}
    assert kept_notes(old) == []
    for robot in (1, 2):
        old[robot].keep(robot, {"FS_ACTION": (1.0, 2.0)})
        content = json.loads(old[robot].path.read_text()) | {"written": "2026-03-04T05:06:07"}
        old[robot].path.write_text(json.dumps(content))
    OldValues("two", 1).keep(1, {"FS_CRASH_CHECK": (0.0, 1.0)})
    assert kept_notes({robot: OldValues("two", robot) for robot in (1, 2, 3)}) == [
        "robots 1 and 2: values from before --set-parameters on 2026-03-04 are kept: "
        "--restore-parameters sets them back"
    ]
