"""What a sweep has found: every cell in numbers, and how far a field can go. Pure functions of the rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context
from math import ceil, floor, inf, isfinite, lgamma, log, log1p, sqrt
from typing import Any, Final

import numpy as np

from handfast.deploy.sweep.plan import Plan
from handfast.deploy.sweep.run import CRASHED, TIMED_OUT, Row
from handfast.deploy.sweep.varied import Axis, SweepError
from handfast.deploy.verdict.metrics import Column, Metric, Picture, columns

Z_95: Final = 1.959963984540054
DEFAULT_MARGIN: Final = "faults.delay"
QUANTILES: Final[Mapping[str, float]] = {"q25": 0.25, "median": 0.5, "q75": 0.75}
SETTLING: Final = "settling_time_s"
CLOSEST: Final = "min_distance_m"
CLOSEST_OF_ANY: Final = f"{CLOSEST}.any"


@dataclass(frozen=True, slots=True)
class Share:
    """A count of a total, with the 95 % interval of the share behind it (Wilson 1927)."""

    count: int
    of: int

    @property
    def share(self) -> float:
        return self.count / self.of

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper bound, 0..1."""
        z2 = Z_95**2 / self.of
        middle = (self.share + z2 / 2.0) / (1.0 + z2)
        half = sqrt(z2 * (self.share * (1.0 - self.share) + z2 / 4.0)) / (1.0 + z2)
        return max(0.0, middle - half), min(1.0, middle + half)


def upper_bound(count: int, of: int) -> float:
    """Return the one-sided 95 % upper bound of a share of which `count` were seen (Clopper, Pearson 1934).

    It is the share with which `count` or fewer have a probability of 5 %: about 3 / n for none of n.
    """
    if count >= of:
        return 1.0
    k = np.arange(count + 1)
    ways = np.array([lgamma(of + 1.0) - lgamma(i + 1.0) - lgamma(of - i + 1.0) for i in k.tolist()])
    low, high = count / of, 1.0
    for _ in range(60):  # bisection, to the last bit
        share = 0.5 * (low + high)
        if share in (low, high):
            break
        seen = float(np.exp(ways + k * log(share) + (of - k) * log1p(-share)).sum())
        low, high = (share, high) if seen > 0.05 else (low, share)
    return high


