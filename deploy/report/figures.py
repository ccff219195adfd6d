"""The pictures of a run. Figures 3 and 4 of the paper are `trajectories` and `distances`.

With more robots than colours, numbers and envelopes do the work.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from agent.control.boundaries import fence_of, obstacles_of
from agent.fleet.fleet import Fleet
from deploy.analysis.analysis import Analysis
from deploy.analysis.stability import SETTLED
from deploy.recording.link_table import Floats
from deploy.recording.recording import Recording
from deploy.report import link_figures
from deploy.report.fault_strip import time_axes
from deploy.report.plotting import (
    DASHED,
    DOTTED,
    GREY,
    INK,
    LEGEND_MAX,
    PALETTE,
    RED,
    SECOND_ROUND,
    draw_boundary,
    new_figure,
    note,
    nth_color,
    view,
    write,
)

_NOTE_MAX: Final = 60
"""Characters of a note that are drawn."""
NAMES: Final = ("trajectories", "distances", "forces", "timing")
"""Pictures of every run; `deploy.report.link_figures.NAME` comes with links that are worth one."""


def write_figures(
    folder: str | PathLike[str], recording: Recording, fleet: Fleet, analysis: Analysis
) -> dict[str, Path]:
    """Draw all of `NAMES`, and links if they are worth it, into `folder` as PNG; the paths by name.

    Raises:
        RecordingError: when one cannot be written.
    """
    drawings: dict[str, Callable[[], Figure]] = {
        "trajectories": partial(trajectories, recording, fleet, analysis),
        "distances": partial(distances, recording, fleet, analysis),
        "forces": partial(forces, recording),
        "timing": partial(timing, recording),
    }
    if link_figures.worth_drawing(recording):
        drawings[link_figures.NAME] = partial(link_figures.links, recording)
    out = {}
    for name, draw in drawings.items():
        out[name] = Path(folder) / f"{name}.png"
        write(out[name], draw)
    return out


# --- trajectories ----------------------------------------------------------------------------


def trajectories(recording: Recording, fleet: Fleet, a: Analysis) -> Figure:
    """The paper's Fig. 3: paths, desired ones dotted, starts as circles, the formation at several times.

    With what the fleet file puts in the way: obstacles grey, the geofence dashed.
    """
    ground = [*obstacles_of(fleet), *([fence] if (fence := fence_of(fleet)) is not None else [])]
    few = len(recording.ids) <= LEGEND_MAX
    everything = np.concatenate([a.hands.reshape(-1, 2), a.desired.reshape(-1, 2)])
    everything = everything[np.isfinite(everything).all(axis=1)]
    low, high = view(everything.min(axis=0), everything.max(axis=0), ground)
    margin = 0.06 * max(float((high - low).max()), 0.5)
    low, high = low - margin, high + margin
    span_x, span_y = high - low
    scale = min(8.0 / span_x, 7.0 / span_y)
    figure = new_figure(max(span_x * scale, 3.6) + 0.9, max(span_y * scale, 3.0) + 1.1)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")
    for boundary in ground:
        draw_boundary(axes, boundary)
    moments = _moments(a)
    for shade, k in zip(np.linspace(0.25, 1.0, len(moments)), moments, strict=True):
        _draw_formation(axes, a, k, float(shade), few)
    for index in range(len(recording.ids)):
        color = nth_color(index)
        width, alpha = (1.5, 1.0) if few else (0.7, 0.75)
        axes.plot(*a.desired[:, index].T, linestyle=DOTTED, color=GREY, linewidth=0.7 * width, zorder=2)
        axes.plot(*a.hands[:, index].T, color=color, linewidth=width, alpha=alpha, zorder=3)
    _draw_starts(axes, recording.ids, a, few)
    path_color = PALETTE[0] if few else GREY
    axes.plot([], [], color=path_color, linewidth=1.5, label="hand path")
    axes.plot([], [], linestyle=DOTTED, color=GREY, linewidth=1.2, label="desired path")
    axes.plot([], [], "o", markerfacecolor="white", markeredgecolor=INK, markersize=6, label="start")
    axes.plot([], [], "o-", color=INK, linewidth=1.2, markersize=4, label="formation at the time given")
    if fleet.geofence is not None:
        axes.plot([], [], color=RED, linewidth=1.1, linestyle=DASHED, label="geofence")
    figure.legend(loc="outside upper left", ncols=4, columnspacing=1.2, handlelength=1.8)
    return figure


def _moments(a: Analysis) -> list[int]:
    """Rows of the grid at which the formation is drawn: start, end, and up to three between.

    Only as many as stay apart: a formation that stands still would be drawn over itself.
    """
    last = len(a.grid) - 1
    if last == 0:
        return [0]
    centre = np.nanmean(a.desired, axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(centre, axis=0).T))])
    size = float(np.ptp(a.desired[0][np.isfinite(a.desired[0, :, 0])], axis=0).max()) or 1.0
    for between in (3, 2, 1):
        rows = np.searchsorted(travelled, np.linspace(0, travelled[-1], between + 2))
        places = centre[rows]
        apart = [
            float(np.hypot(*(places[i] - places[j])))
            for j in range(1, between + 1)  # the end may well be at the start: a circle
            for i in range(between + 2)
            if i != j
        ]
        if min(apart) >= (0.5 if a.hands.shape[1] <= LEGEND_MAX else 0.9) * size:
            return [0, *rows[1:-1].tolist(), last]
    return [0, last]


def _draw_formation(axes: Axes, a: Analysis, k: int, shade: float, few: bool) -> None:
    # Of robots with a place alone: one in reserve, or that has left, is no part of the formation.
    places = np.where(np.isfinite(a.desired[k]), a.hands[k], np.nan)
    in_force = a.edges[np.isfinite(a.wanted[k])]
    lines = [places[edge] for edge in in_force if np.isfinite(places[edge]).all()]
    color = str(0.82 * (1.0 - shade) + 0.1)
    width = (1.3 if few else 0.7) * (0.7 if k == 0 else 1.0)
    style = (0, (4, 3)) if k == 0 else "solid"
    drawn = LineCollection(lines, colors=color, linewidths=width, linestyles=[style], zorder=4 + shade)
    axes.add_collection(drawn)
    if k:
        axes.plot(*places.T, "o", color=color, markersize=4.5 if few else 2.2, zorder=5 + shade)
    known = places[np.isfinite(places).all(axis=1)]
    if not len(known):
        return
    right = _aside(a, known)
    place = known[np.argmax(known @ right)]
    axes.annotate(
        f"{round(float(a.grid[k]), 1):g} s", place, xytext=(12 * float(right[0]), 12 * float(right[1])),
        textcoords="offset points",
        ha="left" if right[0] > 0.3 else "right" if right[0] < -0.3 else "center",
        va="top" if right[1] < -0.3 else "bottom" if right[1] > 0.3 else "center",
        fontsize=8, color=INK, zorder=9,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.6},
    )  # fmt: skip


def _aside(a: Analysis, places: Floats) -> Floats:
    """Unit vector to where a label of the formation at `places` (n, 2) is in nobody's way.

    On a straight way that is to its side (the lower one), else away from the middle of all that is drawn.
    """
    centre = np.nanmean(a.desired, axis=1)
    course = centre[-1] - centre[0]
    length = float(np.hypot(*course))
    if length > 0.9 * float(np.hypot(*np.diff(centre, axis=0).T).sum()) and length > 1e-3:
        aside: Floats = np.array([course[1], -course[0]]) / length
        return -aside if aside[1] > 0 else aside
    outwards: Floats = places.mean(axis=0) - np.nanmean(a.hands.reshape(-1, 2), axis=0)
    distance = float(np.hypot(*outwards))
    return outwards / distance if distance > 1e-3 else np.array([0.0, -1.0])


def _draw_starts(axes: Axes, ids: Sequence[int], a: Analysis, few: bool) -> None:
    for index, robot in enumerate(ids):
        x, y = a.hands[0, index]
        if not np.isfinite(x):
            continue
        size = 11 if few else 8
        axes.plot(
            x, y, "o", markersize=size, markerfacecolor="white", markeredgecolor=nth_color(index),
            markeredgewidth=1.3 if few else 0.8, zorder=7,
        )  # fmt: skip
        number = 7 if few else 4.5
        axes.annotate(str(robot), (x, y), ha="center", va="center_baseline", fontsize=number, zorder=8)


# --- distances -------------------------------------------------------------------------------


def distances(recording: Recording, fleet: Fleet, a: Analysis) -> Figure:
    """The paper's Fig. 4: the distance of every edge over time, with the safe distance; above it faults."""
    figure = new_figure(7.6, 4.2)
    end = max(float(a.grid[-1]), 1e-3)
    (axes,) = time_axes(figure, recording, end)
    axes.set_ylabel("distance between hand points (m)")
    safe = fleet.formation.safe_distance_m
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
            style = "solid" if index < len(PALETTE) else SECOND_ROUND
            label = f"{recording.ids[i]}–{recording.ids[j]}"
            values = lengths[:, index]
            axes.plot(a.grid, values, color=nth_color(index), linewidth=1.3, linestyle=style, label=label)
    else:
        _draw_many(axes, a.grid, lengths, "edge")
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


