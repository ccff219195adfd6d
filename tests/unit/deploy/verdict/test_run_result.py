"""A run's recording is analysed once, whatever is made of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.deploy import cli
from handfast.deploy.analysis import analysis
from handfast.deploy.console.arguments import fleet_text
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep.plan import Question, make_plan
from handfast.deploy.sweep.run import PASSED, execute
from handfast.deploy.verdict.run_result import RunResult
from tests.chaos.run import drive
from tests.unit.deploy.judged_run import PAIR, recorded
from tests.unit.deploy.simulated_run import TRIO
from tests.unit.deploy.synthetic_run import in_formation, messages


class Count:
    """How often recordings were analysed since one last looked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._found = 0
        real = analysis.desired

        def counted(*args: object) -> object:
            self._found += 1
            return real(*args)  # type: ignore[arg-type]

        monkeypatch.setattr(analysis, "desired", counted)  # `analyse` asks for it once

    def since(self) -> int:
        found, self._found = self._found, 0
        return found


@pytest.fixture
def count(monkeypatch: pytest.MonkeyPatch) -> Count:
    return Count(monkeypatch)


def test_a_command_analyses_once(tmp_path: Path, count: Count, capsys: pytest.CaptureFixture[str]) -> None:
    run = str(tmp_path / "run")
    assert cli.main(["simulate", "pair", "--duration", "5", "--quiet", "--out", run]) == 0
    assert count.since() == 1
    assert "PASSED" in capsys.readouterr().out
    assert (tmp_path / "run" / "report.html").exists()
    for command in (["report", run], ["export", run, "--format", "csv"]):
        assert cli.main(command) == 0
        assert count.since() == 1, command


def test_a_run_of_a_sweep_is_analysed_once(count: Count) -> None:
    path = FLEETS / "pair.toml"
    plan = make_plan(Question(str(path), fleet_text(path), overrides=("fleet.duration_s=5",)))
    assert execute(plan, 0).verdict == PASSED
    assert count.since() == 1


def test_a_random_scenario_is_analysed_once(count: Count) -> None:
    assert drive(TRIO.format(duration=1.0)).checked
    assert count.since() == 1


def test_nothing_is_made_before_it_is_asked_for(count: Count) -> None:
    result = RunResult(recorded(PAIR, messages(PAIR, in_formation(PAIR))))
    assert count.since() == 0
    assert result.passed
    assert result.metrics["verdict"] == {"passed": True, "reasons": [], "warnings": []}
    assert result.metrics is result.metrics
    assert count.since() == 1
    assert "about_links" in vars(result)
    other = RunResult(result.recording)
    assert other.passed
    assert "about_links" not in vars(other), "a sweep asks for the verdict alone"
