"""What happened in a run, line by line, to be read in a field: orders, states, faults, violations, and what
the vehicles said themselves."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from handfast.deploy.playback.marks import Mark, all_marks
from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.whole_file import whole_file
from handfast.deploy.verdict.run_result import RunResult


def write_events(path: Path, result: RunResult) -> None:
    """Writes the events of a run into a file.

    Raises:
        RecordingError: it cannot be written.
    """
    with whole_file(path) as part:
        part.write_text("\n".join(_lines(result)) + "\n", encoding="utf-8")


def _lines(result: RunResult) -> list[str]:
    recording = result.recording
    since = f", since {_clock(recording, 0.0):%Y-%m-%d %H:%M:%S %z}" if _real(recording) else ""
    head = f"# {recording.fleet.fleet.name}: what happened, in fleet time{since}"
    return [head, *(_line(recording, mark) for mark in all_marks(result))]


def _line(recording: Recording, mark: Mark) -> str:
    clock = f"  {_clock(recording, mark.t_s):%H:%M:%S}" if _real(recording) else ""
    until = "" if mark.end_s is None else f" (until {mark.end_s:.1f} s)"
    return f"{mark.t_s:8.1f} s{clock}  {mark.kind:<9}  {mark.text}{until}"


def _real(recording: Recording) -> bool:
    """Whether its times are those of a wall clock."""
    return recording.mode != "simulate" and recording.epoch_ns is not None


def _clock(recording: Recording, t_s: float) -> datetime:
    """A fleet time on the clock of who reads it."""
    return datetime.fromtimestamp((recording.epoch_ns or 0) / 1e9 + t_s).astimezone()
