"""The picture of a run's distances over time: Fig. 4 of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.formation.points import Floats
from deploy.analysis.analysis import Analysis
from deploy.analysis.stability import SETTLED
from deploy.report.fault_strip import time_axes
from deploy.report.plotting import (
    DOTTED,
    GREY,
    INK,
    LEGEND_MAX,
    PALETTE,
    RED,
    draw_many,
    new_figure,
    note,
    nth_line,
)
from deploy.verdict.run_result import RunResult

_NOTE_MAX: Final = 60
"""Characters of a note that are drawn."""


def distances(result: RunResult) -> Figure:
    """The paper's Fig. 4: the distance of every edge over time, with the safe distance; above it faults."""
    recording, a = result.recording, result.analysis
    figure = new_figure(7.6, 4.2)
    end = max(float(a.grid[-1]), 1e-3)
    (axes,) = time_axes(figure, recording, end)
    axes.set_ylabel("distance between hand points (m)")
    safe = a.safe_m
    few = len(a.edges) <= LEGEND_MAX
    lengths = np.where(np.isfinite(a.wanted), a.distances, np.nan)  # while the edge is in force
    wanted = np.unique(np.round(a.wanted[[0, -1]], 6))
    wanted = wanted[np.isfinite(wanted)]
    for value in wanted if len(wanted) <= 4 else []:
        axes.axhspan(value * (1 - SETTLED), value * (1 + SETTLED), color="#009E73", alpha=0.13, linewidth=0)
        axes.axhline(value, color="#00664B", linewidth=0.8, linestyle=(0, (6, 3)))
    if len(wanted) and len(wanted) <= 4:
        axes.plot([], [], color="#00664B", linewidth=0.8, linestyle=(0, (6, 3)), label="wanted, ±5 % shaded")
    if few:
        for index, (i, j) in enumerate(a.edges.tolist()):
            label = f"{recording.ids[i]}–{recording.ids[j]}"
            values = lengths[:, index]
            axes.plot(a.grid, values, linewidth=1.3, label=label, **nth_line(index))
    else:
        draw_many(axes, a.grid, lengths, "edge")
    axes.axhline(safe, color=RED, linewidth=1.3, linestyle=(0, (5, 3)))
    finite = lengths[np.isfinite(lengths)]
    greatest = [1.08 * float(values.max()) for values in (finite, 1.06 * wanted) if values.size]
    top = max([2 * safe, *greatest])
    axes.set_ylim(0.0, top)
    if a.settling_s:
        axes.axvline(a.settling_s, color=INK, linewidth=0.8, linestyle=DOTTED)
        left = a.settling_s > 0.8 * end
        axes.annotate(
            f"settled after {a.settling_s:.1f} s", (a.settling_s, 1.0), xycoords=("data", "axes fraction"),
            xytext=(-4 if left else 4, -2), textcoords="offset points", ha="right" if left else "left",
            va="top", fontsize=8,
        )  # fmt: skip
    _mark_changes(axes, a)
    least = _mark_minimum(axes, recording.ids, a, lengths, safe) if finite.size else 0.0
    left = least > 0.54 * end
    axes.annotate(
        f"safe distance {safe:g} m", (0.0 if left else 1.0, safe), xycoords=("axes fraction", "data"),
        xytext=(4 if left else -2, -3), textcoords="offset points", ha="left" if left else "right", va="top",
        color=RED, fontsize=8,
    )  # fmt: skip
    if not len(a.edges):
        note(axes, "no robots share an edge")
    elif few:
        figure.legend(loc="outside right upper")
    else:
        figure.legend(loc="outside upper left", ncols=4)
    return figure


def _mark_changes(axes: Axes, a: Analysis) -> None:
    """A line where another mission began to hold, with what it changed."""
    for number, (change, _) in enumerate(a.changes):
        axes.axvline(change.t_s, color=PALETTE[0], linewidth=0.9, linestyle=(0, (4, 2)), zorder=1.6)
        left = change.t_s > 0.6 * float(a.grid[-1])
        text = change.note if len(change.note) <= _NOTE_MAX else f"{change.note[: _NOTE_MAX - 3]}..."
        axes.annotate(
            text, (change.t_s, 0.94 - 0.05 * (number % 4)), xycoords=("data", "axes fraction"),
            xytext=(-3 if left else 3, 0), textcoords="offset points", ha="right" if left else "left",
            va="top", fontsize=7, color=PALETTE[0], zorder=7,
            bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.7},
        )  # fmt: skip


def _mark_minimum(axes: Axes, ids: Sequence[int], a: Analysis, lengths: Floats, safe: float) -> float:
    """Mark the closest approach of any edge, `lengths` (k, m) while in force; returns its time."""
    k, column = np.unravel_index(int(np.nanargmin(lengths)), lengths.shape)
    value, t, end = float(lengths[k, column]), float(a.grid[k]), float(a.grid[-1])
    i, j = (ids[index] for index in a.edges[column])
    axes.plot(t, value, "v", color=INK, markersize=5, zorder=6, clip_on=False)
    # Written below the safe distance, where no line should be.
    left = t > 0.45 * end
    axes.annotate(
        f"closest: {value:.3f} m ({i}–{j}, {t:.1f} s)", (t, value),
        xytext=(t + (-0.02 if left else 0.02) * end, safe / 2), textcoords="data",
        ha="right" if left else "left", va="center", fontsize=8, zorder=7,
        arrowprops={
            "arrowstyle": "-", "color": GREY, "linewidth": 0.7, "relpos": (1.0 if left else 0.0, 0.5),
        },
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip
    return t
