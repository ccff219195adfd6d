"""What processes say, from their files."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.deploy.processes.running import last_words, log_files


def test_logs_of_the_robots_that_are_meant_in_their_order(tmp_path: Path) -> None:
    for name in (
        "robot-10-agent.log",
        "robot-2-plant.log",
        "robot-2-agent.log",
        "robot-3-agent.log",
        "x.log",
    ):
        (tmp_path / name).write_text("")
    assert [log.name for log in log_files(tmp_path, {2, 10})] == [
        "robot 2 agent",
        "robot 2 plant",
        "robot 10 agent",
    ]
    assert log_files(tmp_path / "none", {2}) == []


def test_lines_bear_no_name_and_are_read_once(tmp_path: Path) -> None:
    path = tmp_path / "robot-1-agent.log"
    path.write_bytes(b"robot 1 agent: waiting\nTraceback\n\xff\n")
    (log,) = log_files(tmp_path, {1})
    assert list(log.last(2)) == ["Traceback", "\ufffd"]
    assert list(log.lines()) == []
    with open(path, "ab") as file:
        file.write(b"robot 1 agent: run")
        file.flush()
        assert list(log.lines(complete=True)) == []
        file.write(b"ning\nsto")
        file.flush()
        assert list(log.lines(complete=True)) == ["running"]
        assert list(log.lines()) == ["sto"]


def test_all_lines(tmp_path: Path) -> None:
    (tmp_path / "robot-1-agent.log").write_text("a\nb\n")
    (log,) = log_files(tmp_path, {1})
    assert list(log.last(None)) == ["a", "b"]


def test_a_log_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "robot-1-agent.log").mkdir()
    (log,) = log_files(tmp_path, {1})
    with pytest.raises(IsADirectoryError):
        log.last(1)
    assert last_words(tmp_path, 1, "agent") == ""


def test_last_words(tmp_path: Path) -> None:
    path = tmp_path / "robot-1-agent.log"
    assert last_words(tmp_path, 1, "agent") == ""
    path.write_text("")
    assert last_words(tmp_path, 1, "agent") == ""
    path.write_text("x\n" * 10_000 + "robot 1 agent: stopped\n")
    assert last_words(tmp_path, 1, "agent") == "stopped"
