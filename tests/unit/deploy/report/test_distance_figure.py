"""Distances: which pairs are drawn, and what is written at their lines."""

from __future__ import annotations

import pytest

from handfast.deploy.report.distance_figure import (
    Line,
    distances,
    near_strangers,
)
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import result_of
from tests.unit.deploy.synthetic_run import Path, make_fleet, standing

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
