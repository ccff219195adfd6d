"""What a sweep asks, and what it makes of its runs; its processes are in tests/process."""

from __future__ import annotations

import copy
import csv
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest, kstest

from handfast.agent.fleet.model import FleetError
from handfast.agent.formation.geometry import start_hands
from handfast.agent.messages.codec import decode
from handfast.deploy.recording.collector import RunData
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.simulate.worker_pool import Abandoned
from handfast.deploy.sweep import run as run_module
from handfast.deploy.sweep.figures import write_sweep_figures
from handfast.deploy.sweep.folder import SweepFolder, read_question
from handfast.deploy.sweep.plan import Plan, Question, make_plan
from handfast.deploy.sweep.run import CRASHED, FAILED, PASSED, Row, execute, unfinished
from handfast.deploy.sweep.summary import Share, margin_axis, margins, summarise, summary_json, summary_table
from handfast.deploy.sweep.varied import SweepError, parse_axis
from handfast.deploy.verdict.metrics import columns
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.sweep.asked import NEVER, ask, fill, made

# ---------------------------------------------------------------------- the question


@pytest.mark.parametrize(
    ("text", "field", "values", "numbers", "unit"),
    [
        ("control.kp=0,0.5,1", "control.kp", ("0", "0.5", "1"), (0.0, 0.5, 1.0), "1/s2"),
        (" control.kp = 2, 1e0 ", "control.kp", ("1e0", "2"), (1.0, 2.0), "1/s2"),
        (
            "faults.delay=100ms,0,2s,50ms", "faults.delay", ("0", "50ms", "100ms", "2s"),
            (0.0, 0.05, 0.1, 2.0), "s",
        ),
        ("faults.loss=30%,0,0.1", "faults.loss", ("0", "0.1", "30%"), (0.0, 0.1, 0.3), "ratio"),
        ("fleet.duration_s='2min',90", "fleet.duration_s", ("90", "'2min'"), (90.0, 120.0), "s"),
        ("robot.3.mass_kg=10kg,500g", "robot.3.mass_kg", ("500g", "10kg"), (0.5, 10.0), "kg"),
        ("robot_defaults.hand_offset_m=10cm", "robot_defaults.hand_offset_m", ("10cm",), (0.1,), "m"),
        ("control.coupling=joint,edge", "control.coupling", ("joint", "edge"), None, ""),
        (
            "trajectory.velocity_mps=[0.1, 0.2],[0,0]", "trajectory.velocity_mps", ("[0.1, 0.2]", "[0,0]"),
            None, "",
        ),
        ("faults.delay=0,normal 80ms 20ms", "faults.delay", ("0", "normal 80ms 20ms"), None, ""),
        ("a.b=\"x,y\",'[', 1", "a.b", ('"x,y"', "'['", "1"), None, ""),
    ],
)  # fmt: skip
def test_values_of_an_axis(
    text: str, field: str, values: tuple[str, ...], numbers: tuple[float, ...] | None, unit: str
) -> None:
    axis = parse_axis(text)
    assert (axis.field, axis.values, axis.unit) == (field, values, unit)
    assert axis.numbers == (None if numbers is None else pytest.approx(numbers, rel=1e-15))
    assert parse_axis(str(axis)) == axis


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("control.kp", "--over control.kp: must be written as table.field=value,value"),
        ("kp=1,2", "--over kp=1,2: must be written as"),
        ("control.=1", "must be written as"),
        ("control.kp=", "a value is missing"),
        ("control.kp=1,,2", "--over control.kp=1,,2: a value is missing"),
        ("control.kp=1,2,1", "--over control.kp: gives 1 twice"),
        ("faults.delay=0.1,100ms", "gives 0.1 and 100ms, which are the same"),
        ("fleet.seed=1,2,3", "every run has a seed of its own already, .* --repeat 3"),
    ],
)
def test_bad_axis_is_refused_by_name(text: str, says: str) -> None:
    with pytest.raises(SweepError, match=says):
        parse_axis(text)


