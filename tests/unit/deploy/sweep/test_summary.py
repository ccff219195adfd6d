"""The bound for the share of unsafe runs that a sweep's summary holds."""

from __future__ import annotations

import pytest
from scipy.stats import beta

from handfast.deploy.sweep.plan import make_plan
from handfast.deploy.sweep.run import CRASHED, Row
from handfast.deploy.sweep.summary import bound_line, summarise, summary_json, summary_table, upper_bound
from tests.unit.deploy.sweep.asked import ask, made


@pytest.mark.parametrize("of", [1, 30, 1000, 30_000])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.03, 0.5, 0.999])
def test_the_bound_is_clopper_and_pearsons(of: int, share: float) -> None:
    count = round(share * of)
    exact = 1.0 if count == of else float(beta.ppf(0.95, count + 1, of - count))
    assert upper_bound(count, of) == pytest.approx(exact, rel=1e-9)


def test_none_of_n_is_the_rule_of_three() -> None:
    assert upper_bound(0, 30_000) == pytest.approx(1.0 - 0.05 ** (1.0 / 30_000), rel=1e-12)
    assert upper_bound(0, 30_000) == pytest.approx(3.0 / 30_000, rel=2e-3)
    assert upper_bound(5, 5) == 1.0


def test_the_summary_of_a_cell_has_the_bound_and_counts_unfinished_runs_as_unsafe() -> None:
    plan = make_plan(ask("faults.delay=0..1.4s", fleet="pair", repeat=20))
    rows = {run: made(plan, run) for run in range(20)}
    rows[3] = made(plan, 3, **{"min_distance_m.any": 0.1})
    rows[9] = Row(9, plan.run_seed(9), CRASHED, "its process was killed by SIGKILL")
    cells = summarise(plan, rows)
    bound = upper_bound(2, 20)
    assert cells[0].unsafe_upper == bound
    assert summary_json(plan, cells, [])["cells"][0]["unsafe_share_upper_95"] == round(bound, 6)
    heading, row = summary_table(plan, cells)
    assert dict(zip(heading, row, strict=True))["unsafe_share_upper_95"] == repr(round(bound, 6))
    assert bound_line(cells[0]) == (
        "20 runs, 1 unsafe and 1 not finished, counted as unsafe: at most 28.3 % of such runs are unsafe "
        "(95 % confidence, Clopper-Pearson)"
    )


@pytest.mark.parametrize(("runs", "said"), [(2, "77.7 %"), (10, "25.9 %"), (1, "95 %"), (300, "0.994 %")])
def test_a_printed_bound_is_rounded_up(runs: int, said: str) -> None:
    plan = make_plan(ask(fleet="pair", repeat=runs))
    (cell,) = summarise(plan, {run: made(plan, run) for run in range(runs)})
    assert f": at most {said} of such runs" in bound_line(cell)
