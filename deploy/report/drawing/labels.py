"""Words at what is drawn: labels at the ends of lines and beside points, so that none covers another.

Where they go is computed, in points (1/72 inch) or any other unit of length; nothing is measured by drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from handfast.agent.formation.points import Floats
from handfast.deploy.report.drawing.plotting import GREY, INK

POINTS_PER_INCH: Final = 72.0
FONT_SIZE: Final = 8.0
_LINE_HEIGHT: Final = 1.3
_CHARACTER_WIDTH: Final = 0.62
"""Of a digit of DejaVu Sans; both as a share of the size of the font."""
_DIRECTIONS: Final = 16
_RINGS: Final = (0.0, 0.7, 1.6)
"""How far from its point a label may go, in its own heights."""
_OVERLAP: Final = 1e4
_OUTER_RING: Final = 1.5
"""What a label over another, or one further from its point, is worth in samples of lines that it covers."""


def text_size(text: str, font_size: float) -> tuple[float, float]:
    """About how wide and high a text is, points."""
    lines = text.split("\n")
    return (
        _CHARACTER_WIDTH * font_size * max(map(len, lines)),
        _LINE_HEIGHT * font_size * len(lines),
    )


# --- along one axis --------------------------------------------------------------------------


def apart(wanted: Floats, heights: Floats, low: float, high: float) -> Floats:
    """Middles (n,) of labels of these heights: as near as can be to the wanted ones in least squares, in
    their order, between `low` and `high`, none over another.

    With more labels than there is room for each takes up its share of the room, and they touch or overlap.
    """
    order = np.argsort(wanted, kind="stable")
    sizes = heights[order]
    sizes = sizes * min(1.0, (high - low) / max(float(sizes.sum()), 1e-12))
    # Over the others' heights the middles must not fall: isotonic regression, by pooling adjacent violators.
    stacked = np.cumsum(sizes) - 0.5 * sizes
    pools: list[tuple[float, int]] = []
    for base in (wanted[order] - stacked).tolist():
        total, count = base, 1
        while pools and pools[-1][0] * count >= total * pools[-1][1]:
            before, more = pools.pop()
            total, count = total + before, count + more
        pools.append((total, count))
    bases = np.repeat([total / count for total, count in pools], [count for _, count in pools])
    out = np.empty(len(order))
    out[order] = np.clip(bases, low, max(high - float(sizes.sum()), low)) + stacked
    return out


class EndLabel(NamedTuple):
    """A label at the end of a line: `x`, `y` in data; `marker` as of matplotlib, "" for none."""

    text: str
    x: float
    y: float
    color: str
    marker: str = ""


def label_ends(axes: Axes, labels: Sequence[EndLabel], height: float) -> None:
    """Writes labels to the right of axes whose limits are set, `height` inches high at least.

    Each is joined with the end of its line; one of a line that leaves the axes has an arrow. Beside a marker,
    which has the line's colour, the text is black, for it to be read.
    """
    if not labels:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    places = np.array([(each.x, each.y) for each in labels])
    ends = (places - (left, bottom)) / (right - left, top - bottom)
    inside = np.clip(ends, 0.0, 1.0)
    texts = [
        each.text + (" ↑" if y > 1.0 else " ↓" if y < 0.0 else "")
        for each, y in zip(labels, ends[:, 1].tolist(), strict=True)
    ]
    heights = np.array([text_size(text, FONT_SIZE)[1] for text in texts]) / (POINTS_PER_INCH * height)
    # Lines that end at one place to the eye have their labels in the order given, from above.
    seen = _together(inside[::-1, 1], 1.0 / (POINTS_PER_INCH * height))
    middles = apart(seen, heights[::-1], -0.02, 1.02)[::-1]
    at_axes: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False, "zorder": 6}
    lines = [[end, (1.022, middle)] for end, middle in zip(inside.tolist(), middles.tolist(), strict=True)]
    axes.add_collection(
        LineCollection(lines, colors=GREY, linewidths=0.5, alpha=0.7, **at_axes), autolim=False
    )
    for each, text, middle in zip(labels, texts, middles.tolist(), strict=True):
        if each.marker:
            axes.plot(1.032, middle, each.marker, color=each.color, markersize=4.5, **at_axes)
        axes.text(
            1.048 if each.marker else 1.028, middle, text, color=INK if each.marker else each.color,
            fontsize=FONT_SIZE, va="center", linespacing=1.0, parse_math=False, **at_axes,
        )  # fmt: skip


def _together(values: Floats, gap: float) -> Floats:
    """The same values (n,), those that follow each other within `gap` as their mean."""
    order = np.argsort(values, kind="stable")
    out = np.empty_like(values)
    for group in np.split(order, np.flatnonzero(np.diff(values[order]) > gap) + 1):
        out[group] = values[group].mean()
    return out


# --- in the plane ----------------------------------------------------------------------------


class Boxes(NamedTuple):
    """Boxes (n, 2): their middles, and their whole widths and heights."""

    middles: Floats
    sizes: Floats


def beside(points: Floats, sizes: Floats, reach: float, ink: Floats, taken: Boxes) -> Floats:
    """Middles (n, 2) of labels of these sizes (n, 2), each `reach` or a little more from its point (n, 2).

    One after the other they go where they cover none of the boxes that are taken, none before them, and least
    of the `ink` (p, 2), samples of the lines that are drawn.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    ways = np.column_stack([np.cos(angles), np.sin(angles)])
    middles, boxes = [*taken.middles], [*taken.sizes]
    out = np.empty_like(points)
    for index, (point, size) in enumerate(zip(points, sizes, strict=True)):
        near = ink[(np.abs(ink - point) < reach + size.sum() + _RINGS[-1] * size[1]).all(axis=1)]
        half = np.abs(ways) @ (0.5 * size)  # from the middle to the edge of the box, about, each way
        tried = np.concatenate([point + ways * (reach + half + ring * size[1])[:, None] for ring in _RINGS])
        covered = (np.abs(near[None] - tried[:, None]) < 0.5 * size).all(axis=2).sum(axis=1)
        cost = covered + np.repeat(_OUTER_RING * np.arange(len(_RINGS)), _DIRECTIONS)
        if middles:
            gaps = np.abs(np.array(middles)[None] - tried[:, None])
            over = (gaps < 0.5 * (np.array(boxes)[None] + size)).all(axis=2)
            cost = cost + _OVERLAP * over.sum(axis=1)
        out[index] = tried[int(cost.argmin())]
        middles.append(out[index])
        boxes.append(size)
    return out


def along(lines: Floats, step: float) -> Floats:
    """Samples (p, 2) of straight lines (m, 2, 2), at most `step` apart on the longest; NaN are left out."""
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    if not len(lines):
        return np.empty((0, 2))
    longest = float(np.hypot(*(lines[:, 1] - lines[:, 0]).T).max())
    share = np.linspace(0.0, 1.0, int(min(longest / step, 200.0)) + 2)[None, :, None]
    out: Floats = (lines[:, :1] * (1.0 - share) + lines[:, 1:] * share).reshape(-1, 2)
    return out
