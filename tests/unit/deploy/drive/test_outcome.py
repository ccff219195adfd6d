"""What a command says of a run when it is over."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.drive.outcome import conclude
from deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import make_fleet, messages, standing


def test_the_headline_names_the_closest_of_any_two(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Robot 3 passes robot 1; only 1-2 and 2-3 are edges, and these stay 1 m long."""
    line = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)])
    ways = standing(0, 0), standing(1, 0), lambda t: (0.0 if abs(t - 1) < 0.001 else 2.0, 0.1, 0.0)
    result = RunResult(recorded(line, messages(line, [body(way, 0.1) for way in ways])))
    assert conclude(result, tmp_path) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "FAILED"
    assert ", closest 0.100 m (1-3), " in said[-2]
