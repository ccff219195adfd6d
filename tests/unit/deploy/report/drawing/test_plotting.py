"""What pictures share: what stands in the way, bodies, bands, markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.patches import Circle as RoundPatch
from matplotlib.patches import Polygon as CornerPatch

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.deploy.report.drawing.plotting import (
    Picture,
    body_arrow,
    draw_boundary,
    new_figure,
    nth_marked,
    quantiles,
    view,
    write,
)

LOW, HIGH = np.array([0.0, 0.0]), np.array([10.0, 4.0])
SQUARE = [(-1.0, -1.0), (11.0, -1.0), (11.0, 11.0), (-1.0, 11.0)]


def shown(*ground: Circle | Polygon) -> list[list[float]]:
    return [corner.tolist() for corner in view(LOW, HIGH, ground)]


def test_what_lies_by_the_paths_is_in_the_picture() -> None:
    assert shown() == [[0.0, 0.0], [10.0, 4.0]]
    assert shown(Circle("tree", 12.0, 5.0, 1.0)) == [[0.0, 0.0], [13.0, 6.0]]
    assert shown(Polygon("fence", SQUARE, inside=True)) == [[-1.0, -1.0], [11.0, 11.0]]
    assert shown(Circle("far", 20.0, 5.0, 1.0)) == [[0.0, 0.0], [10.0, 4.0]]
    assert shown(Polygon("shed", [(5.0, 8.9), (6.0, 8.8), (6.0, 9.2)])) == [[0.0, 0.0], [10.0, 4.0]]


def test_obstacles_are_filled_and_named_and_a_fence_is_a_dashed_line() -> None:
    axes = new_figure(3.0, 3.0).add_subplot()
    draw_boundary(axes, Circle("tree $x_1$", 2.0, 3.0, 0.5))
    draw_boundary(axes, Polygon("shed", [(6, 3), (9, 3), (9, 4), (7, 4), (7, 5.2), (6, 5.2)]))
    draw_boundary(axes, Polygon("geofence", SQUARE, inside=True))
    tree, shed, fence = axes.patches
    assert isinstance(tree, RoundPatch)
    assert (tree.center, tree.radius, tree.get_fill()) == ((2.0, 3.0), 0.5, True)
    assert isinstance(shed, CornerPatch)
    assert shed.get_fill()
    assert isinstance(fence, CornerPatch)
    assert not fence.get_fill()
    assert fence.get_linestyle() != "-"
    assert [(text.get_text(), tuple(text.xy)) for text in axes.texts] == [
        ("tree $x_1$", (2.0, 3.5)),
        ("shed", (6.5, 5.2)),
    ]
    assert not axes.texts[0].get_parse_math()


@pytest.mark.parametrize(("offset_m", "ahead"), [(0.2, False), (-0.2, True)])
def test_the_body_is_where_the_hand_point_has_it(offset_m: float, ahead: bool) -> None:
    corners = body_arrow(np.array([1.0, 2.0]), np.pi / 2, offset_m, 0.3)  # it heads north
    assert (corners[:, 1] >= 2.0 - 1e-9).all() if ahead else (corners[:, 1] <= 2.0 + 1e-9).all()
    assert np.isnan(body_arrow(np.array([1.0, 2.0]), np.nan, offset_m, 0.3)).all()


@given(st.lists(st.lists(st.floats(-1e3, 1e3) | st.just(float("nan")), min_size=5, max_size=5), min_size=1))
def test_bands_are_of_what_is_known(rows: list[list[float]]) -> None:
    shares = (0.0, 0.25, 0.5, 1.0)
    found = quantiles(np.array(rows), shares)
    for row, out in zip(rows, found, strict=True):
        known = [each for each in row if each == each]
        expected = np.quantile(known, shares) if known else [np.nan] * len(shares)
        assert out == pytest.approx(expected, nan_ok=True)


def test_markers_of_lines_that_lie_on_each_other_do_not() -> None:
    firsts = [nth_marked(index, 1000)["markevery"][0] for index in range(10)]
    assert np.diff(np.sort(firsts)).min() > 5
    assert nth_marked(0, 1)["markevery"] == (0, 1)
    looks = {(each["color"], each["marker"]) for each in (nth_marked(index, 9) for index in range(88))}
    assert len(looks) == 88


def test_a_picture_is_drawn_once_for_each_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a layout engine matplotlib draws all of it once more, unseen."""
    drawn = []

    def counted(figure: Figure, renderer: object) -> None:
        drawn.append(figure)
        Figure.draw(figure, renderer)  # type: ignore[arg-type]

    monkeypatch.setattr(Picture, "draw", counted)
    picture = new_figure(3.0, 3.0)
    picture.add_subplot().set_ylabel("length (m)")
    write(tmp_path / "one.png", lambda: picture)
    assert len(drawn) == 1
    write(tmp_path / "two.png", lambda: picture, [tmp_path / "two.svg", tmp_path / "two.pdf"])
    assert len(drawn) == 4
    assert (tmp_path / "two.png").read_bytes() == (tmp_path / "one.png").read_bytes()
