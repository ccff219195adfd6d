"""Files that are there whole, or as they were.

What happened in a run, line by line, to be read in a field: orders, states, faults, violations, and what
the vehicles said themselves.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Final

from handfast.deploy.playback.marks import Mark, all_marks
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.verdict.run_result import RunResult

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def whole_file(out: Path, error_type: type[RecordingError] = RecordingError) -> Iterator[Path]:
    """A file beside `out` that takes its name once it is whole, and is gone if it never is.

    Raises:
        RecordingError: it cannot be written; of `error_type`.
    """
    try:
        with whole_files([out]) as (part,):
            yield part
    except OSError as error:
        raise error_type(f"cannot write {out}: {error.strerror or error}") from error


@contextmanager
def whole_files(outs: Sequence[Path]) -> Iterator[list[Path]]:
    """A file beside each of these, that take their names once all are whole, and are gone if one never is.

    Raises:
        OSError: one cannot be written.
    """
    parts = [out.with_name(f".{out.stem}.part{out.suffix}") for out in outs]
    try:
        for out in outs:
            out.parent.mkdir(parents=True, exist_ok=True)
        yield parts
        with uninterrupted():
            for part, out in zip(parts, outs, strict=True):
                part.replace(out)
    finally:
        for part in parts:
            with suppress(OSError):
                part.unlink(missing_ok=True)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C and its like come at its end."""
    if threading.current_thread() is not threading.main_thread():
        yield  # it hears of none
        return
    came: list[int] = []
    before = {number: signal.signal(number, lambda which, _: came.append(which)) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
    for one in dict.fromkeys(came):
        signal.raise_signal(one)


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
