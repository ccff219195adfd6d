"""Axes and what is written beside them: nothing is cut off, nothing lies on another."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import pytest
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from handfast.deploy.report import figures
from handfast.deploy.report.plotting import styled
from tests.unit.deploy.playback.runs import result_of
from tests.unit.deploy.synthetic_run import make_fleet, triangle

PIXELS = 1.5
"""So far a letter may hang over the box that its font gives it."""


@pytest.fixture(autouse=True)
def style() -> Iterator[None]:
    with styled():
        yield


def boxes(figure: Figure) -> list[Bbox]:
    """What each of the axes takes with all beside it, and the legends; after a drawing."""
    figure.canvas.draw()
    legends = [legend.get_window_extent() for legend in figure.legends]
    found = [axes.get_tightbbox() for axes in figure.axes]
    return [*legends, *(box for box in found if box is not None)]


def is_well(figure: Figure) -> bool:
    """Whether nothing goes over the figure's edge, or lies on what is another's."""
    found, whole = boxes(figure), figure.bbox.padded(PIXELS)
    inside = all(Bbox.intersection(box, whole).bounds == box.bounds for box in found)  # type: ignore[union-attr]
    return inside and not any(one.padded(-PIXELS).overlaps(other) for one, other in combinations(found, 2))


@pytest.mark.parametrize("robots", [3, 6, 45])
def test_all_of_a_report_has_its_place(robots: int) -> None:
    rows = {3: 2, 6: 3, 45: 9}[robots]
    result = result_of(make_fleet(*triangle(rows), velocity=(1.0, 0.5), duration_s=2.0, rate_hz=10))
    for name in ("trajectories", "distances", "forces", "timing"):
        assert is_well(figures.figure(result, name)), name
