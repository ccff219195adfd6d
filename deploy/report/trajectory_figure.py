"""The picture of a run's paths: Fig. 3 of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from agent.control.boundaries import fence_of, obstacles_of
from agent.formation.points import Floats
from deploy.analysis.analysis import Analysis
from deploy.analysis.silent_bodies import SilentBody, bodies_of
from deploy.recording.recording import Recording
from deploy.report.plotting import (
    DASHED,
    DOTTED,
    GREY,
    INK,
    LEGEND_MAX,
    PALETTE,
    RED,
    draw_boundary,
    new_figure,
    nth_color,
    view,
)
from deploy.verdict.run_result import RunResult

HALF_CORNERS: Final = 24
HATCH: Final = "////"
"""Of a body that is only believed to be there."""


def trajectories(result: RunResult) -> Figure:
    """The paper's Fig. 3: paths, desired ones dotted, starts as circles, the formation at several times.

    With what the fleet file puts in the way: obstacles grey, the geofence dashed.
    """
    fleet, a = result.fleet, result.analysis
    ground = [*obstacles_of(fleet), *([fence] if (fence := fence_of(fleet)) is not None else [])]
    few = len(a.ids) <= LEGEND_MAX
    everything = np.concatenate([a.hands.reshape(-1, 2), a.desired.reshape(-1, 2)])
    everything = everything[np.isfinite(everything).all(axis=1)]
    silent = _not_heard(result)
    bodies = [end for body in silent for end in ((body.x, body.y), (body.to_x, body.to_y))]
    everything = np.concatenate([everything, np.array(bodies).reshape(-1, 2)])
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
    for index in range(len(a.ids)):
        color = nth_color(index)
        width, alpha = (1.5, 1.0) if few else (0.7, 0.75)
        axes.plot(*a.desired[:, index].T, linestyle=DOTTED, color=GREY, linewidth=0.7 * width, zorder=2)
        axes.plot(*a.hands[:, index].T, color=color, linewidth=width, alpha=alpha, zorder=3)
    _draw_starts(axes, a.ids, a, few)
    for k, body in enumerate(silent):
        _draw_body(axes, body, result.analysis.safe_m, "not heard, believed there" if k == 0 else "")
    path_color = PALETTE[0] if few else GREY
    axes.plot([], [], color=path_color, linewidth=1.5, label="hand path")
    axes.plot([], [], linestyle=DOTTED, color=GREY, linewidth=1.2, label="desired path")
    axes.plot([], [], "o", markerfacecolor="white", markeredgecolor=INK, markersize=6, label="start")
    axes.plot([], [], "o-", color=INK, linewidth=1.2, markersize=4, label="formation at the time given")
    if fleet.geofence is not None:
        axes.plot([], [], color=RED, linewidth=1.1, linestyle=DASHED, label="geofence")
    figure.legend(loc="outside upper left", ncols=4, columnspacing=1.2, handlelength=1.8)
    return figure


def silent_bodies(recording: Recording) -> list[SilentBody]:
    """The robots that somebody did not hear at the end."""
    mission = recording.mission
    return bodies_of(recording.beacons, mission.removed if mission else ())


def _not_heard(result: RunResult) -> list[SilentBody]:
    """The robots that nobody heard at the end."""
    return [body for body in silent_bodies(result.recording) if not body.heard]


def _draw_body(axes: Axes, body: SilentBody, safe_m: float, label: str) -> None:
    """A body where it is believed to be, as large as it and what is not known of its place."""
    radius = 0.5 * safe_m + body.doubt_m
    turn = np.linspace(0.5, 1.5, HALF_CORNERS) * np.pi + np.arctan2(body.to_y - body.y, body.to_x - body.x)
    back = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    outline = np.concatenate([np.array([body.x, body.y]) + back, np.array([body.to_x, body.to_y]) - back])
    axes.add_patch(Polygon(outline, facecolor="none", edgecolor=RED, hatch=HATCH, zorder=6.5, label=label))
    x, y = min((body.x, body.y), (body.to_x, body.to_y), key=itemgetter(1))
    axes.annotate(
        f"{body.robot}: silent {body.how_long}", (x, y - radius), xytext=(0, -3),
        textcoords="offset points", ha="center", va="top", fontsize=8, color=RED, zorder=9,
    )  # fmt: skip


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
