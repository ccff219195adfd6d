"""What a sweep keeps in its folder, and which folders it does not take."""

from __future__ import annotations

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from handfast.deploy.console.arguments import fleet_text
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep.folder import SweepFolder, read_question
from handfast.deploy.sweep.plan import Question, make_plan
from handfast.deploy.sweep.run import CRASHED, unfinished
from handfast.deploy.sweep.varied import SweepError
from tests.unit.deploy.sweep.asked import ask, fill


def test_rows_outlive_the_process_and_the_sweep_goes_on(tmp_path: Path) -> None:
    question = ask("control.kp=0,1", "control.coupling='edge',joint", repeat=2)
    plan = make_plan(question)
    with SweepFolder(tmp_path / "new" / "sweep", question, plan) as folder:
        assert folder.missing == list(plan.order())
        fill(folder, range(3))
        folder.add(unfinished(plan, 7, CRASHED, 'its "process", gone', 0.5))
        rows = dict(folder.rows)
    with SweepFolder(folder.path, question, plan) as again:
        assert again.rows == rows
        assert set(again.missing) == {3, 4, 5, 6}
        fill(again, range(3, 7))
        assert not again.missing
        again.complete()
    with SweepFolder(folder.path, read_question(folder.path), plan) as third:
        assert list(third.rows) == list(range(8))
    table = list(csv.DictReader((folder.path / "results.csv").read_text().splitlines()))
    assert [row["run"] for row in table] == [str(run) for run in range(8)]
    assert table[2] | {"seed": ""} == {
        "run": "2", "control.kp": "0", "control.coupling": "joint", "repeat": "0", "seed": "",
        "settled": "false", "safe": "true", "settling_time_s": "", "min_distance_m.edge": "0.6",
        "min_distance_m.any": "0.5", "rms_distance_error_m": "0.25", "final_distance_error_m": "0.001",
        "final_tracking_error_m": "0.01", "age_p50_ms": "20.0", "age_p99_ms": "20.0", "age_max_ms": "40.0",
        "verdict": "failed", "reason": "Something, and more.", "wall_s": "0.125",
    }  # fmt: skip
    assert table[7]["reason"] == 'its "process", gone'


@pytest.mark.parametrize("lost", [1, 30, 10_000])
def test_a_row_that_was_cut_off_is_driven_again(tmp_path: Path, lost: int) -> None:
    question = ask("control.kp=0,1", repeat=2)
    plan = make_plan(question)
    with SweepFolder(tmp_path, question, plan) as folder:
        fill(folder, range(4))
    results = tmp_path / "results.csv"
    content = results.read_bytes()
    results.write_bytes(content[: max(len(content) - lost, 5)])
    with SweepFolder(tmp_path, question, plan) as folder:
        assert folder.missing == ([3] if lost < 10_000 else [0, 2, 1, 3])
        fill(folder, range(3, 4))
    if lost < 10_000:
        assert results.read_bytes() == content  # nothing is left of the part that was there


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (ask("control.kp=0,2", repeat=2), r"--over is control\.kp=0,2, was control\.kp=0,1"),
        (ask("control.kp=0,1", repeat=3), "--repeat is 3, was 2"),
        (ask("control.kp=0,1", repeat=2, overrides=("fleet.seed=9",)), "the seed is 9, was 0"),
        (ask("control.kp=0,1", repeat=2, random_starts=4.0), r"--random-starts is 4\.0, was not given"),
        (ask("control.kp=0,1", repeat=2, law="edge"), "--law is edge, was not given"),
        (
            ask("control.kp=0,1", repeat=2, overrides=("fleet.duration_s=0.5",)),
            r"--set is fleet\.duration_s=0\.5, was not given",
        ),
        (ask("control.kp=0,1", repeat=2, fleet="pair"), "the fleet is pair, was delta"),
        (
            replace(
                ask("control.kp=0,1", repeat=2),
                text=fleet_text(FLEETS / "delta.toml").replace("duration_s = 30", "duration_s = 31"),
            ),
            "the fleet file is another one",
        ),
    ],
)
def test_a_folder_of_another_sweep_is_refused(tmp_path: Path, other: Question, says: str) -> None:
    question = ask("control.kp=0,1", repeat=2)
    with SweepFolder(tmp_path, question, make_plan(question)) as folder:
        fill(folder, range(1))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(SweepError, match=f"holds another sweep: .*{says}"):
        SweepFolder(tmp_path, other, make_plan(other))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_folder_that_is_in_use_or_holds_something_else_is_refused(tmp_path: Path) -> None:
    question = ask("control.kp=0,1")
    plan = make_plan(question)
    with (
        SweepFolder(tmp_path / "a", question, plan),
        pytest.raises(SweepError, match="another sweep is at work"),
    ):
        SweepFolder(tmp_path / "a", question, plan)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "thesis.tex").touch()
    with pytest.raises(SweepError, match="b is not empty and holds no sweep"):
        SweepFolder(tmp_path / "b", question, plan)
    with pytest.raises(SweepError, match="cannot write the sweep's folder"):
        SweepFolder(tmp_path / "b" / "thesis.tex" / "out", question, plan)


