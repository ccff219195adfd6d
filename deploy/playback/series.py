"""Curves of a whole run for a page: what a person follows, thinned so that no extreme is lost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.analysis import Analysis, norm
from handfast.deploy.verdict.run_result import RunResult

BINS: Final = 1000
"""A curve has so many points at most: as many as a wide screen has pixels for it."""
EDGES_MAX: Final = 15
"""Of more edges only the worst error is a curve, not each distance."""

HELD_S: Final = 1.0
"""For so long a curve stays where the last status had it."""


def series(result: RunResult) -> dict[str, Any]:
    """The curves as JSON values: `t` (b,) s, the beginning of each bin, and under the name of each curve b
    numbers: its greatest, or where small is bad its smallest, value in each bin; None where there is none.

    Curves: `nearest` (m, of any two robots), `error` (m, of the worst edge), `tracking` (m, of the robot that
    is farthest from its place), `tick` (us), `age` (ms); `edges`: where they are few, of each `low` and
    `high`, its least and greatest distance (m) while it is in force.
    """
    analysis = result.analysis
    starts = _starts(len(analysis.grid))
    distances = np.where(np.isfinite(analysis.wanted), analysis.distances, np.nan)  # of edges in force
    errors = np.abs(distances - analysis.wanted)
    tracking = norm(analysis.hands - analysis.desired)
    found: dict[str, Any] = {
        "t": [round(float(t), 3) for t in analysis.grid[starts]],
        "nearest": _numbers(-_greatest(-nearest(analysis), starts)),
        "error": _numbers(_greatest(_most(errors), starts)),
        "tracking": _numbers(_greatest(_most(tracking), starts)),
        "edges": [],
    }
    for name, (times, values) in _times_of_statuses(result).items():
        found[name] = _numbers(_binned(times, values, analysis.grid[starts]))
    if analysis.edges.shape[0] <= EDGES_MAX:
        found["edges"] = [
            {
                "low": _numbers(-_greatest(-distances[:, column], starts)),
                "high": _numbers(_greatest(distances[:, column], starts)),
            }
            for column in range(analysis.edges.shape[0])
        ]
    return found


def nearest(analysis: Analysis) -> Floats:
    """Distance (k,) m of the two hands that are nearest to each other at each time; NaN without two."""
    found = np.full(len(analysis.grid), np.inf)
    for index in range(len(analysis.ids) - 1):  # a robot at a time: all pairs at once would not fit
        apart = norm(analysis.hands[:, index + 1 :] - analysis.hands[:, index : index + 1])
        found = np.minimum(found, np.where(np.isnan(apart), np.inf, apart).min(axis=1))
    return np.where(np.isinf(found), np.nan, found)


def _times_of_statuses(result: RunResult) -> Mapping[str, tuple[Floats, Floats]]:
    """The longest tick (us) and the greatest age (ms) of each status of any robot, with its time."""
    statuses = [data.status for data in result.recording.robots.values()]
    times = np.concatenate([each.t for each in statuses])
    return {
        "tick": (times, np.concatenate([each.tick_max_us for each in statuses])),
        "age": (times, np.concatenate([each.age_max_us for each in statuses]) / 1e3),
    }


def _starts(rows: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """First rows of at most `BINS` bins of equal size."""
    return np.arange(0, rows, -(-rows // BINS))


def _most(values: Floats) -> Floats:
    """Greatest (k,) of each row of values (k, n), NaN of one without any."""
    found = np.where(np.isnan(values), -np.inf, values).max(axis=1, initial=-np.inf)
    return np.where(np.isinf(found), np.nan, found)


def _greatest(values: Floats, starts: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Floats:
    """Greatest of values (k,) in each bin, NaN where there is none."""
    found = np.maximum.reduceat(np.where(np.isnan(values), -np.inf, values), starts)
    return np.where(np.isinf(found), np.nan, found)


def _binned(times: Floats, values: Floats, begins: Floats) -> Floats:
    """Greatest of values (s,) at `times` in the bins that begin at `begins` (b,); NaN where there is none. An
    empty bin has that of the last one before it, for `HELD_S`."""
    found = np.full(len(begins), -np.inf)
    bins = np.searchsorted(begins, times, side="right") - 1
    known = (bins >= 0) & ~np.isnan(values)
    np.maximum.at(found, bins[known], values[known])
    filled = np.maximum.accumulate(np.where(np.isinf(found), -1, np.arange(len(begins))))
    recent = (filled >= 0) & (begins - begins[filled] <= HELD_S)
    found = np.where(recent, found[filled], -np.inf)
    return np.where(np.isinf(found), np.nan, found)


def _numbers(values: Floats) -> list[float | None]:
    return [None if value != value else round(value, 4) for value in values.tolist()]
