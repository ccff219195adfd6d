"""What stands in the way, in pictures."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Circle as RoundPatch
from matplotlib.patches import Polygon as CornerPatch

from agent.control.boundaries import Circle, Polygon
from deploy.report.plotting import draw_boundary, new_figure, view

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
