"""Paths: who is where at their ends, and which way it looks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.text import Annotation

from handfast.deploy.report.figures import figure
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import result_of
from tests.unit.deploy.synthetic_run import in_formation, make_fleet, standing, triangle

SAFE_M = 0.22


def run(rows: int) -> RunResult:
    return result_of(make_fleet(*triangle(rows), velocity=(1.0, 0.5), duration_s=4.0, rate_hz=10))


@pytest.mark.parametrize("rows", [2, 9])
def test_every_path_has_circles_a_number_and_an_arrow_at_its_end(rows: int) -> None:
    result = run(rows)
    a = result.analysis
    n = len(a.ids)
    (axes,) = figure(result, "trajectories").axes
    starts, ends = (each for each in axes.collections if isinstance(each, EllipseCollection))
    assert np.asarray(starts.get_offsets()) == pytest.approx(a.hands[0])
    assert np.asarray(ends.get_offsets()) == pytest.approx(a.hands[-1])
    for circles in (starts, ends):
        assert 2 * circles._widths == pytest.approx(SAFE_M)  # type: ignore[attr-defined]
    (arrows,) = (each for each in axes.collections if isinstance(each, PolyCollection))
    for path, robot, hand in zip(
        arrows.get_paths(), result.recording.robots.values(), a.hands[-1], strict=True
    ):
        tip, _, tail, *_ = np.asarray(path.vertices)
        assert tip == pytest.approx(hand)
        heading = float(robot.heading(a.grid[-1:])[0])
        assert np.arctan2(*(tip - tail)[::-1]) == pytest.approx(np.arctan2(np.sin(heading), np.cos(heading)))
    numbers = [text.get_text() for text in axes.texts if text.get_text().isdigit()]
    assert sorted(map(int, numbers)) == sorted(2 * a.ids)
    assert len(numbers) == 2 * n


def test_no_number_of_forty_five_covers_another() -> None:
    fleet = make_fleet(*triangle(9), velocity=(1.0, 0.5), duration_s=4.0, rate_hz=10)
    picture = figure(result_of(fleet, in_formation(fleet, 0.45, calm_s=0.5)), "trajectories")
    picture.canvas.draw()
    (axes,) = picture.axes
    numbers = [text for text in axes.texts if isinstance(text, Annotation) and text.get_text().isdigit()]
    boxes = [text.get_window_extent() for text in numbers]
    over = [(i, j) for i, one in enumerate(boxes) for j, other in enumerate(boxes[:i]) if one.overlaps(other)]
    assert not over


def test_times_of_a_formation_that_stands_do_not_cover_each_other() -> None:
    fleet = make_fleet(*triangle(2), duration_s=0.3, rate_hz=20)
    picture = figure(result_of(fleet, in_formation(fleet, 0.0)), "trajectories")
    picture.canvas.draw()
    (axes,) = picture.axes
    first, last = (text for text in axes.texts if text.get_text().endswith(" s"))
    assert not first.get_window_extent().overlaps(last.get_window_extent())


def test_robots_on_their_way_are_told_apart_without_colours() -> None:
    result = run(2)
    (axes,) = figure(result, "trajectories").axes
    marks = [line.get_marker() for line in axes.lines if line.get_markeredgecolor() == "white"]
    assert len(set(marks)) == 3
    assert len(marks) % 3 == 0
    assert marks


def test_the_legend_names_what_is_drawn_alone() -> None:
    def legend(result: RunResult) -> list[str]:
        (found,) = figure(result, "trajectories").legends
        return [text.get_text() for text in found.get_texts()]

    assert "geofence" not in legend(run(2))
    assert "desired path" in legend(run(2))
    assert len(legend(run(9))) == len(legend(run(2)))


def test_circles_that_are_large_are_open_and_all_in_the_picture() -> None:
    """They would hide where the path begins."""
    result = result_of(make_fleet([(0.0, 0.0), (0.4, 0.0)], [(1, 2)]), [standing(0, 0), standing(0.4, 0.0)])
    (axes,) = figure(result, "trajectories").axes
    starts, _ = (each for each in axes.collections if isinstance(each, EllipseCollection))
    assert np.asarray(starts.get_facecolor()).size == 0 or np.asarray(starts.get_facecolor())[:, 3].max() == 0
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    hands = result.analysis.hands[0]
    assert (hands - 0.5 * SAFE_M > limits[:, 0]).all()
    assert (hands + 0.5 * SAFE_M < limits[:, 1]).all()
    assert all(low < high for low, high in pairwise(axes.get_xticks()))
