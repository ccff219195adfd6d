"""Axes and what is written beside them: nothing is cut off, nothing lies on another."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from handfast.deploy.report import figures
from handfast.deploy.report.drawing.layout import GridLayout
from handfast.deploy.report.drawing.plotting import new_figure, styled
from tests.unit.deploy.playback.runs import result_of
from tests.unit.deploy.synthetic_run import make_fleet, triangle

PIXELS = 1.5
"""So far a letter may hang over the box that its font gives it."""


@pytest.fixture(autouse=True)
def style() -> Iterator[None]:
    with styled():
        yield


def grid(rows: int = 1, columns: int = 1, **of_subplots: object) -> tuple[Figure, list[Axes]]:
    figure = new_figure(6.0, 4.0, GridLayout())
    return figure, figure.subplots(rows, columns, squeeze=False, **of_subplots).ravel().tolist()


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


def places(axes: Axes) -> list[float]:
    return [round(float(each), 3) for each in axes.get_position().extents]


@pytest.mark.parametrize("robots", [3, 6, 45])
def test_all_of_a_report_has_its_place(robots: int) -> None:
    rows = {3: 2, 6: 3, 45: 9}[robots]
    result = result_of(make_fleet(*triangle(rows), velocity=(1.0, 0.5), duration_s=2.0, rate_hz=10))
    for name in ("trajectories", "distances", "forces", "timing"):
        assert is_well(figures.figure(result, name)), name


def test_long_words_and_long_numbers_have_room() -> None:
    figure, panels = grid(2, 2)
    first, second, third, fourth = panels
    first.set_ylim(-123456.0, 123456.0)
    first.set_title("one")
    first.set_ylabel("two lines\nof a label")
    second.text(1.03, 0.5, "at the end of a line", transform=second.transAxes)
    third.set_xlabel("time (s)")
    fourth.annotate("below", (0.5, 0.0), xytext=(0, -40), textcoords="offset points", va="top")
    second.plot([], [], label="robot 1")
    figure.legend(loc="outside upper left")
    assert is_well(figure)


def test_a_number_too_long_to_be_written_in_full_has_room() -> None:
    figure, (axes,) = grid()
    axes.set_ylim(5e6, 5.00001e6)
    assert is_well(figure)


def test_axes_are_of_one_height_and_width_whatever_is_beside_them_or_as_their_shares_say() -> None:
    figure, panels = grid(2, 2, width_ratios=(3, 1), height_ratios=(1, 2))
    panels[0].set_ylabel("a label")
    panels[3].set_xlabel("another")
    figure.canvas.draw()
    sizes = np.array([axes.get_position().size for axes in panels])
    assert sizes[:, 0] == pytest.approx(sizes[0, 0] * np.array([1, 1 / 3, 1, 1 / 3]))
    assert sizes[:, 1] == pytest.approx(sizes[0, 1] * np.array([1, 1, 2, 2]))


def test_places_do_not_go_by_what_was_drawn_before() -> None:
    figure, panels = grid(1, 2)
    panels[0].text(1.03, 0.5, "at the end of a line", transform=panels[0].transAxes)
    figure.canvas.draw()
    once = [places(axes) for axes in panels]
    figure.canvas.draw()
    assert [places(axes) for axes in panels] == once


def test_axes_of_equal_scales_keep_them() -> None:
    figure, (axes,) = grid()
    axes.set_aspect("equal")
    axes.set_xlim(0.0, 10.0)
    axes.set_ylim(0.0, 30.0)
    assert is_well(figure)
    box = axes.get_window_extent()
    assert box.height == pytest.approx(3 * box.width)
    # As high as the figure lets them: 4 inches, but for the numbers below.
    assert box.height > 3.6 * figure.dpi


def test_a_figure_too_small_for_its_words_has_axes_all_the_same() -> None:
    figure = new_figure(0.6, 0.5, GridLayout())
    axes = figure.add_subplot()
    axes.set_ylabel("far too long for so small a figure")
    figure.canvas.draw()
    assert axes.get_position().width > 0.0
    assert axes.get_position().height > 0.0


def test_a_figure_without_axes_or_with_axes_elsewhere_is_left_as_it_is() -> None:
    new_figure(1.0, 1.0, GridLayout()).canvas.draw()
    figure = new_figure(1.0, 1.0, GridLayout())
    axes = figure.add_axes((0.1, 0.2, 0.3, 0.4))
    figure.canvas.draw()
    assert places(axes) == [0.1, 0.2, 0.4, 0.6]
