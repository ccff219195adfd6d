"""Layout of figures: labels that do not cover each other, axes in a grid, and a legend above them.

Label positions are computed in points (1/72 inch) or any other unit of length, without drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection
from matplotlib.figure import FigureBase
from matplotlib.layout_engine import LayoutEngine
from matplotlib.transforms import Bbox

from handfast.agent.formation.points import Floats
from handfast.deploy.report.plotting import GREY, INK

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


_PAD_IN: Final = 0.042
"""About each axes with what is beside it, and above a legend."""
_TITLE_IN: Final = 0.24
"""A title of one line, with its distance from the axes."""
_ACROSS_IN: Final = (0.55, 0.15)
_ALONG_IN: Final = (0.45, 0.1)
"""What is left and right of most axes, and below and above, to measure at nearly the right size."""
_LEAST: Final = 0.1
"""Of a figure, for its axes, whatever is beside them."""
_X, _Y = 0, 1


class GridLayout(LayoutEngine):
    """As matplotlib's "constrained", in a fifth of its time: what is beside axes is measured once, not twice,
    and nothing else.

    First above and below, then, at the height that follows, beside: ticks on a higher axis may be others.
    """

    _adjust_compatible = True
    _colorbar_gridspec = False

    def execute(self, fig: FigureBase) -> None:
        """Give each axes of a grid its place."""
        figure = fig.get_figure(root=True)
        panels = [axes for axes in figure.axes if axes.get_subplotspec() is not None]
        if not panels:
            return
        renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
        size_in = figure.get_size_inches()
        legends = [legend.get_window_extent(renderer).height / figure.dpi for legend in figure.legends]
        free_in = size_in - (0.0, sum(legends) + _PAD_IN * len(legends))
        beside = np.zeros((len(panels), 2, 2))
        _place(panels, np.add(beside, [_ACROSS_IN, _ALONG_IN]), free_in, size_in)
        for row, axes in zip(beside, panels, strict=True):
            row[:] = _outside(axes, [_box_of(axes.xaxis, renderer)], figure.dpi)
            if axes.get_title(loc="left"):
                row[_Y, 1] = max(row[_Y, 1], _TITLE_IN)
        _place(panels, np.maximum(beside, [_ACROSS_IN, (0.0, 0.0)]), free_in, size_in)
        for row, axes in zip(beside, panels, strict=True):
            texts = [text.get_window_extent(renderer) for text in axes.texts if text.get_in_layout()]
            found = _outside(axes, [_box_of(axes.yaxis, renderer), *texts], figure.dpi)
            np.maximum(row, found, out=row)
        _place(panels, beside, free_in, size_in)


def _box_of(axis: Axis, renderer: object) -> Bbox | None:
    return axis.get_tightbbox(renderer, for_layout_only=True)  # type: ignore[arg-type]


def _outside(axes: Axes, boxes: Sequence[Bbox | None], dpi: float) -> Floats:
    """How far these boxes go beyond axes (2, 2), inches: left, right; below, above."""
    inner = axes.bbox
    out = np.zeros((2, 2))
    for box in boxes:
        if box is not None and np.isfinite(box.extents).all():
            beyond = [(inner.x0 - box.x0, box.x1 - inner.x1), (inner.y0 - box.y0, box.y1 - inner.y1)]
            np.maximum(out, beyond, out=out)
    return out / dpi


def _place(panels: Sequence[Axes], beside: Floats, free_in: Floats, size_in: Floats) -> None:
    """Gives each of the axes its place in a grid, with room for what is `beside` each (n, 2, 2): in the lower
    left `free_in` (2,) of a figure of `size_in` (2,) inches."""
    specs = [axes.get_subplotspec() for axes in panels]
    lows, highs = np.empty((len(panels), 2)), np.empty((len(panels), 2))
    for way in (_X, _Y):
        spans = [spec.colspan if way == _X else spec.rowspan for spec in specs if spec is not None]
        grid = next(spec.get_gridspec() for spec in specs if spec is not None)
        ratios = np.array(grid.get_width_ratios() if way == _X else grid.get_height_ratios(), float)
        before, after = np.zeros(len(ratios)), np.zeros(len(ratios))
        # Rows are counted from above, inches from below.
        cells = [span.start if way == _X else len(ratios) - 1 - span.start for span in spans]
        if way == _Y:
            ratios = ratios[::-1]
        np.maximum.at(before, cells, beside[:, way, 0] + _PAD_IN)
        np.maximum.at(after, cells, beside[:, way, 1] + _PAD_IN)
        free = max(float(free_in[way] - before.sum() - after.sum()), _LEAST * float(size_in[way]))
        inner = free * ratios / ratios.sum()
        begins = np.cumsum(before) + np.concatenate([[0.0], np.cumsum(inner + after)[:-1]])
        lows[:, way], highs[:, way] = begins[cells], (begins + inner)[cells]
    for axes, low, high in zip(panels, lows / size_in, highs / size_in, strict=True):
        axes.set_position(Bbox([low, high]))
        axes.set_in_layout(True)  # which setting a position ends
        axes.apply_aspect()
