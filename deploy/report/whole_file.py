"""Files that are there whole, or as they were."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from handfast.deploy.recording.run_files import RecordingError

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