def _draw_many(axes: Axes, t: Floats, values: Floats, what: str) -> None:
    """Many lines over the same times: thin ones, their envelope and their median. values: (k, m)."""
    known = values[:, np.isfinite(values).any(axis=0)]
    if not known.shape[1]:
        return
    least, greatest = np.fmin.reduce(known, axis=1), np.fmax.reduce(known, axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # there may be times without any: no line there
        median = np.nanmedian(known, axis=1)
    color = PALETTE[0]
    axes.fill_between(t, least, greatest, color=color, alpha=0.10, linewidth=0)
    segments = [np.column_stack([t, known[:, index]]) for index in range(known.shape[1])]
    axes.add_collection(LineCollection(segments, colors=color, linewidths=0.4, alpha=0.35))
    axes.plot(t, least, color=color, linewidth=0.9)
    label = f"least and greatest of {known.shape[1]} {what}s"
    axes.plot(t, greatest, color=color, linewidth=0.9, label=label)
    axes.plot(t, median, color=INK, linewidth=1.3, label="median")


# --- forces ----------------------------------------------------------------------------------


def forces(recording: Recording) -> Figure:
    """Navigation and constraint forces per unit mass, and what is asked of each body, over time."""
    figure = new_figure(8.6, 5.6)
    panels = figure.subplots(2, 2, sharex=True)
    grid = recording.grid
    unit = "per unit mass (m/s²)"
    columns: list[tuple[str, str, Callable[[Any], tuple[Floats, Floats]]]] = [
        ("Navigation force", f"$|F_n|$ {unit}", lambda r: (r.hand.t, _length(r.hand, "navigation"))),
        ("Constraint force", f"$|F_c|$ {unit}", lambda r: (r.hand.t, _length(r.hand, "constraint"))),
        ("Force asked of the plant", "force (N)", lambda r: (r.wrench.t, r.wrench["force"])),
        ("Torque asked of the plant", "torque (N m)", lambda r: (r.wrench.t, r.wrench["torque"])),
    ]
    few = len(recording.ids) <= LEGEND_MAX
    for axes, (title, label, column) in zip(panels.flat, columns, strict=True):
        axes.set_title(title)
        axes.set_ylabel(label)
        axes.set_xlim(0.0, max(float(grid[-1]), 1e-3))
        series = [column(robot) for robot in recording.robots.values()]
        if not any(len(t) for t, _ in series):
            note(axes, "nothing was recorded")
        elif few:
            for index, (t, values) in enumerate(series):
                inside = (t >= 0) & (t <= grid[-1])
                style = "solid" if index < len(PALETTE) else SECOND_ROUND
                axes.plot(t[inside], values[inside], color=nth_color(index), linewidth=0.9, linestyle=style)
        else:
            table = np.column_stack([np.interp(grid, t, values) for t, values in series if len(t)])
            _draw_many(axes, grid, table, "robot")
    for axes in panels[1]:
        axes.set_xlabel("fleet time (s)")
    if few:
        for index, robot in enumerate(recording.ids):
            style = "solid" if index < len(PALETTE) else SECOND_ROUND
            label = f"robot {robot}"
            panels[0, 0].plot([], [], color=nth_color(index), linewidth=1.3, linestyle=style, label=label)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    if handles:
        rows = 1 if len(handles) <= 6 else 2
        figure.legend(handles, labels, loc="outside upper left", ncols=-(-len(handles) // rows))
    return figure


def _length(table: Any, name: str) -> Floats:
    length: Floats = np.hypot(table[f"{name}_x"], table[f"{name}_y"])
    return length


# --- timing ----------------------------------------------------------------------------------


def timing(recording: Recording) -> Figure:
    """How long ticks took and how old the neighbours' states were, over time and as distributions."""
    figure = new_figure(8.6, 5.6)
    panels = figure.subplots(2, 2, width_ratios=(1.6, 1.0))
    statuses = [robot.status for robot in recording.robots.values()]
    end = max(recording.end_s, 1e-3)
    ticks = [(s.t, s.tick_counts, s.tick_us) for s in statuses]
    ages = [(s.t, s.age_counts, s.ages_us) for s in statuses]
    rows = (
        ("Duration of a tick", "µs", 1.0, ticks, PALETTE[0]),
        ("Age of the neighbours' states", "ms", 1e3, ages, PALETTE[2]),
    )
    for (over_time, spread), (title, unit, scale, series, color) in zip(panels, rows, strict=True):
        over_time.set_title(title)
        over_time.set_ylabel(f"{title.split()[0].lower()} ({unit})")
        over_time.set_xlabel("fleet time (s)")
        over_time.set_xlim(0.0, end)
        spread.set_title("Distribution")
        spread.set_xlabel(f"{title.split()[0].lower()} ({unit})")
        spread.set_ylabel("share of all (%)")
        times = np.concatenate([np.repeat(t, counts) for t, counts, _ in series])
        values = np.concatenate([values for _, _, values in series]) / scale
        if recording.mode == "simulate" and unit == "µs":
            for axes in (over_time, spread):
                note(axes, "virtual time: ticks take none")
        elif not len(values):
            for axes in (over_time, spread):
                note(axes, "nothing was recorded")
        else:
            _draw_over_time(over_time, times, values, end, color)
            _draw_spread(spread, values, color, unit)
    return figure


def _draw_over_time(axes: Axes, times: Floats, values: Floats, end: float, color: str) -> None:
    """Median, 99th percentile and maximum in each of at most 60 bins of time."""
    width = max(end / 60, 0.2)
    bins = np.floor(times / width).astype(np.int64)
    inside = (times >= 0) & (times <= end)
    rows = []
    for number in np.unique(bins[inside]):
        chosen = values[inside & (bins == number)]
        rows.append((min((number + 0.5) * width, end), *np.percentile(chosen, (50, 99, 100))))
    if not rows:
        note(axes, "nothing was recorded during the drive")
        return
    middle, median, high, top = np.array(rows).T
    axes.fill_between(middle, median, high, color=color, alpha=0.18, linewidth=0)
    axes.plot(middle, top, ".", color=GREY, markersize=3.5, label="greatest")
    axes.plot(middle, high, color=color, linewidth=0.9, linestyle=(0, (4, 2)), label="99th percentile")
    axes.plot(middle, median, color=color, linewidth=1.5, label="median")
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
