"""The picture of time: how long ticks took, how old neighbours' states were."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from handfast.agent.formation.points import Floats
from handfast.deploy.report.layout import GridLayout
from handfast.deploy.report.plotting import GREY, INK, PALETTE, new_figure, note
from handfast.deploy.verdict.run_result import RunResult


class _Row(NamedTuple):
    """What one row of the picture shows: `values` at `times` (s)."""

    title: str
    unit: str
    color: str
    times: Floats
    values: Floats


def worth_drawing(result: RunResult) -> bool:
    """Whether any time was recorded."""
    return bool(_rows(result))


def timing(result: RunResult) -> Figure:
    """How long ticks took and how old the neighbours' states were, over time and as distributions.

    What nothing was recorded of has no row.
    """
    rows = _rows(result)
    end = max(result.recording.end_s, 1e-3)
    figure = new_figure(8.6, 2.8 * len(rows) if len(rows) > 1 else 2.9, GridLayout())
    if not rows:
        note(figure.add_subplot(), "no times were recorded")
        return figure
    panels = figure.subplots(len(rows), 2, width_ratios=(1.6, 1.0), squeeze=False)
    for (over_time, spread), row in zip(panels, rows, strict=True):
        what = f"{row.title.split()[0].lower()} ({row.unit})"
        over_time.set_title(row.title)
        over_time.set_ylabel(what)
        over_time.set_xlabel("fleet time (s)")
        over_time.set_xlim(0.0, end)
        spread.set_title("Distribution")
        spread.set_xlabel(what)
        spread.set_ylabel("share of all (%)")
        inside = (row.times >= 0.0) & (row.times <= end)
        if not inside.any():
            for axes in (over_time, spread):
                note(axes, "nothing was recorded during the drive")
            continue
        _draw_over_time(over_time, row.times[inside], row.values[inside], end, row.color)
        _draw_spread(spread, row.values[inside], row.color, row.unit)
    return figure


def _rows(result: RunResult) -> list[_Row]:
    """Those of which there are values. In virtual time ticks take none."""
    statuses = [robot.status for robot in result.recording.robots.values()]
    ticks = [(s.t, s.tick_counts, s.tick_us) for s in statuses]
    ages = [(s.t, s.age_counts, s.ages_us) for s in statuses]
    given = [("Age of the neighbours' states", "ms", 1e3, ages, PALETTE[2])]
    if result.recording.mode != "simulate":
        given.insert(0, ("Duration of a tick", "µs", 1.0, ticks, PALETTE[0]))
    rows = []
    for title, unit, scale, series, color in given:
        times = np.concatenate([np.repeat(t, counts) for t, counts, _ in series])
        values = np.concatenate([values for _, _, values in series]) / scale
        if len(values):
            rows.append(_Row(title, unit, color, times, values))
    return rows


def _draw_over_time(axes: Axes, times: Floats, values: Floats, end: float, color: str) -> None:
    """Median, 99th percentile and maximum in each of at most 60 bins of time."""
    width = max(end / 60, 0.2)
    bins = np.floor(times / width).astype(np.int64)
    rows = []
    for number in np.unique(bins):
        chosen = values[bins == number]
        rows.append((min((number + 0.5) * width, end), *np.percentile(chosen, (50, 99, 100))))
    middle, median, high, top = np.array(rows).T
    marks = "o" if len(rows) == 1 else None  # of one point a line is not seen
    axes.fill_between(middle, median, high, color=color, alpha=0.18, linewidth=0)
    axes.plot(middle, top, ".", color=GREY, markersize=3.5, label="greatest")
    axes.plot(
        middle, high, color=color, linewidth=0.9, linestyle=(0, (4, 2)), label="99th percentile",
        marker=marks, markersize=4.5, markerfacecolor="white",
    )  # fmt: skip
    axes.plot(middle, median, color=color, linewidth=1.5, label="median", marker=marks, markersize=4.5)
    axes.set_ylim(0.0, 1.25 * float(top.max()) or 1.0)
    axes.legend(loc="upper right", ncols=3, columnspacing=1.0, handlelength=1.5)


def _draw_spread(axes: Axes, values: Floats, color: str, unit: str) -> None:
    median, high, top = np.percentile(values, (50, 99, 100))
    # The longest few would squeeze all others into one bar: they are counted in the last one.
    limit = 1.1 * float(min(top, max(3 * high, 1e-3))) or 1.0
    counts, edges = np.histogram(np.minimum(values, limit), bins=40, range=(0.0, limit))
    axes.stairs(100 * counts / len(values), edges, fill=True, color=color, alpha=0.45)
    for value, name in ((median, "median"), (high, "99 %")):
        number = f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
        axes.axvline(value, color=INK, linewidth=0.8, linestyle=(0, (4, 2)))
        axes.annotate(
            f"{name} {number} {unit}", (value, 1.0), xycoords=("data", "axes fraction"),
            xytext=(3 if value < 0.6 * limit else -3, -2 if name == "median" else -13),
            textcoords="offset points", ha="left" if value < 0.6 * limit else "right", va="top", fontsize=8,
            bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip
    axes.set_xlim(0.0, limit)
    axes.set_ylim(0.0, 1.3 * 100 * float(counts.max()) / len(values))  # room for the two labels
