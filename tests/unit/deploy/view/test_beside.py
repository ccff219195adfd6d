"""The page beside a drive is told how that goes, ends with it, and never keeps it waiting for long."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.view.beside import OVER, RECORDED, PageBeside

NOTES = "import sys; open(sys.argv[2] + '/said', 'wb').write(sys.stdin.buffer.read())"
FIRST_LINES = (
    "import sys; open(sys.argv[2] + '/said', 'wb').writelines(sys.stdin.buffer.readline() for _ in '12')"
)


@pytest.fixture
def interrupt() -> Interrupt:
    return Interrupt()


def command(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("handfast.deploy.console.data_files._RUN", text)


def test_it_is_told_how_the_drive_goes(
    tmp_path: Path, interrupt: Interrupt, monkeypatch: pytest.MonkeyPatch
) -> None:
    command(monkeypatch, NOTES)
    with PageBeside(tmp_path, interrupt, wanted=True) as page:
        assert page._process is not None
        assert page._process.args[-3:] == ["view", str(tmp_path), "--beside"]  # type: ignore[index]
        page.over()
        interrupt.count = 1
        page.recorded()
    assert page._process.returncode == 0
    assert (tmp_path / "said").read_bytes() == OVER + RECORDED


def test_the_recording_is_shown_until_the_page_ends(
    tmp_path: Path, interrupt: Interrupt, monkeypatch: pytest.MonkeyPatch
) -> None:
    command(monkeypatch, FIRST_LINES)
    with PageBeside(tmp_path, interrupt, wanted=True) as page:
        page.over()
        page.recorded()
        assert (tmp_path / "said").read_bytes() == OVER + RECORDED
        page.over()  # it has ended, and that is no matter of the drive


def test_a_drive_that_breaks_off_ends_it_too(
    tmp_path: Path, interrupt: Interrupt, monkeypatch: pytest.MonkeyPatch
) -> None:
    command(monkeypatch, NOTES)
    with pytest.raises(ZeroDivisionError), PageBeside(tmp_path, interrupt, wanted=True) as page:
        raise ZeroDivisionError
    assert page._process is not None
    assert page._process.returncode == 0
