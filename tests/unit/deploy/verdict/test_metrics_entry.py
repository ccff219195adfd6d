"""One entry makes a metric: metrics.json, the report, sweeps and docs have it."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from handfast.deploy import cli
from handfast.deploy.simulate import worker_pool
from handfast.deploy.sweep.run import Row, Runs
from handfast.deploy.verdict import metrics
from handfast.deploy.verdict.metrics import METRICS, Column, Metric, Picture, columns, look_up
from handfast.deploy.verdict.run_result import RunResult

LONGEST = Metric(
    "longest_edge_m.ever",
    "Greatest distance ever between two robots that share an edge.",
    lambda result: float(result.analysis.distances.max()),
    "Longest edge",
    "m",
    column=Column(10, "longest_m", picture=Picture("longest", "length", "longest", "cm", 100.0, 2)),
)


class Here:
    """Drives the runs of a sweep in this process, which knows of the metric."""

    def __init__(self, runs: Runs, *_: object) -> None:
        self._runs = runs

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def results(self, numbers: Iterable[int], *_: object) -> Iterator[Row]:
        return (self._runs.execute(number, lambda: True) for number in numbers)


@pytest.fixture
def with_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "METRICS", (*METRICS, LONGEST))
    monkeypatch.setattr(worker_pool, "Pool", Here)


@pytest.mark.usefixtures("with_longest")
def test_a_run_has_it(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert cli.main(["simulate", "pair", "--duration", "5", "--quiet", "--out", str(folder)]) == 0
    assert '"longest_edge_m": {\n    "ever": ' in (folder / "metrics.json").read_text()
    page = (folder / "report.html").read_text()
    assert f"<td>{LONGEST.title}</td>" in page
    assert f"<td>{LONGEST.meaning}</td>" in page


@pytest.mark.slow
@pytest.mark.usefixtures("with_longest")
def test_a_sweep_has_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fields = ["--over", "control.kp=0.5,1", "--over", "faults.delay=0,100ms"]
    sweep = ["sweep", "pair", "--duration", "2", "--jobs", "1", "--quiet"]
    assert cli.main([*sweep, *fields, "--out", str(tmp_path / "two")]) == 0
    with open(tmp_path / "two" / "results.csv", newline="", encoding="utf-8") as file:
        lengths = [float(row["longest_m"]) for row in csv.DictReader(file)]
    assert len(lengths) == 4
    assert min(lengths) > 1.0
    assert "longest_m_median" in (tmp_path / "two" / "summary.csv").read_text().splitlines()[0]
    assert '"longest_m": {' in (tmp_path / "two" / "summary.json").read_text()
    assert (tmp_path / "two" / "longest.png").exists()
    said = capsys.readouterr().out
    assert "longest cm" in said
    assert f"{100 * lengths[0]:.2f}" in said
    assert cli.main([*sweep, *fields[:2], "--out", str(tmp_path / "one")]) == 0
    assert (tmp_path / "one" / "curves.png").exists()


def test_names_are_told_once() -> None:
    names = [metric.name for metric in METRICS]
    assert len(set(names)) == len(names)
    assert len({column.place for _, column in columns().values()}) == len(columns())
    for metric in METRICS:
        assert metric.meaning.endswith("."), metric.name


def test_a_value_is_looked_up_where_it_is_written() -> None:
    assert look_up({"a": {"b": 1}, "c": 2}, "a.b") == 1
    assert look_up({"a": {"b": 1}, "c": 2}, "c") == 2


def test_what_may_be_left_out_is(monkeypatch: pytest.MonkeyPatch) -> None:
    empty = Metric("empty", "Nothing.", lambda _: {}, optional=True)
    monkeypatch.setattr(metrics, "METRICS", (empty, Metric("none", "None.", lambda _: None)))
    nobody: RunResult = object()  # type: ignore[assignment]
    assert metrics.compute(nobody) == {"none": None}
