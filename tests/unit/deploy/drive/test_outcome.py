"""What a command says of a run when it is over."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import cast

import pytest

from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.drive.outcome import conclude, finish
from handfast.deploy.report.run_folder import NotDrawn, RunFolder
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, make_fleet, messages


def test_where_figures_cannot_be_written_the_verdict_is_said_and_how_to_make_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = make_fleet([(0, 0), (1, 0)], [(1, 2)])
    result = RunResult(recorded(pair, messages(pair, in_formation(pair))))

    class Full:
        path = tmp_path

        def finish(self, *_: object, **__: object) -> RunResult:
            raise NotDrawn("cannot write forces.png: No space left on device", result)

    options = Namespace(report=True, figures=())
    assert finish(options, cast(RunFolder, Full()), [], Interrupt()) == 1
    told = capsys.readouterr()
    assert told.out.splitlines()[0] == "PASSED"
    assert told.err == (
        "handfast: cannot write forces.png: No space left on device; figures and report are left out: "
        f"`handfast report {tmp_path}` makes them\n"
    )


def said(result: RunResult, folder: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    conclude(result, folder)
    return capsys.readouterr().out.splitlines()


def test_figures_of_a_drive_that_was_cut_short_say_of_what_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = make_fleet([(0, 0), (1, 0)], [(1, 2)])
    sent = list(messages(pair, in_formation(pair)))
    whole = said(RunResult(recorded(pair, sent)), tmp_path, capsys)
    assert whole[-2].startswith("  formation within 5 % after 0.0 s, closest 1.000 m (1-2), ")
    early = [each for each in sent if each[0] < EPOCH_NS + 800_000_000]
    cut = said(RunResult(recorded(pair, early, interrupted=True)), tmp_path, capsys)
    assert cut[-2].startswith("  of the first 0.8 s of 2 s: formation within 5 % ")
    one = [each for each in early if getattr(each[2], "robot", 1) == 1]
    cut = said(RunResult(recorded(pair, one, interrupted=True)), tmp_path, capsys)
    assert cut[-2].startswith("  of the first 0.8 s of 2 s and 1 of 2 robots: formation ")
