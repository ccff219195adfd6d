"""The picture of a sweep whose runs draw their fields: a point for each run, at what it has drawn.

Of two fields and more: the first two across and up, and when it settled as its colour. Of one: that across,
the settling time up. Runs without a settling time have none of its values: they stand above it, in rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from numpy.typing import NDArray

from handfast.agent.formation.points import Floats
from handfast.deploy.report.drawing.plotting import INK, PALETTE, RED, new_figure
from handfast.deploy.sweep.plan import Plan
from handfast.deploy.sweep.run import Row
from handfast.deploy.sweep.summary import SETTLING
from handfast.deploy.sweep.varied import Range

COLORS: Final = "cividis_r"
TICKS_MAX: Final = 6
"""Of a range that is narrow and far from 0 each is long: a difference to something in a corner is unread."""
_TIME: Final = "settling time (s)"


class _Kind(NamedTuple):
    """Runs that something went wrong in: what, how they are drawn, which they are (n,)."""

    what: str
    marker: str
    color: str
    which: NDArray[np.bool_]

    @property
    def label(self) -> str:
        return f"{self.which.sum()} {self.what}"


def runs_at_their_draws(plan: Plan, rows: Mapping[int, Row]) -> Figure:
    """Every run at what it has drawn; what did not settle, was unsafe or did not finish is on top."""
    every = [rows[run] for run in range(plan.runs)]
    drawn = np.array([[float(value) for value in plan.drawn(run)] for run in range(plan.runs)])
    times = np.array([row.numbers.get(SETTLING, np.nan) if row.settled else np.nan for row in every])
    kinds = [
        _Kind("not settled", "x", PALETTE[1], np.array([row.settled is False for row in every])),
        _Kind("not finished", "s", INK, np.array([row.settled is None for row in every])),
        _Kind("unsafe", "D", RED, np.array([row.safe is False for row in every])),
    ]
    kinds = [kind for kind in kinds if kind.which.any()]
    settled = np.isfinite(times)
    title = f"{len(every)} runs, {settled.sum()} settled"
    if len(plan.ranges) > 1:
        return _over_two(plan.ranges, drawn, times, kinds, title)
    return _over_one(plan.ranges[0], drawn[:, 0], times, kinds, title)


def _over_two(
    ranges: Sequence[Range], drawn: Floats, times: Floats, kinds: Sequence[_Kind], title: str
) -> Figure:
    figure = new_figure(8.6, 5.2)
    axes = figure.subplots()
    x, y = drawn[:, 0], drawn[:, 1]
    settled = np.isfinite(times)
    if settled.any():
        dots = axes.scatter(
            x[settled], y[settled], c=times[settled], s=_size(len(times)), cmap=COLORS, linewidths=0,
            rasterized=True,
        )  # fmt: skip
        bar = figure.colorbar(dots, ax=axes, pad=0.02, label=_TIME)
        bar.outline.set_visible(False)
    for kind in kinds:
        axes.scatter(
            x[kind.which], y[kind.which], s=22.0, marker=kind.marker, color=kind.color, label=kind.label
        )
    if kinds:  # beside the points: one of its markers among them would be another run
        figure.legend(loc="outside upper right", ncols=len(kinds))
    axes.set_xlim(*_whole(ranges[0]))  # that nothing was drawn somewhere is to be seen
    axes.set_ylim(*_whole(ranges[1]))
    axes.set_xlabel(_label(ranges[0]))
    axes.set_ylabel(_label(ranges[1]))
    axes.set_title(title)
    _in_full(axes, "x")
    _in_full(axes, "y")
    return figure


def _over_one(drawn: Range, x: Floats, times: Floats, kinds: Sequence[_Kind], title: str) -> Figure:
    settled = np.isfinite(times)
    above = [kind for kind in kinds if (kind.which & ~settled).any()]
    figure = new_figure(8.6, 4.6 + 0.3 * len(above))
    ratios = [0.3 * len(above), 4.0] if above else [4.0]
    panels = figure.subplots(len(ratios), 1, squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    axes = panels[-1]
    axes.scatter(x[settled], times[settled], s=_size(len(x)), color=PALETTE[0], linewidths=0, rasterized=True)
    for row, kind in enumerate(above):
        here = x[kind.which & ~settled]
        panels[0].scatter(here, np.full(len(here), row), s=22.0, marker=kind.marker, color=kind.color)
    if above:
        panels[0].set_yticks(range(len(above)), [f"{(k.which & ~settled).sum()} {k.what}" for k in above])
        panels[0].set_ylim(-0.7, len(above) - 0.3)
        panels[0].tick_params(length=0, labelbottom=False)
    for kind in kinds:
        both = kind.which & settled
        if both.any():
            label = f"{both.sum()} {kind.what}"
            axes.scatter(x[both], times[both], s=22.0, marker=kind.marker, color=kind.color, label=label)
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside upper right")
    most = float(times[settled].max()) if settled.any() else 1.0
    axes.set_ylim(0.0, 1.05 * most if most > 0.0 else 1.0)
    axes.set_xlim(*_whole(drawn))
    axes.set_xlabel(_label(drawn))
    axes.set_ylabel(_TIME)
    panels[0].set_title(title)
    _in_full(axes, "x")
    return figure


def _size(runs: int) -> float:
    """Of a dot, points squared."""
    return float(np.clip(6000.0 / runs, 2.0, 30.0))


def _in_full(axes: Axes, way: str) -> None:
    """Has ticks say their numbers, not what they are more than another one."""
    axis = axes.xaxis if way == "x" else axes.yaxis
    axis.set_major_locator(MaxNLocator(TICKS_MAX))
    axis.set_major_formatter(ScalarFormatter(useOffset=False))


def _whole(drawn: Range) -> tuple[float, float]:
    """Limits of an axis that shows all of a range."""
    edge = 0.02 * (drawn.high - drawn.low)
    return drawn.low - edge, drawn.high + edge


def _label(drawn: Range) -> str:
    return f"{drawn.field} ({drawn.unit})" if drawn.unit else drawn.field
