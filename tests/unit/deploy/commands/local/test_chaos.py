"""``handfast chaos``: what it says, writes and returns."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from agent.fleet.loading import load_fleet
from agent.supervision.state_machine import TRANSITIONS
from deploy.chaos.draw import draw, seeds_of
from deploy.chaos.report import NOT_DRAWN, Driven, Tally, conclusion, lines
from deploy.chaos.run import IN_FORMATION, Outcome, scenario_text
from deploy.cli import main
from deploy.commands.local import chaos
from deploy.simulate import worker_pool
from deploy.verdict.violations import Violation

TOO_CLOSE = Violation("separation", 9.0, "Robots 1 and 2 came too close.")
ALL = {row.name: 1 for row in TRANSITIONS if row.name not in NOT_DRAWN}


class Instead:
    """A pool that drives nothing: seed 7 fails, seed 9 is never reached."""

    def __init__(self, work: chaos.Scenarios, jobs: int, timeout_s: float) -> None:
        self.shrink = work.shrink

    def __enter__(self) -> Instead:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def results(self, seeds: Iterable[int], go_on: Callable[[], bool]) -> Iterator[Driven]:
        for seed in seeds:
            if seed == 9:
                return
            tables = draw(seed)
            failed = Outcome((TOO_CLOSE, TOO_CLOSE) if seed == 7 else (), transitions=ALL, driven_s=1800.0)
            small = ({**tables, "order": []}, Outcome((TOO_CLOSE,))) if seed == 7 and self.shrink else None
            yield Driven(seed, tables, failed, small)


@pytest.fixture(autouse=True)
def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_pool, "Pool", Instead)


def test_without_a_violation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chaos", "--seed", "3", "--count", "4", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == "4 scenarios, 0 violations, 2 h 0 min of driving"
    assert "never taken" not in out
    assert re.search(r"well_again +4\b", out)
    assert list(tmp_path.iterdir()) == []


def test_what_fails_is_named_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chaos", "--seed", "6", "--count", "3", "--out", str(tmp_path), "--quiet"]) == 1
    said = capsys.readouterr()
    path = tmp_path / "chaos-7.toml"
    assert f"seed 7: separation: {TOO_CLOSE.message} (1 more) -> {path}\n" in said.err
    assert said.out == "3 scenarios, 2 violations, 1 h 30 min of driving\n"
    text = path.read_text()
    assert "handfast chaos --seed 7 --count 1" in text
    assert f"handfast simulate {path}" in text
    assert f"#   separation: {TOO_CLOSE.message}" in text
    assert load_fleet(path).orders == ()


def test_as_it_was_drawn(tmp_path: Path) -> None:
    assert main(["chaos", "--seed", "7", "--count", "1", "--out", str(tmp_path), "--no-shrink"]) == 1
    assert (tmp_path / "chaos-7.toml").read_text().endswith("\n\n" + scenario_text(draw(7)))


def test_an_end_before_all_are_driven(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chaos", "--seed", "8", "--count", "3", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().out.splitlines()[-1].startswith("1 scenario, 0 violations")


def test_one_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seeds = seeds_of("scale", 10, 2)
    assert main(["chaos", "--seed", "10", "--count", "2", "--profile", "scale", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"^  scale +2 +0 ", said, re.MULTILINE)
    assert "mixed" not in said
    assert main(
        ["chaos", "--seed", "10", "--count", "2", "--profile", "scale", "--write", "--out", str(tmp_path)]
    ) == 0  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {f"chaos-{seed}.toml" for seed in seeds}


def test_the_table_of_profiles_names_who_failed_by_what() -> None:
    tally = Tally()
    one, other = seeds_of("dead", 0, 2)
    tally.add(Driven(one, draw(one), Outcome((TOO_CLOSE, TOO_CLOSE), ended=IN_FORMATION)))
    tally.add(Driven(other, draw(other), Outcome(ended=IN_FORMATION)))
    (row,) = [line for line in lines(tally) if line.startswith("  dead")]
    assert row.split() == ["dead", "2", "1", "2", "0", "0", "0", "separation", "1"]


def test_only_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chaos", "--seed", "7", "--count", "2", "--out", str(tmp_path), "--write"]) == 0
    for seed in (7, 8):
        assert (tmp_path / f"chaos-{seed}.toml").read_text() == scenario_text(draw(seed))
    assert str(tmp_path / "chaos-8.toml") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--count", "0"], "--count must be at least 1, got 0"),
        (["--seed", "-1"], "--seed must be at least 0, got -1"),
        (["--profile", "slow"], "--profile must be one of mixed, cut-off"),
        (["--jobs", "0"], "--jobs must be at least 1, got 0"),
        (["--cluster", "tcp://there:1", "--write"], "--cluster drives scenarios, and with --write none is"),
        (["--accept-new-host-keys"], "--accept-new-host-keys is of hosts that --cluster ssh:FLEET names"),
        (["--cluster", "tcp://there:1", "--accept-new-host-keys"], "--accept-new-host-keys is of hosts that"),
        (["--cluster-wait", "10min"], "--cluster-wait is of a Dask scheduler that --cluster names"),
        (["--cluster", "ssh:delta", "--cluster-wait", "9s"], "--cluster-wait is of a Dask scheduler"),
        (["--cluster", "tcp://there:1", "--cluster-wait", "long"], "--cluster-wait must be a number (s)"),
        (["--cluster", "tcp://there:1", "--cluster-wait", "0"], "--cluster-wait must be more than 0 s"),
        (["--seed", str(2**63)], "--seed must be below"),
        (["--routed"], "--routed belongs to --real"),
    ],
)
def test_bad_input(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chaos", *arguments]) == 2
    assert says in capsys.readouterr().err


def test_a_folder_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["chaos", "--seed", "7", "--count", "1", "--out", str(tmp_path / "file" / "here")]) == 2
    assert capsys.readouterr().err.startswith(f"handfast: cannot make the folder {tmp_path}/file/here: ")


def test_a_failure_that_cannot_be_kept_is_said_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def is_full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", is_full)
    assert main(["chaos", "--seed", "6", "--count", "3", "--out", str(tmp_path)]) == 1
    told = capsys.readouterr()
    assert f"seed 7: {TOO_CLOSE.oracle}: {TOO_CLOSE.message} (1 more) -> cannot write {tmp_path}/" in told.err
    assert told.out.splitlines()[-1].startswith("3 scenarios, 2 violations")


def test_a_scenario_whose_process_died_is_a_failure() -> None:
    driven = chaos.Scenarios(shrink=True).unfinished(5, "killed by SIGKILL", 2.0, timed_out=False)
    assert driven.tables == draw(5)
    (failed,) = driven.outcome.violations
    assert failed.oracle == "crash"
    assert "killed by SIGKILL" in failed.message


def test_what_was_never_taken_is_said() -> None:
    tally = Tally()
    few: dict[str, Any] = dict.fromkeys(list(ALL)[1:], 2)
    tally.add(Driven(1, draw(1), Outcome(transitions=few, driven_s=59.0)))
    assert f"never taken: {next(iter(ALL))}" in list(lines(tally))
    assert conclusion(tally) == "1 scenario, 0 violations, 1 min of driving"
