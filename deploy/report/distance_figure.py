"""The picture of a run's distances over time: Fig. 4 of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.analysis import Analysis, norm
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.report.fault_strip import time_axes
from handfast.deploy.report.layout import EndLabel, GridLayout, label_ends
from handfast.deploy.report.plotting import (
    DOTTED,
    GREY,
    INK,
    LEGEND_MAX,
    PALETTE,
    RED,
    draw_many,
    new_figure,
    note,
    nth_color,
    nth_marked,
    nth_marker,
)
from handfast.deploy.verdict.run_result import RunResult

NEAR: Final = 1.5
"""Robots that came within so many safe distances are drawn, with an edge or without."""
SHRUNK: Final = 0.5
"""And those whose edge came below this share of its distance."""
NAMED_MAX: Final = 8
"""Pairs that came near and are drawn with colour, marker and name; the nearest ones."""
THIN_MAX: Final = 60
"""Further ones that are drawn thin; beyond them they are counted."""
_WANTED: Final = "#00664B"
_NOTE_MAX: Final = 60
"""Characters of a note that are drawn."""
_PLOT_IN: Final = 3.2
"""The axes are at least so high, inches."""
_LINE_IN: Final = 0.17
"""A line of text, inches."""


def worth_drawing(result: RunResult) -> bool:
    """Whether two robots were seen at once."""
    return result.analysis.closest is not None


def distances(result: RunResult) -> Figure:
    """The paper's Fig. 4: the distance of every edge over time, and of every pair without one that came near,
    with the safe distance; above it faults."""
    recording, a = result.recording, result.analysis
    figure = new_figure(7.6, 4.2, GridLayout())
    end = max(float(a.grid[-1]), 1e-3)
    (axes,) = time_axes(figure, recording, end)
    axes.set_ylabel("distance between hand points (m)")
    lengths = np.where(np.isfinite(a.wanted), a.distances, np.nan)  # while the edge is in force
    few = len(a.edges) <= LEGEND_MAX
    edges = [
        Line((i, j), lengths[:, column], True)
        for column, (i, j) in enumerate(a.edges.tolist())
        if np.isfinite(lengths[:, column]).any()
    ]
    near = near_edges(a, edges) if not few else []
    strangers, further = near_strangers(a)
    near = sorted([*near, *strangers], key=Line.least)
    if not edges and not near:
        note(axes, "no two robots were seen")
        return figure
    labels = _draw_wanted(axes, a, end)
    if few:
        named, rest = [*edges, *strangers[:NAMED_MAX]], strangers[NAMED_MAX:]
    else:
        draw_many(axes, a.grid, lengths, "edge")
        named, rest = near[:NAMED_MAX], near[NAMED_MAX:]
    axes.axhline(a.safe_m, color=RED, linewidth=1.3, linestyle=(0, (5, 3)))
    labels.append(EndLabel(f"safe distance\n{a.safe_m:g} m", end, a.safe_m, RED))
    _set_limits(axes, a, edges or near)
    labels += _draw_named(axes, recording.ids, a.grid, named)
    labels += _draw_rest(axes, a.grid, rest, further)
    if not few:
        labels += _name_greatest(axes, recording.ids, a, lengths)
        figure.legend(loc="outside upper left", ncols=4)
    label_ends(axes, labels, _PLOT_IN)
    if a.settling_s:
        axes.axvline(a.settling_s, color=INK, linewidth=0.8, linestyle=DOTTED)
        left = a.settling_s > 0.8 * end
        axes.annotate(
            f"settled after {a.settling_s:.1f} s", (a.settling_s, 1.0), xycoords=("data", "axes fraction"),
            xytext=(-4 if left else 4, -2), textcoords="offset points", ha="right" if left else "left",
            va="top", fontsize=8,
        )  # fmt: skip
    _mark_changes(axes, a)
    _mark_closest(axes, a)
    return figure


# --- which pairs -----------------------------------------------------------------------------


class Line(NamedTuple):
    """The distance of two robots, by index, over the times of the grid: `values` (k,) m, NaN where it is not
    known, or the pair has an edge and the line is of one without, or the other way round."""

    pair: tuple[int, int]
    values: Floats
    has_edge: bool

    def least(self) -> float:
        """The least distance, m."""
        return float(np.nanmin(self.values))


def near_edges(a: Analysis, edges: Sequence[Line]) -> list[Line]:
    """Those edges whose robots came near (`NEAR`), or much nearer than they should be (`SHRUNK`)."""
    wanted = {(i, j): a.wanted[:, column] for column, (i, j) in enumerate(a.edges.tolist())}
    return [
        edge
        for edge in edges
        if edge.least() < NEAR * a.safe_m or np.nanmin(edge.values / wanted[edge.pair]) < SHRUNK
    ]


def near_strangers(a: Analysis) -> tuple[list[Line], int]:
    """Pairs that came near (`NEAR`) while they shared no edge, and the closest of all pairs; nearest first.

    Of very many only the nearest are given, with the number of the others.
    """
    n = len(a.ids)
    columns: dict[int, list[tuple[int, int]]] = {}
    for column, (i, j) in enumerate(a.edges.tolist()):
        columns.setdefault(min(i, j), []).append((max(i, j), column))
    in_force = np.isfinite(a.wanted).T
    x, y = (np.ascontiguousarray(a.hands[:, :, axis].T) for axis in (0, 1))
    found: list[tuple[float, int, int]] = []
    for i in range(n - 1):  # a robot at a time: all pairs of a large fleet at once would not fit
        squared = (x[i + 1 :] - x[i]) ** 2 + (y[i + 1 :] - y[i]) ** 2
        for j, column in columns.get(i, ()):
            squared[j - i - 1, in_force[column]] = np.nan
        least = np.sqrt(np.fmin.reduce(squared, axis=1))
        for at in np.flatnonzero(least < NEAR * a.safe_m).tolist():  # False for NaN
            found.append((float(least[at]), i, i + 1 + at))
    closest = a.without_edge.closest
    if closest is not None and closest == a.closest:
        i, j = (a.ids.index(robot) for robot in closest.pair)
        if (i, j) not in {(i, j) for _, i, j in found}:
            found.append((closest.distance_m, i, j))
    found.sort()
    shown = found[: NAMED_MAX + THIN_MAX]
    lines = []
    for _, i, j in shown:
        values = norm(a.hands[:, i] - a.hands[:, j])
        for other, column in columns.get(i, ()):
            if other == j:
                values[in_force[column]] = np.nan
        lines.append(Line((i, j), values, False))
    return lines, len(found) - len(shown)


# --- what is drawn ---------------------------------------------------------------------------


def _draw_wanted(axes: Axes, a: Analysis, end: float) -> list[EndLabel]:
    """What the distances of edges should be, where these are few."""
    wanted = np.unique(np.round(a.wanted[[0, -1]], 6))
    wanted = wanted[np.isfinite(wanted)]
    labels = []
    for value in wanted.tolist() if len(wanted) <= 4 else []:
        axes.axhspan(value * (1 - SETTLED), value * (1 + SETTLED), color="#009E73", alpha=0.13, linewidth=0)
        axes.axhline(value, color=_WANTED, linewidth=0.8, linestyle=(0, (6, 3)))
        labels.append(EndLabel(f"wanted {value:.3g} m\n(±{100 * SETTLED:.0f} %)", end, value, _WANTED))
    return labels


def _set_limits(axes: Axes, a: Analysis, lines: Sequence[Line]) -> None:
    """All of these lines is to be seen; pairs that came near without an edge may go off as far as they do."""
    wanted = a.wanted[[0, -1]]
    tops = [1.08 * max(float(np.nanmax(line.values)) for line in lines)]
    if np.isfinite(wanted).any():
        tops.append(1.15 * float(np.nanmax(wanted)))
    axes.set_ylim(0.0, max(2 * a.safe_m, *tops))


def _draw_named(axes: Axes, ids: Sequence[int], grid: Floats, lines: Sequence[Line]) -> list[EndLabel]:
    """Lines in colours and with markers; their labels."""
    labels = []
    for index, line in enumerate(lines):
        style = nth_marked(index, len(grid))
        if not line.has_edge:
            style["linestyle"] = (0, (1, 1))
        axes.plot(grid, line.values, linewidth=1.3, **style)
        i, j = (ids[each] for each in line.pair)
        text = f"{i}–{j}" if line.has_edge else f"{i}–{j}, no edge"
        labels.append(EndLabel(text, *_last(grid, line.values), nth_color(index), nth_marker(index)))
    return labels


def _draw_rest(axes: Axes, grid: Floats, lines: Sequence[Line], further: int) -> list[EndLabel]:
    """Further pairs that came near, thin, with one label for all of them."""
    if not lines:
        return []
    for line in lines:
        axes.plot(grid, line.values, color=GREY, linewidth=0.6, alpha=0.8)
    count = len(lines) + further
    text = f"{count} more pair{'s' if count > 1 else ''}\nthat came near"
    return [EndLabel(text, *_last(grid, lines[0].values), GREY)]


def _last(grid: Floats, values: Floats) -> tuple[float, float]:
    """Where a line ends."""
    k = int(np.flatnonzero(np.isfinite(values))[-1])
    return float(grid[k]), float(values[k])


def _name_greatest(axes: Axes, ids: Sequence[int], a: Analysis, lengths: Floats) -> list[EndLabel]:
    """Of many edges: which was the longest of all, and at the end, where they are off."""
    off = lengths > (1.0 + SETTLED) * a.wanted
    if not off.any():
        return []
    k, column = divmod(int(np.nanargmax(np.where(off, lengths, np.nan))), lengths.shape[1])
    i, j = sorted(ids[each] for each in a.edges[column])
    t, value, end = float(a.grid[k]), float(lengths[k, column]), float(a.grid[-1])
    left = t > 0.6 * end
    axes.plot(t, value, "^", color=INK, markersize=5, zorder=6, clip_on=False)
    axes.annotate(
        f"longest edge: {value:.2f} m ({i}–{j}, {t:.1f} s)", (t, value), xytext=(-8 if left else 8, 0),
        textcoords="offset points", ha="right" if left else "left", va="center", fontsize=8, zorder=7,
        bbox={"boxstyle": "square,pad=0", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip
    if not off[-1].any():
        return []
    column = int(np.nanargmax(np.where(off[-1], lengths[-1], np.nan)))
    i, j = sorted(ids[each] for each in a.edges[column])
    return [EndLabel(f"{i}–{j}, longest", end, float(lengths[-1, column]), INK)]


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


def _mark_closest(axes: Axes, a: Analysis) -> None:
    """Mark the closest that any two robots came."""
    if a.closest is None:
        return
    value, t, (i, j) = a.closest
    end = float(a.grid[-1])
    axes.plot(t, value, "v", color=INK, markersize=5, zorder=6, clip_on=False)
    left = t > 0.45 * end
    aside = (-0.02 if left else 0.02) * end
    x, y, joined = t + aside, _beside_closest(value, a.safe_m, axes.get_ylim()[1]), True
    if y is None:  # on lines, which are seen through it
        x, y, joined = t + aside / 2, value + _LINE_IN / _PLOT_IN * axes.get_ylim()[1], False
    leader = {"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "relpos": (1.0 if left else 0.0, 0.5)}
    axes.annotate(
        f"closest: {value:.3f} m ({i}–{j}, {t:.1f} s)", (t, value), xytext=(x, y), textcoords="data",
        ha="right" if left else "left", va="center", fontsize=8, zorder=7,
        arrowprops=leader if joined else None,
        bbox={"boxstyle": "square,pad=0", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip


def _beside_closest(value: float, safe_m: float, top: float) -> float | None:
    """How high (m) a label of the closest distance stands, on axes from 0 to `top`; None where it would cover
    the safe distance or be covered by the axis.

    Below it no line can be, but that of the safe distance: just below, or below both.
    """
    line = _LINE_IN / _PLOT_IN * top
    just_below = value - line
    if abs(just_below - safe_m) > 0.6 * line and just_below > 0.6 * line:
        return just_below
    return safe_m / 2.0 if safe_m > 1.1 * line else None
