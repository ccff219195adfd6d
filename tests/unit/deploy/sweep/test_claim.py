"""What a sweep with drawn fields shows as a whole."""

from __future__ import annotations

import pytest
from scipy.stats import beta

from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep.claim import claim_json, claim_lines, cost_line, make_claim, upper_bound
from handfast.deploy.sweep.plan import Plan, Question, make_plan
from handfast.deploy.sweep.run import CRASHED, FAILED, PASSED, Row
from handfast.deploy.sweep.varied import parse_over


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


def plan(repeat: int) -> Plan:
    text = (FLEETS / "pair.toml").read_text()
    drawn = parse_over("faults.delay=0..1.4s")
    return make_plan(Question("pair", text, None, ("fleet.duration_s=10",), (), repeat, None, (drawn,)))  # type: ignore[arg-type]


def row(run: int, reason: str = "", **more: object) -> Row:
    verdict = PASSED if not reason else FAILED
    values = {"safe": True, "settled": not reason, "numbers": {"rms_distance_error_m": 0.1}, "cpu_s": 2.0}
    return Row(run, 0, verdict, reason, **(values | more))  # type: ignore[arg-type]


def test_all_runs_are_one_sample() -> None:
    rows = {run: row(run) for run in range(20)}
    rows[3] = row(3, "Robots 1 and 2 came within 0.1 m", safe=False)
    for run in (5, 6, 7, 8):
        rows[run] = row(run, f"edge 1-2 was 0.{run} m off")
    rows[9] = Row(9, 0, CRASHED, "its process was killed by SIGKILL")
    claim = make_claim(plan(20), rows)
    assert (claim.runs, claim.unsafe, claim.unfinished) == (20, 1, 1)
    assert claim.upper == upper_bound(2, 20)
    assert (claim.settled.count, claim.settled.of) == (14, 20)
    assert claim.reasons[0] == ("edge 1-2 was 0.5 to 0.8 m off", 4)
    assert claim_json(claim)["unsafe_share_upper_95"] == pytest.approx(claim.upper, rel=1e-5)
    lines = claim_lines(claim)
    assert lines[0].startswith("20 runs, 1 unsafe and 1 not finished, counted as unsafe: with 95 % ")
    assert lines[1].startswith("settled: 14 of 20, 70 % (")
    assert lines[2] == "  4 not settled: edge 1-2 was 0.5 to 0.8 m off"


@pytest.mark.parametrize(("runs", "said"), [(2, "77.7 %"), (10, "25.9 %"), (1, "95 %"), (300, "0.994 %")])
def test_a_bound_is_rounded_up(runs: int, said: str) -> None:
    """77.639 % was shown as 77.6 %, which is no bound."""
    claim = make_claim(plan(runs), {run: row(run) for run in range(runs)})
    assert f" at most {said} of such runs" in claim_lines(claim)[0]
    assert float(said[:-2]) >= 100.0 * claim.upper
    assert claim_json(claim)["unsafe_share_upper_95"] >= claim.upper


def test_one_run_and_a_short_time_are_said_as_they_are() -> None:
    claim = make_claim(plan(1), {0: row(0)})
    assert claim_lines(claim)[0].startswith("1 run, 0 unsafe")
    assert cost_line(plan(1), [row(0, cpu_s=0.379)]) == (
        "1 run driven now took 0.379 CPU seconds for 20 robot-seconds: 52.8 per core-second"
    )


def test_robots_of_other_runs_are_no_list() -> None:
    rows = {0: row(0, "Robot 1: without robot 2."), 1: row(1, "Robot 2: without robot 1.")}
    assert claim_lines(make_claim(plan(2), rows))[2:] == [
        "  2 not settled: Robot A: without robot B.",
        "  (A, B and so on are robots, others from run to run)",
    ]


def test_the_cost_is_of_what_was_driven_now() -> None:
    rows = [row(0), row(1), row(2, cpu_s=0.0)]
    assert cost_line(plan(3), rows) == (
        "2 runs driven now took 4 CPU seconds for 40 robot-seconds: 10.0 per core-second"
    )
    assert cost_line(plan(3), rows[2:]) == ""
