"""Work as bytes, and how a worker's process reads it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.deploy.cluster.sent import SentWork, Unfinished, Unreadable, pack, write_files


class Doubles:
    def execute(self, number: int, go_on: Callable[[], bool]) -> int:
        return 2 * number

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> int:
        return -number


def test_it_drives_what_was_packed() -> None:
    sent = SentWork(pack(Doubles()), None)
    assert [sent.execute(number, lambda: True) for number in (1, 2)] == [2, 4]
    assert sent.unfinished(3, "why", 1.5, timed_out=True) == Unfinished("why", 1.5, True)


def test_work_of_a_module_that_is_not_here_says_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the module's file it can be read: so plugins travel."""
    text = "class Work:\n    def execute(self, number, go_on):\n        return 'driven'\n"
    (tmp_path / "travelling_work.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    import travelling_work  # type: ignore[import-not-found]

    data = pack(travelling_work.Work())
    monkeypatch.undo()
    monkeypatch.delitem(sys.modules, "travelling_work")
    found = SentWork(data, None).execute(0, lambda: True)
    assert isinstance(found, Unreadable)
    assert "No module named 'travelling_work'" in found.why

    folder = tmp_path / "there"
    write_files(folder, {"travelling_work.py": text.encode()})
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert SentWork(data, folder).execute(0, lambda: True) == "driven"
    monkeypatch.delitem(sys.modules, "travelling_work")


@pytest.mark.parametrize("name", ["../out.py", "/out.py", ""])
def test_files_lie_below_their_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="not a name below a folder"):
        write_files(tmp_path / "in", {"package/module.py": b"x", name: b"y"})
    assert (tmp_path / "in" / "package" / "module.py").read_bytes() == b"x"
    assert not (tmp_path / "out.py").exists()
