"""Labels stay apart, and near what they name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.text import Text

from handfast.deploy.report.drawing.labels import Boxes, EndLabel, along, apart, beside, label_ends, text_size
from handfast.deploy.report.drawing.plotting import INK, new_figure

NOWHERE = Boxes(np.empty((0, 2)), np.empty((0, 2)))
wants = st.lists(
    st.tuples(st.floats(-1.0, 2.0), st.floats(0.01, 0.2)).map(lambda each: (round(each[0], 3), each[1])),
    min_size=1,
    max_size=12,
)


@given(wants)
def test_labels_at_lines_are_apart_in_order_and_inside(given: list[tuple[float, float]]) -> None:
    wanted, heights = (np.array(each) for each in zip(*given, strict=True))
    middles = apart(wanted, heights, 0.0, 1.0)
    order = np.argsort(wanted, kind="stable")
    fit = min(1.0, 1.0 / heights.sum())  # of more than there is room for each is as much smaller
    low, high = (middles - 0.5 * fit * heights)[order], (middles + 0.5 * fit * heights)[order]
    assert (low[1:] >= high[:-1] - 1e-9).all()
    assert low[0] >= -1e-9
    assert high[-1] <= 1.0 + 1e-9


@given(wants)
def test_none_could_be_nearer_to_its_line(given: list[tuple[float, float]]) -> None:
    """Of labels that touch one another alone, the middle of what they want is the middle of what they get."""
    wanted, heights = (np.array(each) for each in zip(*given, strict=True))
    middles = apart(wanted, heights, -50.0, 50.0)
    order = np.argsort(wanted, kind="stable")
    middles, wanted, heights = middles[order], wanted[order], heights[order]
    gaps = np.diff(middles) - 0.5 * (heights[1:] + heights[:-1])
    for group in np.split(np.arange(len(middles)), np.flatnonzero(gaps > 1e-9) + 1):
        assert middles[group].mean() == pytest.approx(wanted[group].mean())


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=30, unique=True))
def test_labels_beside_points_cover_no_label_and_not_their_point(places: list[tuple[int, int]]) -> None:
    points = 40.0 * np.array(places)
    sizes = np.array([text_size(str(number), 5.5) for number in range(len(places))])
    middles = beside(points, sizes, 6.0, points, NOWHERE)
    gaps = np.abs(middles[:, None] - middles) - 0.5 * (sizes[:, None] + sizes)
    over = (gaps < -1e-9).all(axis=2)
    assert not over[~np.eye(len(places), dtype=bool)].any()
    nearest = np.maximum(np.abs(middles - points) - 0.5 * sizes, 0.0)
    assert (np.hypot(*nearest.T) >= 6.0 - 1e-9).all()
    assert (np.hypot(*nearest.T) < 20.0).all()


def test_a_label_goes_where_it_covers_no_line_and_nothing_that_is_taken() -> None:
    point, size = np.array([[0.0, 0.0]]), np.array([[8.0, 6.0]])
    to_the_east = along(np.array([[[0.0, 0.0], [30.0, 0.0]]]), 1.0)
    (free,) = beside(point, size, 3.0, np.empty((0, 2)), NOWHERE)
    assert free == pytest.approx([7.0, 0.0])
    (off_line,) = beside(point, size, 3.0, to_the_east, NOWHERE)
    assert abs(off_line[1]) >= 3.0
    taken = Boxes(np.array([[10.0, 10.0], [10.0, -10.0]]), np.full((2, 2), 19.0))
    (aside,) = beside(point, size, 3.0, to_the_east, taken)
    assert aside[0] < 0.0


def test_samples_of_lines_leave_out_what_is_not_known() -> None:
    lines = np.array([[[0.0, 0.0], [3.0, 0.0]], [[np.nan, 0.0], [1.0, 1.0]]])
    samples = along(lines, 1.0)
    assert (samples[:, 1] == 0.0).all()
    assert np.diff(np.sort(samples[:, 0])).max() <= 1.0
    assert along(lines[1:], 1.0).shape == (0, 2)


def test_labels_at_the_ends_are_in_the_order_given_and_say_which_line_leaves_the_picture() -> None:
    axes = new_figure(5.0, 3.0).add_subplot()
    axes.set_xlim(0.0, 10.0)
    axes.set_ylim(0.0, 2.0)
    ends = [("high", 5.0), ("a", 1.0), ("b", 1.001), ("c", 1.0), ("low", -1.0)]
    label_ends(axes, [EndLabel(name, 10.0, y, "red", "o") for name, y in ends], 2.0)
    label_ends(axes, [], 2.0)
    texts: list[Text] = axes.texts
    assert [text.get_text() for text in texts] == ["high ↑", "a", "b", "c", "low ↓"]
    heights = [text.get_position()[1] for text in texts]
    assert heights == sorted(heights, reverse=True)
    assert np.diff(heights).max() <= -text_size("a", 8.0)[1] / 144.0 + 1e-9
    assert {text.get_color() for text in texts} == {INK}
    assert [line.get_color() for line in axes.lines] == ["red"] * 5
