"""Where the parts of a figure go: axes in a grid, what is written beside each, a legend above all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import FigureBase
from matplotlib.layout_engine import LayoutEngine
from matplotlib.transforms import Bbox

from handfast.agent.formation.points import Floats

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