def test_a_folder_that_is_removed_ends_the_sweep_with_its_next_row(tmp_path: Path) -> None:
    question = ask("control.kp=0,1")
    with SweepFolder(tmp_path / "gone", question, make_plan(question)) as folder:
        fill(folder, range(1))
        shutil.rmtree(tmp_path / "gone")
        with pytest.raises(SweepError, match=r"^cannot write .*results\.csv: it has been removed$"):
            fill(folder, range(1, 2))
        with pytest.raises(SweepError, match="cannot write"):
            folder.complete()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("1,1,0,", "9,1,0,"),
        ("1,1,0,", "1,0,0,"),
        (",true,", ",yes,"),
        (",0.5,", ",,,0.5"),
        (",0.5,", ",half,"),
        (",0.5,", ",nan,"),
        (",passed,", ",flown,"),
    ],
)
def test_a_row_that_is_not_of_the_sweep_is_refused(tmp_path: Path, old: str, new: str) -> None:
    question = ask("control.kp=0,1")
    with SweepFolder(tmp_path, question, make_plan(question)) as folder:
        fill(folder, range(1, 2))
    results = tmp_path / "results.csv"
    assert old in results.read_text()
    results.write_text(results.read_text().replace(old, new))
    with pytest.raises(SweepError, match=r"results\.csv, line 2: not a row of this sweep"):
        SweepFolder(tmp_path, question, make_plan(question))


def test_the_folder_of_another_fleet_names_the_fleets(tmp_path: Path) -> None:
    question = ask("control.kp=0,1", repeat=2)
    with SweepFolder(tmp_path / "out", question, make_plan(question)):
        pass
    other = ask("control.kp=0,1", fleet="pair", repeat=3)
    with pytest.raises(SweepError, match=r"the fleet is pair, was delta; --repeat is 3, was 2"):
        SweepFolder(tmp_path / "out", other, make_plan(other))


def test_what_was_asked_and_then_edited_is_refused(tmp_path: Path) -> None:
    question = ask(repeat=40)
    with SweepFolder(tmp_path, question, make_plan(question)):
        pass
    file = tmp_path / "sweep.toml"
    file.write_text(file.read_text().replace("repeat = 40", "repeat = 45"))
    again = read_question(tmp_path)
    with pytest.raises(SweepError, match=r"sweep\.toml has been changed: .* makes 45 runs, .* runs = 40"):
        SweepFolder(tmp_path, again, make_plan(again))


def test_a_sweep_of_another_version_is_not_said_to_go_on(tmp_path: Path) -> None:
    question = ask("control.kp=0,1")
    with SweepFolder(tmp_path, question, make_plan(question)):
        pass
    file = tmp_path / "sweep.toml"
    file.write_text(re.sub('handfast = ".*"', 'handfast = "0.0.9"', file.read_text()))
    with pytest.raises(SweepError, match=r"was 0\.0\.9\. Name another folder with --out$"):
        SweepFolder(tmp_path, question, make_plan(question))