@pytest.mark.parametrize(
    ("question", "says"),
    [
        (ask("control.kp=1", "control.kp=2"), "--over control.kp is given twice"),
        (
            ask("control.kp=1", overrides=("control. kp=2",)),
            "--over control.kp varies a field that --set fixes",
        ),
        (
            ask("robot.1.x_m=-3,8", random_starts=0.0),
            "--random-starts: draws where robots start .* robot.1.x_m",
        ),
        (ask("robot.2.heading_rad=0..1", random_starts=0.0), "robot.2.heading_rad as well: leave that out"),
        (ask("control.kp=1", repeat=0), "--repeat must be at least 1, got 0"),
        (ask(random_starts=1e200), "--random-starts: a side of 1e\\+200 m is too long: at most 1e\\+06 m"),
        (ask("control.kp=1,2", repeat=10**6), "2,000,000 runs: at most 1,000,000"),
    ],
)
def test_contradictions_are_refused(question: Question, says: str) -> None:
    with pytest.raises(SweepError, match=says):
        make_plan(question)


def test_all_problems_of_all_cells_are_said_once() -> None:
    question = ask(
        "control.kp=1,-1,x", "control.kpp=1,2", "fleet.rate_hz=5,50", overrides=("control.c2=zero",)
    )
    with pytest.raises(FleetError) as raised:
        make_plan(question)
    problems = sorted(map(str, raised.value.problems))
    assert [problem.partition(": ")[0] for problem in problems] == [
        "--over control.kp=-1",
        "--over control.kp=x",
        "--over control.kpp",
        "--set control.c2",
        "control.plant_timeout_s",
        "control.wrench_timeout_s",
    ]
    assert "did you mean kp?" in problems[2]
    assert problems[4].endswith("(with --over fleet.rate_hz=5)")