def bound_line(cell: Cell) -> str:
    """Say how many runs of a cell were unsafe, and what share of such runs may be."""
    unsafe = cell.safe.of - cell.safe.count - cell.unfinished
    unknown = f" and {cell.unfinished} not finished, counted as unsafe" if cell.unfinished else ""
    up = Context(prec=3, rounding=ROUND_CEILING).create_decimal_from_float(100.0 * cell.unsafe_upper)
    return (
        f"{cell.runs} run{'s' * (cell.runs != 1)}, {unsafe} unsafe{unknown}: at most {up.normalize():f} % of "
        "such runs are unsafe (95 % confidence, Clopper-Pearson)"
    )


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of the grid.

    `quantiles` has those of `summarised`, by name and then by `QUANTILES`; a quantile that falls among
    runs without that number (a settling time of a run that never settled) is None. `least_m` is the
    closest that any two robots came in any run, None when not known.
    """

    number: int
    values: tuple[str, ...]
    safe_distance_m: float
    runs: int
    unfinished: int
    safe: Share
    settled: Share
    good: int
    least_m: float | None
    quantiles: Mapping[str, Mapping[str, float | None]]

    @property
    def unsafe_upper(self) -> float:
        """Upper bound, 0..1, of the share of such runs that are unsafe, with 95 % confidence. Runs that did
        not finish count as unsafe."""
        return upper_bound(self.runs - self.safe.count, self.runs)

    @property
    def trouble(self) -> str:
        """Why it is not all safe and settled, in words; empty when it is."""
        counts = {
            "unsafe": self.safe.of - self.safe.count - self.unfinished,
            "not settled": self.settled.of - self.settled.count - self.unfinished,
            "not finished": self.unfinished,
        }
        return ", ".join(f"{count} of {self.runs} {what}" for what, count in counts.items() if count)


@dataclass(frozen=True, slots=True)
class Margin:
    """How far a field can go until runs fail, with the other fields fixed.

    `good` counts the values, from the least on, with which every run was safe and settled; `trouble` says
    what the next one brought, empty when there is none.
    """

    axis: Axis
    others: tuple[tuple[str, str], ...]
    good: int
    trouble: str

    @property
    def largest(self) -> str | None:
        """The last value that was good, None when not even the first one was."""
        return self.axis.values[self.good - 1] if self.good else None

    @property
    def failed(self) -> str | None:
        """The first value that was not good, None when all were."""
        return self.axis.values[self.good] if self.good < len(self.axis.values) else None

    def __str__(self) -> str:
        others = ", ".join(f"{field}={value}" for field, value in self.others)
        name = f"{self.axis.field} with {others}" if others else self.axis.field
        if self.largest is None:
            return f"{name}: none, not even {self.failed} is safe and settled ({self.trouble})"
        if self.failed is None:
            return f"{name}: safe and settled up to {self.largest}, the largest value"
        return f"{name}: safe and settled up to {self.largest} ({self.failed}: {self.trouble})"


def summarised() -> dict[str, tuple[Metric, Column]]:
    """What is told of every cell, by name; the least distances with an edge and of any two are one."""
    told = {name: pair for name, pair in columns().items() if pair[1].summarised}
    return {CLOSEST if name.startswith(CLOSEST) else name: pair for name, pair in told.items()}


@dataclass(frozen=True, slots=True)
class Shown:
    """A number of each cell as pictures and print show it: of a metric the median, of `CLOSEST` the least."""

    name: str
    title: str
    picture: Picture
    low_is_good: bool

    def value(self, cell: Cell) -> float | None:
        """In the picture's unit; None where a cell has none."""
        value = cell.least_m if self.name == CLOSEST else cell.quantiles[self.name]["median"]
        return None if value is None else self.picture.scale * value

    def text(self, value: float) -> str:
        return f"{value:.{self.picture.digits}f}"


def shown() -> list[Shown]:
    """What is shown of every cell, in order."""
    return [
        Shown(name, metric.title, column.picture, column.low_is_good)
        for name, (metric, column) in summarised().items()
        if column.picture is not None
    ]


def summarise(plan: Plan, rows: Mapping[int, Row]) -> list[Cell]:
    """Every cell, in the order of the grid. `rows` has all runs of the plan."""
    cells = []
    for number, fleet in enumerate(plan.cells):
        first = number * plan.repeat
        own = [rows[run] for run in range(first, first + plan.repeat)]
        nearest = [row.numbers.get(CLOSEST_OF_ANY) for row in own]
        cells.append(
            Cell(
                number,
                plan.values(number),
                fleet.formation.safe_distance_m,
                len(own),
                sum(row.verdict in (CRASHED, TIMED_OUT) for row in own),
                Share(sum(row.safe is True for row in own), len(own)),
                Share(sum(row.settled is True for row in own), len(own)),
                sum(row.good for row in own),
                min((value for value in nearest if value is not None), default=None),
                {
                    name: _quantiles(CLOSEST_OF_ANY if name == CLOSEST else name, own, column)
                    for name, (_, column) in summarised().items()
                },
            )
        )
    return cells


def _quantiles(name: str, rows: Sequence[Row], column: Column) -> dict[str, float | None]:
    # A run that never settled settles later than any other; one that was not finished is no better.
    missing = inf if column.low_is_good else -inf
    values = sorted(row.numbers.get(name, missing) for row in rows)
    return {label: _quantile(values, share) for label, share in QUANTILES.items()}


def _quantile(values: Sequence[float], share: float) -> float | None:
    """Linear between the two values at ``share (n - 1)``, as numpy's; `values` ascending."""
    place = share * (len(values) - 1)
    low, high = values[floor(place)], values[ceil(place)]
    if not isfinite(low) or not isfinite(high):
        return None
    return low + (place - floor(place)) * (high - low)


