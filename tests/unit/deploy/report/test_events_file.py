"""The events of a run as a text: every one, in the order of time, with the clock of who reads it."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import StatusText, Stop
from handfast.deploy.playback import marks
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report.whole_file import write_events
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import FLEET
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, messages

NAME = FLEET.fleet.name
AT = EPOCH_NS + 1_500_000_000


def result(mode: str) -> RunResult:
    data = RunData(FLEET, mode=mode)
    more = [
        (AT, key_expressions.status_texts(NAME, 2), StatusText(2, 0, AT, "critical", "EKF failsafe")),
        (AT + 10**9, key_expressions.stop(NAME), Stop(1, AT + 10**9, "a dog")),
    ]
    for sent in sorted([*messages(FLEET, in_formation(FLEET)), *more], key=lambda each: each[0]):
        data.feed(*sent)
    return RunResult(data.recording())


def test_a_drive_has_the_clock_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(marks, "MARKS_MAX", 1)  # of a page; here all of them are
    write_events(tmp_path / "events.txt", result("run"))
    head, begun, said, stop, *_ = (tmp_path / "events.txt").read_text().splitlines()
    clock = [datetime.fromtimestamp(EPOCH_NS / 1e9 + t).strftime("%H:%M:%S") for t in (0.0, 1.5, 2.5)]
    assert head.startswith(f"# {NAME}: what happened, in fleet time, since 20")
    assert begun == f"     0.0 s  {clock[0]}  order      the drive begins"
    assert said == f"     1.5 s  {clock[1]}  vehicle    the vehicle of robot 2 says (critical): EKF failsafe"
    assert stop == f"     2.5 s  {clock[2]}  order      stop: a dog"


def test_virtual_time_has_none(tmp_path: Path) -> None:
    write_events(tmp_path / "events.txt", result("simulate"))
    head, begun, *_ = (tmp_path / "events.txt").read_text().splitlines()
    assert head == f"# {NAME}: what happened, in fleet time"
    assert begun == "     0.0 s  order      the drive begins"


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write"):
        write_events(tmp_path / "file" / "events.txt", result("run"))