def test_a_repeat_has_the_same_seed_and_start_in_every_cell() -> None:
    plan = make_plan(ask("control.kp=0,1", "control.c2=0.3,0.6,0.9", repeat=3, random_starts=0.0))
    assert plan.runs == 18
    fleets = [plan.fleet(run) for run in range(plan.runs)]
    for run, fleet in enumerate(fleets):
        assert fleet.fleet.seed == plan.run_seed(run) == plan.run_seed(run % 3)
        assert fleet.robots == fleets[run % 3].robots
        assert fleet.formation == fleets[run % 3].formation
        kp, c2 = plan.values(run // 3)
        assert (fleet.control.kp, fleet.control.c2) == (float(kp), float(c2))
    assert len({fleet.fleet.seed for fleet in fleets}) == 3
    assert len({fleet.robots for fleet in fleets}) == 3
    assert all(fleet.fleet.seed < 2**53 for fleet in fleets)
    again = make_plan(ask("control.kp=0,1", repeat=5, random_starts=0.0))
    assert [again.fleet(k).robots for k in range(3)] == [fleet.robots for fleet in fleets[:3]]
    other = make_plan(ask("control.kp=0,1", overrides=("fleet.seed=1",), repeat=3))
    assert {other.run_seed(k) for k in range(3)}.isdisjoint(fleet.fleet.seed for fleet in fleets)


def test_random_starts_lie_in_their_square_and_keep_apart() -> None:
    plan = make_plan(ask("formation.safe_distance_m=0.22,0.4", repeat=4, random_starts=3.0))
    assert plan.gap_m == pytest.approx(0.5)
    for run in range(plan.runs):
        hands = start_hands(plan.fleet(run))
        assert np.abs(hands - (-0.16, 0.63)).max() <= 1.5 + 1e-9
        gaps = np.hypot(*(hands[:, None] - hands[None, :]).transpose(2, 0, 1))
        assert gaps[~np.eye(6, dtype=bool)].min() >= 0.5 - 1e-9


def test_random_starts_assign_places_unless_told_not_to() -> None:
    assigned = make_plan(ask(repeat=1, random_starts=4.0)).fleet(0)
    varied = make_plan(ask("formation.assign=true,false", repeat=1, random_starts=4.0))
    assert varied.fleet(0) == assigned
    assert varied.fleet(1).robots == assigned.robots
    assert varied.fleet(1).formation.edges == make_plan(ask()).fleet(0).formation.edges
    assert assigned.formation.edges != varied.fleet(1).formation.edges


# ---------------------------------------------------------------------- one run


def everything(fleet: Any) -> RunResult:
    """Of all messages, as `handfast simulate` has it."""
    data = RunData(fleet, mode="simulate")
    Simulation(fleet, lambda at, key, payload: data.feed(at, key, decode(payload))).run()
    return RunResult(data.recording())


@pytest.mark.parametrize(
    "more", [(), ("robot_defaults.position_noise_m=1cm",), ("faults.delay=100ms", "faults.loss=20%")]
)
def test_a_run_is_measured_as_simulate_measures_it(more: tuple[str, ...]) -> None:
    plan = make_plan(ask(fleet="pair", overrides=("fleet.duration_s=3", *more), repeat=2))
    fleet = plan.fleet(1)
    wanted, found = everything(fleet), RunResult(run_module.drive(fleet))
    for name, (metric, _) in columns().items():
        assert metric.value(found) == metric.value(wanted), name
    assert found.reasons == wanted.reasons
    expected = wanted.metrics
    row = execute(plan, 1)
    assert (row.run, row.seed, row.verdict) == (
        1, fleet.fleet.seed, PASSED if expected["verdict"]["passed"] else FAILED,
    )  # fmt: skip
    assert row.numbers["min_distance_m.edge"] == expected["min_distance_m"]["edge"]
    assert row.numbers["age_p99_ms"] == expected["age_of_information_ms"]["p99"]
    assert row.numbers.get("settling_time_s") == expected["settling_time_s"]
    assert row.settled is (expected["settling_time_s"] is not None)
    assert replace(execute(plan, 1), wall_s=0.0) == replace(row, wall_s=0.0)


@pytest.mark.parametrize("kind", [ZeroDivisionError, KeyboardInterrupt])
def test_a_run_that_raises_is_a_row(monkeypatch: pytest.MonkeyPatch, kind: type[BaseException]) -> None:
    def broken(*_: object) -> None:
        raise kind("some\nthing")

    monkeypatch.setattr(run_module, "Simulation", broken)
    row = execute(make_plan(ask(repeat=2)), 1)
    assert (row.run, row.verdict, row.safe, row.settled, row.numbers) == (1, CRASHED, None, None, {})
    assert row.reason.startswith(f"{kind.__name__}: some thing (test_plan.py, line ")


def test_a_run_is_abandoned_when_told() -> None:
    plan = make_plan(ask(overrides=("fleet.duration_s=1e6",)))
    asked = iter([True, True, False])
    with pytest.raises(Abandoned):
        execute(plan, 0, lambda: next(asked))


@pytest.mark.parametrize("written", ["10..200%", "50%..200%", "0..200%"])
def test_an_end_of_a_range_that_cannot_be_is_said_as_it_was_typed(written: str) -> None:
    with pytest.raises(FleetError) as refused:
        make_plan(ask(f"faults.loss={written}"))
    assert '--over faults.loss=200%: must be between 0% and 100%, got "200%"' in str(refused.value)


# ---------------------------------------------------------------------- what it finds


@pytest.mark.parametrize(("count", "of"), [(0, 1), (1, 1), (0, 20), (3, 20), (20, 20), (57, 100)])
def test_interval_is_wilsons(count: int, of: int) -> None:
    expected = binomtest(count, of).proportion_ci(0.95, "wilson")
    assert Share(count, of).interval == pytest.approx((expected.low, expected.high), abs=1e-12)


def rows_of(plan: Plan, different: Mapping[int, Row] | None = None) -> dict[int, Row]:
    return {run: made(plan, run) for run in range(plan.runs)} | dict(different or {})


def test_a_cell_in_numbers() -> None:
    plan = make_plan(ask("control.kp=0,1", repeat=5))
    times = [4.0, 9.0, 5.0, NEVER, 7.0]
    nearest = [0.5, 0.21, 0.3, 0.4, 0.6]
    rows = {
        run: made(plan, run, **{"settling_time_s": times[run], "min_distance_m.any": nearest[run]})
        for run in range(5)
    }
    first, second = summarise(plan, rows_of(plan, rows))
    assert (first.runs, first.safe, first.settled, first.good) == (5, Share(4, 5), Share(4, 5), 3)
    assert first.least_m == 0.21
    assert first.quantiles["settling_time_s"] == {"q25": 5.0, "median": 7.0, "q75": 9.0}
    expected = np.percentile(nearest, [25, 50, 75]).tolist()
    assert list(first.quantiles["min_distance_m"].values()) == pytest.approx(expected)
    assert first.trouble == "1 of 5 unsafe, 1 of 5 not settled"
    assert (second.good, second.trouble) == (5, "")


def test_runs_that_never_settle_count_as_later_than_all_others() -> None:
    plan = make_plan(ask("control.kp=0", repeat=4))
    rows = {run: made(plan, run, settling_time_s=NEVER) for run in (1, 3)}
    rows[2] = unfinished(plan, 2, CRASHED, "gone", 1.0)
    (cell,) = summarise(plan, rows_of(plan, rows))
    assert cell.quantiles["settling_time_s"] == {"q25": None, "median": None, "q75": None}
    assert cell.quantiles["rms_distance_error_m"]["median"] == 0.25
    assert cell.quantiles["rms_distance_error_m"]["q75"] is None
    assert cell.trouble == "2 of 4 not settled, 1 of 4 not finished"
    assert (cell.safe, cell.unfinished, cell.good) == (Share(3, 4), 1, 1)


def bad_from(plan: Plan, axis: int, least: Mapping[str, int]) -> dict[int, Row]:
    """Rows where one run of each cell is unsafe from the `least[value of the other axis]`-th value on."""
    rows = rows_of(plan)
    for cell in range(len(plan.cells)):
        values = plan.values(cell)
        if plan.axes[axis].values.index(values[axis]) >= least[values[1 - axis]]:
            rows[cell * plan.repeat] = made(plan, cell * plan.repeat, **{"min_distance_m.any": 0.1})
    return rows


@pytest.mark.parametrize("axis", [0, 1])
def test_margin_is_the_last_value_before_the_first_trouble(axis: int) -> None:
    over = ["faults.delay=0,200ms,50ms,1s", "control.kp=1,2,3"]
    plan = make_plan(ask(*(over if axis == 0 else reversed(over)), repeat=2))
    rows = bad_from(plan, axis, {"1": 4, "2": 2, "3": 0})
    cells = summarise(plan, rows)
    assert margin_axis(plan, None) == axis
    found = margins(plan, cells, axis)
    assert [(margin.largest, margin.failed, margin.others) for margin in found] == [
        ("1s", None, (("control.kp", "1"),)),
        ("50ms", "200ms", (("control.kp", "2"),)),
        (None, "0", (("control.kp", "3"),)),
    ]
    assert list(map(str, found)) == [
        "faults.delay with control.kp=1: safe and settled up to 1s, the largest value",
        "faults.delay with control.kp=2: safe and settled up to 50ms (200ms: 1 of 2 unsafe)",
        "faults.delay with control.kp=3: none, not even 0 is safe and settled (1 of 2 unsafe)",
    ]


def test_summaries_hold_every_cell() -> None:
    plan = make_plan(ask("faults.delay=0,1s", "control.kp=1,2", repeat=2))
    cells = summarise(plan, rows_of(plan, {7: made(plan, 7, settling_time_s=NEVER)}))
    table = summary_table(plan, cells)
    assert {len(row) for row in table} == {len(table[0])}
    last = dict(zip(table[0], table[4], strict=True))
    assert (last["faults.delay"], last["control.kp"], last["runs"]) == ("1s", "2", "2")
    assert (last["settled"], last["settled_share"], last["settled_low"]) == ("1", "0.5", "0.094531")
    assert (last["settling_time_s_q25"], last["settling_time_s_median"]) == ("", "")
    text = json.dumps(summary_json(plan, cells, margins(plan, cells, 0)), allow_nan=False)
    read = json.loads(text)
    assert read["cells"][3]["settled"] == {"count": 1, "share": 0.5, "low": 0.094531, "high": 0.905469}
    assert read["margins"][1] == {
        "field": "faults.delay", "with": {"control.kp": "2"}, "largest": "0", "failed": "1s",
        "trouble": "1 of 2 not settled",
    }  # fmt: skip


# ---------------------------------------------------------------------- pictures


HEAT_MAPS = {"settling_time.png", "least_distance.png", "rms_error.png", "share_safe.png"}


@pytest.mark.parametrize(
    ("over", "names"),
    [
        ((), set()),
        (("control.kp=1",), {"curves.png"}),
        (("faults.delay=0,1s,2s",), {"curves.png"}),
        (("control.coupling=edge,joint",), {"curves.png"}),
        (("faults.delay=0,1s,2s", "control.kp=0,1"), HEAT_MAPS),
        (("control.coupling=edge,joint", "fleet.description='a long one of many words',b"), HEAT_MAPS),
        (("control.kp=0,1", "faults.delay=0,1s,2s", "control.c2=0.3,0.6,1"), HEAT_MAPS),
    ],
)
def test_pictures_are_drawn_and_the_same_again(
    tmp_path: Path, over: tuple[str, ...], names: set[str]
) -> None:
    plan = make_plan(ask(*over, repeat=2))
    rows = rows_of(plan, {0: made(plan, 0, settling_time_s=NEVER)})
    for run in (plan.runs - 1, plan.runs - 2):  # a whole cell without numbers
        rows[run] = unfinished(plan, run, CRASHED, "gone", 1.0)
    cells = summarise(plan, rows)
    axis = margin_axis(plan, None)
    found = margins(plan, cells, axis) if axis is not None else []
    written = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        paths, left_out = write_sweep_figures(folder, plan, cells, axis, found)
        assert left_out == ""
        assert {path.name for path in paths} == names
        written.append([path.read_bytes() for path in paths])
    assert written[0] == written[1]


# --- fields that are drawn ------------------------------------------------------------------------


def test_every_run_draws_and_the_same_again() -> None:
    question = ask("control.kp=0.5,1", "faults.delay=0..1.4s", "faults.loss=10..50%", repeat=200)
    plan, again = make_plan(question), make_plan(question)
    assert plan.fields == ("control.kp", "faults.delay", "faults.loss")
    assert plan.runs == 400
    drawn = np.array([[float(value) for value in plan.drawn(run)] for run in range(400)])
    assert (drawn == [[float(value) for value in again.drawn(run)] for run in range(400)]).all()
    assert (drawn[:200] == drawn[200:]).all(), "repeats are paired over the cells"
    for column, low, high in ((0, 0.0, 1.4), (1, 0.1, 0.5)):
        assert ((drawn[:, column] >= low) & (drawn[:, column] <= high)).all()
        assert kstest(drawn[:200, column], "uniform", (low, high - low)).pvalue > 0.01
    assert abs(np.corrcoef(drawn[:200].T)[0, 1]) < 0.2


def test_a_run_drives_what_its_row_says() -> None:
    plan = make_plan(
        ask("faults.delay=0..1.4s", overrides=("fleet.duration_s=3",), repeat=3, random_starts=4.0)
    )
    fleet = plan.fleet(2)
    (text,) = plan.drawn(2)
    assert fleet == copy.deepcopy(plan).fleet(2)
    alone = make_plan(
        ask(overrides=("fleet.duration_s=3", f"faults.delay={text}"), repeat=3, random_starts=4.0)
    )
    assert alone.fleet(2) == fleet
    assert plan.run_name(2) == f"faults.delay={text}"


def test_what_is_drawn_is_a_column_and_outlives_the_process(tmp_path: Path) -> None:
    question = ask("faults.delay=0..1.4s", repeat=4)
    plan = make_plan(question)
    with SweepFolder(tmp_path / "out", question, plan) as folder:
        fill(folder, range(3))
    question = read_question(tmp_path / "out")
    with SweepFolder(tmp_path / "out", question, make_plan(question)) as folder:
        assert folder.missing == [3]
    with open(tmp_path / "out" / "results.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["faults.delay"] for row in rows] == [plan.drawn(run)[0] for run in range(3)]
    other = ask("faults.delay=0..1.5s", repeat=4)
    with pytest.raises(SweepError, match=r"--over is faults\.delay=0\.\.1\.5s, was faults\.delay=0\.\.1\.4s"):
        SweepFolder(tmp_path / "out", other, make_plan(other))


@pytest.mark.parametrize(
    ("over", "says"),
    [
        (("faults.delay=1s..0",), "the range must begin below its end"),
        (("faults.delay=1s..1000ms",), "the range must begin below its end"),
        (("delay=0..1s",), "must be written as table.field=value,value"),
        (("fleet.seed=0..9",), "every run has a seed of its own already"),
        (("faults.delay=0..1s", "faults.delay=0,1s"), "given twice"),
    ],
)  # fmt: skip
def test_a_range_that_is_none_is_refused(over: tuple[str, ...], says: str) -> None:
    with pytest.raises(SweepError, match=says):
        make_plan(ask(*over))


def test_both_ends_of_a_range_are_read_before_anything_is_driven() -> None:
    with pytest.raises(FleetError) as error:
        make_plan(ask("faults.loss=0.5..1.5"))
    assert "--over faults.loss=1.5" in str(error.value)
    plan = make_plan(ask("faults.delay=0..1.4s", "faults.loss=0..50%"))
    assert len(plan.samples(0)) == 4
    assert len({sample.faults for sample in plan.samples(0)}) == 4
