"""Runs that only the program drives which was asked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.cluster import same_program
from handfast.deploy.cluster.same_program import SameProgram, program_digest
from handfast.deploy.console.data_files import FLEETS, ROOT
from handfast.deploy.console.sources import sources_digest
from handfast.deploy.simulate.worker_pool import Refused
from tests.passing_law import PassingLaw


class Doubles:
    def execute(self, number: int, _go_on: Callable[[], bool]) -> int:
        return 2 * number

    def unfinished(self, number: int, reason: str, _wall_s: float, *, timed_out: bool) -> int:
        return -number


@pytest.fixture(autouse=True)
def new_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(same_program, "_looked_at", set())


def digests(monkeypatch: pytest.MonkeyPatch, *found: str) -> Iterator[str]:
    left = iter(found)
    monkeypatch.setattr(same_program, "program_digest", lambda _: next(left))
    return left


def test_it_looks_before_and_after_the_first_run_and_then_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    left = digests(monkeypatch, "aa", "aa", "bb")
    work = SameProgram(Doubles(), "aa", ())
    assert [work.execute(number, lambda: True) for number in range(4)] == [0, 2, 4, 6]
    assert list(left) == ["bb"]
    assert work.unfinished(3, "died", 1.0, timed_out=False) == -3


@pytest.mark.parametrize("found", [("bb",), ("aa", "bb")])
def test_files_that_are_others_drive_nothing(monkeypatch: pytest.MonkeyPatch, found: tuple[str, ...]) -> None:
    left = digests(monkeypatch, *found)
    with pytest.raises(Refused, match="have changed since this command began"):
        SameProgram(Doubles(), "aa", ()).execute(1, lambda: True)
    assert list(left) == []


def test_the_files_of_plugins_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    law = PassingLaw(tmp_path, monkeypatch, "law_of_a_program")
    fleet = load_fleet(FLEETS / "pair.toml", law=law.reference)
    without, before = sources_digest(ROOT), program_digest([fleet])
    assert program_digest([load_fleet(FLEETS / "pair.toml")]) == without != before
    file = tmp_path / "law_of_a_program.py"
    file.write_text(file.read_text() + "\n")
    assert program_digest([fleet, fleet]) not in (before, without)
