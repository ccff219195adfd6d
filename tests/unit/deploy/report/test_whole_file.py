"""Files that are there whole, or as they were."""

from __future__ import annotations

import os
import signal
from errno import ENOSPC
from pathlib import Path

import pytest

from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report.whole_file import whole_file, whole_files


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


def test_of_many_all_take_their_names_or_none_though_a_signal_comes_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outs = [tmp_path / name for name in ("a.csv", "b.csv", "c.csv")]
    replace, replaced = Path.replace, []

    def interrupted(part: Path, out: Path) -> None:
        if len(replaced) == 1:
            signal.raise_signal(signal.SIGTERM)
        replaced.append(out)
        replace(part, out)

    def raises(number: int, _frame: object) -> None:
        raise KeyboardInterrupt(number)

    def write() -> None:
        with whole_files(outs) as parts:
            for part in parts:
                part.write_text("new")

    monkeypatch.setattr(Path, "replace", interrupted)
    before = signal.signal(signal.SIGTERM, raises)
    try:
        with pytest.raises(KeyboardInterrupt):
            write()
        assert signal.getsignal(signal.SIGTERM) is raises
    finally:
        signal.signal(signal.SIGTERM, before)
    assert replaced == outs
    assert sorted(tmp_path.iterdir()) == outs
