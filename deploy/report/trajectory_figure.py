"""The picture of a run's paths: Fig. 3 of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as PolygonPatch
from numpy.typing import NDArray

from handfast.agent.control.boundaries import Circle, Polygon, fence_of, obstacles_of
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.silence import SilentBody, bodies_of
from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.layout import POINTS_PER_INCH, Boxes, GridLayout, along, beside, text_size
from handfast.deploy.report.plotting import (
    DASHED,
    DOTTED,
    GREY,
    INK,
    LEGEND_MAX,
    PALETTE,
    RED,
    body_arrow,
    draw_boundary,
    new_figure,
    nth_color,
    nth_marker,
    top_of,
    view,
)
from handfast.deploy.verdict.run_result import RunResult

HALF_CORNERS: Final = 24
HATCH: Final = "////"
"""Of a body that is only believed to be there."""
_SAMPLES: Final = 100
"""Of each path, for labels to keep off it."""
_TIME_SIZE: Final = 8.0
_NAME_SIZE: Final = 7.0
_LEGEND_COLUMN_IN: Final = 2.3
_OUTSIDE: Final = 36.0
"""Room for a time beside a circle at the edge, points."""
_INSIDE_MAX: Final = 18.0
"""Circles of a larger diameter, points, are left open: they would hide where the path begins."""


class _Frame(NamedTuple):
    """The ground that is drawn: its corners (x, y) m, and points (1/72 inch) per metre."""

    low: Floats
    high: Floats
    points_per_m: float

    def points(self, places: Floats) -> Floats:
        """Places (..., 2) m in points from the lower left corner."""
        out: Floats = (places - self.low) * self.points_per_m
        return out


def trajectories(result: RunResult) -> Figure:
    """The paper's Fig. 3: paths, desired ones dotted, the formation at several times, and of each robot its
    number, and a circle of half the safe distance about its hand, at both ends, and its heading at the last.

    With what the fleet file puts in the way: obstacles grey, the geofence dashed.
    """
    fleet, a = result.fleet, result.analysis
    ground = [*obstacles_of(fleet), *([fence] if (fence := fence_of(fleet)) is not None else [])]
    few = len(a.ids) <= LEGEND_MAX
    silent = _not_heard(result)
    frame = _frame(a, ground, silent)
    span = (frame.high - frame.low) * frame.points_per_m / POINTS_PER_INCH
    figure = new_figure(max(span[0], 3.6) + 0.9, max(span[1], 1.6) + 1.3, GridLayout())
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.set_xlim(frame.low[0], frame.high[0])
    axes.set_ylim(frame.low[1], frame.high[1])
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")
    for boundary in ground:
        draw_boundary(axes, boundary)
    taken = [_name_box(frame, boundary) for boundary in obstacles_of(fleet)]
    moments = _moments(a)
    for shade, k in zip(np.linspace(0.25, 1.0, len(moments)), moments, strict=True):
        taken += _draw_formation(axes, frame, a, k, float(shade), few, taken)
    for index in range(len(a.ids)):
        width, alpha = (1.5, 1.0) if few else (0.7, 0.7)
        axes.plot(*a.desired[:, index].T, linestyle=DOTTED, color=GREY, linewidth=0.7 * width, zorder=2)
        axes.plot(*a.hands[:, index].T, color=nth_color(index), linewidth=width, alpha=alpha, zorder=3)
    _draw_ends(axes, frame, result, taken, moments)
    for k, body in enumerate(silent):
        _draw_body(axes, body, result.analysis.safe_m, "not heard, believed there" if k == 0 else "")
    _draw_legend(figure, axes, result)
    return figure


def _frame(a: Analysis, ground: Sequence[Circle | Polygon], silent: Sequence[SilentBody]) -> _Frame:
    everything = np.concatenate([a.hands.reshape(-1, 2), a.desired.reshape(-1, 2)])
    everything = everything[np.isfinite(everything).all(axis=1)]
    bodies = [end for body in silent for end in ((body.x, body.y), (body.to_x, body.to_y))]
    everything = np.concatenate([everything, np.array(bodies).reshape(-1, 2)])
    low, high = view(everything.min(axis=0), everything.max(axis=0), ground)
    margin = 0.06 * max(float((high - low).max()), 0.5)
    # Outermost are a circle and beside it the time.
    margin = max(margin, 0.5 * a.safe_m + _OUTSIDE / _scale(low - margin, high + margin))
    low, high = low - margin, high + margin
    return _Frame(low, high, _scale(low, high))


def _scale(low: Floats, high: Floats) -> float:
    """Points per metre at which all between these corners fits into the figure."""
    return POINTS_PER_INCH * float((np.array([8.0, 7.0]) / (high - low)).min())


def _name_box(frame: _Frame, obstacle: Circle | Polygon) -> tuple[Floats, Floats]:
    """Middle and size (2,), points, of the name of an obstacle."""
    size = np.array(text_size(obstacle.name, _NAME_SIZE))
    return frame.points(np.array(top_of(obstacle))) + np.array([0.0, 2.0 + 0.5 * size[1]]), size


def _draw_legend(figure: Figure, axes: Axes, result: RunResult) -> None:
    """Says what is drawn, and nothing that is not."""
    a = result.analysis
    few = len(a.ids) <= LEGEND_MAX
    seen, planned = (bool(np.isfinite(each).any()) for each in (a.hands, a.desired))
    if seen:
        axes.plot([], [], color=PALETTE[0] if few else GREY, linewidth=1.5, label="hand path")
    if planned:
        axes.plot([], [], linestyle=DOTTED, color=GREY, linewidth=1.2, label="desired path")
    if seen:
        arrow = body_arrow(np.zeros(2), 0.0, 0.0, 1.0).tolist()
        circle = "start; circles: half the safe distance"
        axes.plot([], [], "o", markerfacecolor="white", markeredgecolor=INK, markersize=7, label=circle)
        axes.plot([], [], linestyle="none", marker=arrow, color=INK, markersize=10, label="end, heading")
    if seen and planned:
        label = "formation at the time given"
        axes.plot([], [], "o-", color=INK, linewidth=1.2, markersize=4, label=label)
    if result.fleet.geofence is not None:
        axes.plot([], [], color=RED, linewidth=1.1, linestyle=DASHED, label="geofence")
    columns = max(int(figure.get_size_inches()[0] / _LEGEND_COLUMN_IN), 1)
    figure.legend(loc="outside upper left", ncols=columns, columnspacing=1.2, handlelength=1.8)


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
    axes.add_patch(
        PolygonPatch(outline, facecolor="none", edgecolor=RED, hatch=HATCH, zorder=6.5, label=label)
    )
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


def _draw_formation(
    axes: Axes,
    frame: _Frame,
    a: Analysis,
    k: int,
    shade: float,
    few: bool,
    taken: Sequence[tuple[Floats, Floats]],
) -> list[tuple[Floats, Floats]]:
    """The edges in force at one time of the grid, the robots on their way with their markers, and the time,
    beside texts that are there already; middle and size of its text, points."""
    # Of robots with a place alone: one in reserve, or that has left, is no part of the formation.
    places = np.where(np.isfinite(a.desired[k]), a.hands[k], np.nan)
    in_force = a.edges[np.isfinite(a.wanted[k])]
    lines = [places[edge] for edge in in_force if np.isfinite(places[edge]).all()]
    color = str(0.82 * (1.0 - shade) + 0.1)
    width = (1.3 if few else 0.7) * (0.7 if k == 0 else 1.0)
    style = (0, (4, 3)) if k == 0 else "solid"
    drawn = LineCollection(lines, colors=color, linewidths=width, linestyles=[style], zorder=4 + shade)
    axes.add_collection(drawn)
    known = np.isfinite(places).all(axis=1)
    if not known.any():
        return []
    if 0 < k < len(a.grid) - 1:  # both ends have circles and arrows
        if few:
            for index in np.flatnonzero(known).tolist():
                axes.plot(
                    *places[index], nth_marker(index), color=nth_color(index), markersize=6.5,
                    markeredgecolor="white", markeredgewidth=0.7, zorder=5 + shade,
                )  # fmt: skip
        else:
            axes.plot(*places.T, "o", color=color, markersize=2.2, zorder=5 + shade)
    aside = _aside(a, places[known])
    place = places[known][np.argmax(places[known] @ aside)]
    text = f"{round(float(a.grid[k]), 1):g} s"
    size = np.array(text_size(text, _TIME_SIZE))
    half = np.abs(aside) @ (0.5 * size)
    offset = aside * (max(10.0, 0.5 * a.safe_m * frame.points_per_m + 4.0) + half)
    start = frame.points(place)
    for _ in range(3 * len(taken)):  # by half its own size each
        if not any((np.abs(start + offset - middle) < 0.5 * (size + other)).all() for middle, other in taken):
            break
        offset = offset + aside * half
    axes.annotate(
        text, place, xytext=tuple(offset.tolist()), textcoords="offset points", ha="center", va="center",
        fontsize=_TIME_SIZE, color=INK, zorder=9,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.6},
    )  # fmt: skip
    return [(start + offset, size)]


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


# --- the ends of paths -----------------------------------------------------------------------


def _draw_ends(
    axes: Axes,
    frame: _Frame,
    result: RunResult,
    taken: Sequence[tuple[Floats, Floats]],
    moments: Sequence[int],
) -> None:
    """At both ends of every path a circle and the robot's number, at the last an arrow for its heading.

    `taken`: middles and sizes, points, of texts that are there already; `moments`: rows of the grid at which
    the formation is drawn.
    """
    a = result.analysis
    seen = np.flatnonzero(np.isfinite(a.hands[:, :, 0]).any(axis=0))
    if not len(seen):
        return
    few = len(a.ids) <= LEGEND_MAX
    known = np.isfinite(a.hands[:, seen, 0])
    first, last = known.argmax(axis=0), len(known) - 1 - known[::-1].argmax(axis=0)
    starts, ends = a.hands[first, seen], a.hands[last, seen]
    colors = [nth_color(index) for index in seen.tolist()]
    circle = a.safe_m * frame.points_per_m  # its diameter, points
    face = "white" if circle <= _INSIDE_MAX else "none"
    for places, filled, order in ((starts, face, 6.0), (ends, "none", 6.2)):
        circles = EllipseCollection(
            *([a.safe_m] * len(seen), [a.safe_m] * len(seen), [0.0] * len(seen)),
            units="xy", offsets=places, offset_transform=axes.transData, facecolors=filled, edgecolors=colors,
            linewidths=1.1 if few else 0.7, zorder=order,
        )  # fmt: skip
        axes.add_collection(circles)
    arrows = _arrows(frame, result, seen, last, few)
    axes.add_collection(PolyCollection(arrows, facecolors=colors, edgecolors="none", zorder=6.5))
    names = [str(a.ids[index]) for index in seen.tolist()]
    size = 8.0 if few else 5.5
    inner = min(size, 0.62 * circle)  # of the numbers in circles at the starts, where they can be read there
    fits = inner >= (6.0 if few else 4.5) and circle <= _INSIDE_MAX
    are_inside = fits and not _overlap(starts, 0.7 * a.safe_m)
    if are_inside:
        for name, place in zip(names, starts, strict=True):
            axes.annotate(
                name, place, ha="center", va="center_baseline", fontsize=inner, zorder=8, in_layout=False
            )
    else:
        axes.plot(*starts.T, ".", color=INK, markersize=3.0, zorder=6.1)
    named = [(names, ends)] if are_inside else [(names, ends), (names, starts)]
    texts = [text for group, _ in named for text in group]
    points = frame.points(np.concatenate([places for _, places in named]))
    sizes = np.array([text_size(text, size) for text in texts])
    circles_points = frame.points(np.concatenate([starts, ends]))
    boxes = Boxes(
        np.array([*(middle for middle, _ in taken), *circles_points]),
        np.array([*(each for _, each in taken), *np.full((len(circles_points), 2), 0.7 * circle)]),
    )
    ink = frame.points(_ink(a, arrows, moments, 4.0 / frame.points_per_m))
    middles = beside(points, sizes, max(0.5 * circle, 2.0) + 2.0, ink, boxes)
    for text, point, middle in zip(texts, points, middles, strict=True):
        axes.annotate(
            text, tuple((point / frame.points_per_m + frame.low).tolist()),
            xytext=tuple((middle - point).tolist()), textcoords="offset points", ha="center",
            va="center_baseline", fontsize=size, color=INK, zorder=8, in_layout=False,
            bbox={"boxstyle": "square,pad=0.05", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )  # fmt: skip


def _overlap(places: Floats, least_m: float) -> bool:
    """Whether two of these places (n, 2) m are nearer to each other than that."""
    return any(
        (np.hypot(*(places[k + 1 :] - place).T) < least_m).any() for k, place in enumerate(places[:-1])
    )


def _arrows(
    frame: _Frame, result: RunResult, seen: NDArray[np.int64], last: NDArray[np.int64], few: bool
) -> list[Floats]:
    """Outlines (4, 2) m of arrows at the ends (rows of the grid) of the paths of some robots (indexes)."""
    a, robots = result.analysis, list(result.recording.robots.values())
    offsets = [robot.hand_offset_m for robot in result.fleet.robots]
    size = (8.0 if few else 5.0) / frame.points_per_m
    return [
        body_arrow(a.hands[k, index], float(robots[index].heading(a.grid[[k]])[0]), offsets[index], size)
        for index, k in zip(seen.tolist(), last.tolist(), strict=True)
    ]


def _ink(a: Analysis, arrows: Sequence[Floats], moments: Sequence[int], step: float) -> Floats:
    """Samples (p, 2) m of what is drawn, about `step` m apart: paths, the formation at its times, arrows."""
    every = max(len(a.grid) // _SAMPLES, 1)
    sides = np.concatenate([np.stack([each, np.roll(each, 1, axis=0)], axis=1) for each in arrows])
    parts = [a.hands[::every].reshape(-1, 2), along(sides, step)]
    parts.extend(along(a.hands[k][a.edges[np.isfinite(a.wanted[k])]], step) for k in moments)
    ink = np.concatenate(parts)
    found: Floats = ink[np.isfinite(ink).all(axis=1)]
    return found
