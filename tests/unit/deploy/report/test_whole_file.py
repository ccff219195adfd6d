"""Files that are there whole, or as they were."""

from __future__ import annotations

import os
from errno import ENOSPC
from pathlib import Path

import pytest

from deploy.recording.recorder import RecordingError
from deploy.report.whole_file import whole_file


def test_it_takes_its_name_once_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "new" / "report.html"
    with whole_file(out) as part:
        part.write_text("half")
        assert not out.exists()
        part.write_text("whole")
    assert out.read_text() == "whole"
    assert [*out.parent.iterdir()] == [out]


@pytest.mark.parametrize("error", [OSError(ENOSPC, os.strerror(ENOSPC)), KeyboardInterrupt()])
def test_what_was_there_stays_where_it_never_is(tmp_path: Path, error: BaseException) -> None:
    out = tmp_path / "report.html"
    out.write_text("before")
    wanted = RecordingError if isinstance(error, OSError) else type(error)

    def write_half() -> None:
        with whole_file(out) as part:
            part.write_text("half")
            raise error

    with pytest.raises(wanted) as caught:
        write_half()
    if wanted is RecordingError:
        assert str(caught.value) == f"cannot write {out}: No space left on device"
    assert out.read_text() == "before"
    assert [*tmp_path.iterdir()] == [out]
