"""What pictures share: what stands in the way, bodies, bands, markers."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle as RoundPatch
from matplotlib.patches import Polygon as CornerPatch

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.deploy.report.plotting import (
    Picture,
    draw_boundary,
    new_figure,
    write,
)

SQUARE = [(-1.0, -1.0), (11.0, -1.0), (11.0, 11.0), (-1.0, 11.0)]


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


@pytest.mark.slow
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