def margin_axis(plan: Plan, wanted: str | None) -> int | None:
    """Which axis the margin is of: `wanted`, else `DEFAULT_MARGIN`, else the first that has numbers.

    Raises:
        SweepError: `wanted` is not varied, or its values have no order.
    """
    names = [axis.field for axis in plan.axes]
    numeric = [axis.field for axis in plan.axes if axis.numbers is not None]
    if wanted is None:
        if DEFAULT_MARGIN in numeric:
            return names.index(DEFAULT_MARGIN)
        return names.index(numeric[0]) if numeric else None
    if wanted in (each.field for each in plan.ranges):
        raise SweepError(
            f"--margin {wanted}: every run draws it, so it has no margin: vary it over values instead, "
            f"--over {wanted}=V,V,..."
        )
    if wanted not in names:
        raise SweepError(f"--margin {wanted} is not varied: varied are {', '.join(names) or 'no fields'}")
    if wanted not in numeric:
        raise SweepError(f"--margin {wanted}: its values are no numbers, so none of them is the largest")
    return names.index(wanted)


def margins(plan: Plan, cells: Sequence[Cell], axis: int) -> list[Margin]:
    """The margin of an axis for each combination of the others, in the order of the grid."""
    lines: dict[tuple[str, ...], list[Cell]] = {}
    for cell in cells:
        lines.setdefault(cell.values[:axis] + cell.values[axis + 1 :], []).append(cell)
    names = [other.field for number, other in enumerate(plan.axes) if number != axis]
    out = []
    for values, line in lines.items():
        good = next((k for k, cell in enumerate(line) if cell.good < cell.runs), len(line))
        trouble = line[good].trouble if good < len(line) else ""
        out.append(Margin(plan.axes[axis], tuple(zip(names, values, strict=True)), good, trouble))
    return out


# ---------------------------------------------------------------------- as tables


def summary_table(plan: Plan, cells: Sequence[Cell]) -> list[list[str]]:
    """The content of ``summary.csv``: a heading and a row for each cell."""
    heading = [axis.field for axis in plan.axes] + ["runs", "unfinished"]
    for name in ("safe", "settled"):
        heading += [name, f"{name}_share", f"{name}_low", f"{name}_high"]
    heading += ["unsafe_share_upper_95"]
    heading += [f"{CLOSEST}_least"]
    heading += [f"{name}_{label}" for name in summarised() for label in QUANTILES]
    table = [heading]
    for cell in cells:
        row = [*cell.values, str(cell.runs), str(cell.unfinished)]
        for share in (cell.safe, cell.settled):
            row += [str(share.count), *(_text(value) for value in (share.share, *share.interval))]
        row += [_text(cell.unsafe_upper), _text(cell.least_m)]
        row += [_text(cell.quantiles[name][label]) for name in summarised() for label in QUANTILES]
        table.append(row)
    return table


def summary_json(plan: Plan, cells: Sequence[Cell], found: Sequence[Margin]) -> dict[str, Any]:
    """The content of ``summary.json``."""
    fields = [axis.field for axis in plan.axes]
    return {
        **plan.identity(),
        "runs": plan.runs,
        "margins": [
            {
                "field": margin.axis.field,
                "with": dict(margin.others),
                "largest": margin.largest,
                "failed": margin.failed,
                "trouble": margin.trouble,
            }
            for margin in found
        ],
        "cells": [
            {
                "fields": dict(zip(fields, cell.values, strict=True)),
                "runs": cell.runs,
                "unfinished": cell.unfinished,
                "safe": _share_json(cell.safe),
                "unsafe_share_upper_95": _rounded(cell.unsafe_upper),
                "settled": _share_json(cell.settled),
                "least_distance_m": _rounded(cell.least_m),
                **{
                    name: {label: _rounded(value) for label, value in cell.quantiles[name].items()}
                    for name in summarised()
                },
            }
            for cell in cells
        ],
    }


def _share_json(share: Share) -> dict[str, Any]:
    low, high = share.interval
    return {
        "count": share.count,
        "share": _rounded(share.share),
        "low": _rounded(low),
        "high": _rounded(high),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 6)


def _text(value: float | None) -> str:
    return "" if value is None else repr(_rounded(value))
