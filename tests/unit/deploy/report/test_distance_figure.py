"""Distances: which pairs are drawn, and what is written at their lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handfast.agent.fleet.model import Fleet
from handfast.deploy.report.distance_figure import (
    NAMED_MAX,
    THIN_MAX,
    Line,
    _beside_closest,
    distances,
    near_edges,
    near_strangers,
)
from handfast.deploy.report.drawing.plotting import GREY
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import result_of
from tests.unit.deploy.synthetic_run import Path, make_fleet, standing, triangle

SAFE_M = 0.22
LEVER_M = 0.1


def meeting(*least_m: float) -> RunResult:
    """A run of one edge of 1 m, and of pairs of robots without an edge, far from the others, which meet at
    1 s at these distances."""
    places = [(0.0, 0.0), (1.0, 0.0)]
    paths: list[Path] = [standing(-LEVER_M, 0.0), standing(1.0 - LEVER_M, 0.0)]

    def passing(y: float, beside: float, speed: float) -> Path:
        return lambda t: (speed * (t - 1.0) - LEVER_M, y + beside, 0.0)

    for number, least in enumerate(least_m, start=1):
        places += [(0.0, 20.0 * number), (0.0, 20.0 * number + least)]
        paths += [passing(20.0 * number, 0.0, 1.0), passing(20.0 * number, least, -1.0)]
    return result_of(make_fleet(places, [(1, 2)]), paths)


def pairs(lines: list[Line], result: RunResult) -> list[tuple[int, ...]]:
    return [tuple(result.analysis.ids[each] for each in line.pair) for line in lines]


def words(result: RunResult) -> list[str]:
    (axes,) = distances(result).axes
    return [text.get_text() for text in axes.texts]


def test_pairs_without_an_edge_that_came_near_are_drawn_nearest_first() -> None:
    result = meeting(0.5, 1.49 * SAFE_M, 1.51 * SAFE_M, 0.1)
    lines, further = near_strangers(result.analysis)
    assert pairs(lines, result) == [(9, 10), (5, 6)]
    assert further == 0
    assert [line.least() for line in lines] == pytest.approx([0.1, 1.49 * SAFE_M], abs=1e-6)
    texts = words(result)
    assert "1–2" in texts
    # Where both are 2 m apart at the end the axes, made for the edge, may end before.
    assert {text.removesuffix(" ↑") for text in texts if "no edge" in text} == {
        "9–10, no edge",
        "5–6, no edge",
    }
    assert f"safe distance\n{SAFE_M} m" in texts
    assert "wanted 1 m\n(±5 %)" in texts
    assert any(text.startswith("closest: 0.100 m (9–10, 1.0 s)") for text in texts)


def test_the_closest_pair_is_drawn_however_far_apart() -> None:
    assert pairs(near_strangers(meeting(0.6).analysis)[0], meeting(0.6)) == [(3, 4)]
    assert near_strangers(meeting(1.2).analysis)[0] == []  # robots with an edge were closer
    alone = result_of(make_fleet([(0.0, 0.0), (3.0, 0.0)], []))
    assert "1–2, no edge" in words(alone)


def test_while_a_pair_has_an_edge_it_is_no_pair_without() -> None:
    result = meeting(0.1)
    a = result.analysis
    edges, wanted = np.array([[0, 1], [2, 3]]), np.full((len(a.grid), 2), 1.0)
    wanted[: len(a.grid) // 4, 1] = np.nan  # before they meet
    apart = np.abs(np.hypot(*(a.hands[:, 2] - a.hands[:, 3]).T))
    distances = np.column_stack([a.distances[:, 0], apart])
    lines, _ = near_strangers(replace(a, edges=edges, wanted=wanted, distances=distances))
    assert not lines
    wanted[:] = wanted[::-1].copy()
    wanted[len(a.grid) // 4 :, 1] = np.nan
    (line,), _ = near_strangers(replace(a, edges=edges, wanted=wanted, distances=distances))
    assert np.isfinite(line.values).tolist() == np.isnan(wanted[:, 1]).tolist()


def crowd(rows: int, shrink: float = 1.0) -> Fleet:
    """A lattice whose edges are 1 m, and whose robots start so many times nearer."""
    places, edges = triangle(rows)
    fleet = make_fleet(places, edges, duration_s=1.0, rate_hz=10)
    robots = tuple(replace(each, x_m=shrink * each.x_m, y_m=shrink * each.y_m) for each in fleet.robots)
    return replace(fleet, robots=robots)


def crowded(rows: int, shrink: float) -> RunResult:
    fleet = crowd(rows, shrink)
    return result_of(fleet, [standing(each.x_m - LEVER_M, each.y_m) for each in fleet.robots])


def test_of_many_edges_a_band_is_drawn_and_the_extreme_ones_are_named() -> None:
    fleet = crowd(9)
    paths = [standing(each.x_m - LEVER_M, each.y_m) for each in fleet.robots]
    paths[0] = standing(-LEVER_M, -0.5)  # the tip of the triangle lags
    near = fleet.robots[-2]
    paths[-1] = standing(near.x_m + 0.3 - LEVER_M, near.y_m)
    result = result_of(fleet, paths)
    figure = distances(result)
    (axes,) = figure.axes
    texts = [text.get_text() for text in axes.texts]
    assert "44–45" in texts
    assert any(text.startswith("longest edge: ") and "(1–" in text for text in texts)
    assert any(text.endswith("longest") and text.startswith("1–") for text in texts)
    assert len(texts) < 10
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "least to greatest of 108 edges", "middle half", "median",
    ]  # fmt: skip


def test_of_very_many_near_pairs_the_nearest_are_named_and_the_others_counted() -> None:
    result = crowded(9, 0.25)
    lines, further = near_strangers(result.analysis)
    assert not lines  # those that are so near share an edge
    edges = [Line((0, 1), np.array([0.6, 0.49]), True)]
    a = replace(result.analysis, edges=np.array([[0, 1]]), wanted=np.ones((2, 1)))
    assert near_edges(a, edges) == edges
    assert not near_edges(a, [Line((0, 1), np.array([0.6, 0.51]), True)])
    (axes,) = distances(result).axes
    named = [
        text for text in (each.get_text() for each in axes.texts) if text.count("–") == 1 and len(text) < 6
    ]
    assert len(named) == NAMED_MAX
    assert [each.get_text() for each in axes.texts if "more pairs" in each.get_text()] == [
        f"{108 - NAMED_MAX} more pairs\nthat came near"
    ]
    assert sum(line.get_color() == GREY for line in axes.lines) == 108 - NAMED_MAX

    strangers = replace(crowd(9, 0.2), formation=replace(crowd(9).formation, edges=((1, 2),)))
    result = result_of(strangers, [standing(each.x_m - LEVER_M, each.y_m) for each in strangers.robots])
    lines, further = near_strangers(result.analysis)
    assert len(lines) == NAMED_MAX + THIN_MAX
    assert len(lines) + further == 107  # all neighbours but those with an edge
    assert f"{107 - NAMED_MAX} more pairs\nthat came near" in words(result)


def test_lines_are_told_apart_without_colours() -> None:
    result = result_of(make_fleet(*triangle(3), velocity=(0.2, 0.0)))
    (axes,) = distances(result).axes
    drawn = [line for line in axes.lines if len(np.asarray(line.get_xdata())) == len(result.analysis.grid)]
    assert len(drawn) == 9
    assert len({line.get_marker() for line in drawn}) == 9


@pytest.mark.parametrize(
    ("value", "top", "stands"),
    [
        (1.6, 1.75, "below it"),  # a short drive, far from the safe distance
        (0.25, 1.75, "below both"),
        (0.301, 3.6, "below both"),  # of `make demo`
        (0.3, 8.0, "on lines"),  # of many robots: both lie on the axis to the eye
        (2.0, 8.0, "below it"),
    ],
)
def test_what_is_written_of_the_closest_covers_no_safe_distance(
    value: float, top: float, stands: str
) -> None:
    found = _beside_closest(value, SAFE_M, top)
    half_a_line = 0.5 * 0.145 / 3.2 * top
    if found is not None:
        assert abs(found - SAFE_M) > half_a_line
        assert half_a_line < found < value
    where = "on lines" if found is None else "below both" if found < SAFE_M else "below it"
    assert where == stands
