"""Files that are there whole, or as they were."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from deploy.recording.recorder import RecordingError


@contextmanager
def whole_file(out: Path, error_type: type[RecordingError] = RecordingError) -> Iterator[Path]:
    """A file beside `out` that takes its name once it is whole, and is gone if it never is.

    Raises:
        RecordingError: it cannot be written; of `error_type`.
    """
    part = out.with_name(f".{out.stem}.part{out.suffix}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        yield part
        part.replace(out)
    except OSError as error:
        raise error_type(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
