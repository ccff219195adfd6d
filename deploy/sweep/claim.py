"""What a sweep with drawn fields shows as a whole: a bound for the share of unsafe runs, why some did not
settle, what it took.

Every run has drawn its own values, so all runs together are one sample. Pure functions of the rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context
from math import exp, lgamma, log
from typing import Any, Final

import numpy as np

from handfast.deploy.sweep.kinds_of_reasons import LETTERED, kinds_of_reasons
from handfast.deploy.sweep.plan import Plan
from handfast.deploy.sweep.run import CRASHED, TIMED_OUT, Row
from handfast.deploy.sweep.summary import Share, share_json

CONFIDENCE: Final = 0.95
REASONS_SHOWN: Final = 10
_BISECTIONS: Final = 60


@dataclass(frozen=True, slots=True)
class Claim:
    """All runs of a sweep as one sample.

    Attributes:
        runs: how many.
        unsafe: of these, those in which robots came below the safe distance.
        unfinished: those of which that is not known: they crashed, or took too long.
        upper: with `CONFIDENCE` at most this share of all runs that could be drawn is not known to be safe.
        settled: how many did.
        reasons: why others did not, with how many runs, the most frequent first.
    """

    runs: int
    unsafe: int
    unfinished: int
    upper: float
    settled: Share
    reasons: tuple[tuple[str, int], ...]


def upper_bound(count: int, of: int, confidence: float = CONFIDENCE) -> float:
    """The one-sided upper bound of a share of which `count` were seen in a sample (Clopper, Pearson 1934).

    It is the share with which `count` or fewer have the probability ``1 - confidence``; for none of n,
    ``1 - (1 - confidence)**(1/n)``: the rule of three.
    """
    if count >= of:
        return 1.0
    if count == 0:
        return 1.0 - exp(log(1.0 - confidence) / of)
    k = np.arange(count + 1)
    ways = np.array([lgamma(of + 1.0) - lgamma(i + 1.0) - lgamma(of - i + 1.0) for i in k.tolist()])
    low, high = count / of, 1.0
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        seen = float(np.exp(ways + k * log(share) + (of - k) * log(1.0 - share)).sum())
        low, high = (share, high) if seen > 1.0 - confidence else (low, share)
    return high


def make_claim(plan: Plan, rows: Mapping[int, Row]) -> Claim:
    """What all runs of a plan show; `rows` has all."""
    every = [rows[run] for run in range(plan.runs)]
    unsafe = sum(row.safe is False for row in every)
    unfinished = sum(row.verdict in (CRASHED, TIMED_OUT) for row in every)
    not_safe = sum(row.safe is not True for row in every)
    left = [row.reason or "no reason was found" for row in every if row.settled is not True]
    reasons = sorted(kinds_of_reasons(left), key=lambda pair: -pair[1])
    return Claim(
        len(every),
        unsafe,
        unfinished,
        upper_bound(not_safe, len(every)),
        Share(sum(row.settled is True for row in every), len(every)),
        tuple(reasons),
    )


def claim_json(claim: Claim) -> dict[str, Any]:
    """The part of ``summary.json`` that is of all runs."""
    return {
        "unsafe": claim.unsafe,
        "unfinished": claim.unfinished,
        "unsafe_share_upper_95": float(_up(claim.upper, 6)),
        "settled": share_json(claim.settled),
        "not_settled": [{"reason": reason, "runs": count} for reason, count in claim.reasons],
    }


def claim_lines(claim: Claim) -> list[str]:
    """The same for people."""
    low, high = claim.settled.interval
    unknown = f" and {claim.unfinished} not finished, counted as unsafe" if claim.unfinished else ""
    lines = [
        f"{_runs(claim.runs)}, {claim.unsafe} unsafe{unknown}: with 95 % confidence at most "
        f"{_up(100.0 * claim.upper, 3)} % of such runs are unsafe (Clopper-Pearson)",
        f"settled: {claim.settled.count} of {claim.runs}, {_percent(claim.settled.share)} "
        f"({_percent(low)} to {_percent(high)} with 95 % confidence)",
    ]
    for reason, count in claim.reasons[:REASONS_SHOWN]:
        lines.append(f"  {count} not settled: {reason}")
    if len(claim.reasons) > REASONS_SHOWN:
        more = sum(count for _, count in claim.reasons[REASONS_SHOWN:])
        lines.append(f"  {more} for other reasons, all in summary.json")
    if any(LETTERED.search(reason) for reason, _ in claim.reasons[:REASONS_SHOWN]):
        lines.append("  (A, B and so on are robots, others from run to run)")
    return lines


def cost_line(plan: Plan, rows: Sequence[Row]) -> str:
    """What these runs took of processors, and how much they drove; empty where nobody looked at it.

    Only who drives a run knows (`Row.cpu_s`): rows that were read from a folder are left out.
    """
    known = [row for row in rows if row.cpu_s > 0.0]
    if not known:
        return ""
    cpu_s = sum(row.cpu_s for row in known)
    robots_s = sum(_robot_seconds(plan, row.run) for row in known)
    return (
        f"{_runs(len(known))} driven now took {_amount(cpu_s)} CPU seconds for "
        f"{_amount(robots_s)} robot-seconds: "
        f"{robots_s / cpu_s:.1f} per core-second"
    )


def _robot_seconds(plan: Plan, run: int) -> float:
    fleet = plan.cells[run // plan.repeat]
    drawn = dict(zip(plan.fields, plan.run_values(run), strict=True))
    ranges = {each.field for each in plan.ranges}
    duration_s = float(drawn["fleet.duration_s"]) if "fleet.duration_s" in ranges else fleet.fleet.duration_s
    return len(fleet.robots) * duration_s


def _runs(count: int) -> str:
    return f"{count} run{'s' * (count != 1)}"


def _amount(value: float) -> str:
    """A number with three digits, or all of those before its point."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def _up(value: float, digits: int) -> str:
    """A bound with so many digits, rounded up: a smaller number would be none."""
    return f"{Context(prec=digits, rounding=ROUND_CEILING).create_decimal_from_float(value).normalize():f}"


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"
