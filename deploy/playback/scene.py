"""The data of a run that its page plays: scene, motion and curves.

The scene is the fleet, its ground and edges, the robots' states, events and the verdict. The motion is the
whole run thinned, or pieces of it in full. Curves are thinned so that no extreme is lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from handfast.agent.control.boundaries import Circle, fence_of, obstacles_of
from handfast.agent.fleet.loading import law_name
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.analysis import Analysis, norm
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.playback.marks import LOOKS, marks
from handfast.deploy.recording.tables import StatusTable
from handfast.deploy.verdict.run_result import RunResult

COLUMNS: Final = (
    "x", "y", "heading", "speed", "place_x", "place_y", "age_ms", "tick_us",
    "navigation_x", "navigation_y", "constraint_x", "constraint_y",
)  # fmt: skip
"""Of each robot at one instant: hand point (m, W), heading (rad), speed (m/s), its place in the formation
(m, W), age of its oldest neighbour's message (ms), longest tick (us) and forces per unit mass (m/s2)."""
PIECE_BYTES: Final = 256_000
"""About the size of one piece: some 20 s of 6 robots at 50 Hz."""
OVERVIEW_BYTES: Final = 300_000
"""The most that the whole run takes, thinned."""
PIECE_ROWS: Final = 16
"""A piece has so many rows at least."""
_NUMBER_BYTES: Final = 4
_FORCES: Final = COLUMNS[-4:]


class Track:
    """The motion of a run on its grid of times, made row by row when asked for.

    A row holds `COLUMNS` of each robot, one robot after the other, and then each edge's wanted distance (m),
    as little-endian float32; NaN for what is not known or not in force.

    Attributes:
        width: numbers of a row.
        rows: how many rows there are; row k is at k / rate of the fleet, s of fleet time.
        piece_rows: rows of one piece; the last one may have fewer.
        stride: the overview has each `stride`-th row, and the last one.
    """

    def __init__(self, result: RunResult) -> None:
        self._result = result
        analysis = result.analysis
        self.width: Final = len(COLUMNS) * len(analysis.ids) + len(analysis.edges)
        self.rows: Final = len(analysis.grid)
        row_bytes = self.width * _NUMBER_BYTES
        self.piece_rows: Final = max(PIECE_ROWS, PIECE_BYTES // row_bytes)
        self.stride: Final = max(1, -(-self.rows // max(2, OVERVIEW_BYTES // row_bytes)))

    @property
    def pieces(self) -> int:
        """How many pieces there are."""
        return -(-self.rows // self.piece_rows)

    def piece(self, number: int) -> bytes:
        """The rows of one piece, from 0.

        Raises:
            IndexError: there is no such piece.
        """
        if not 0 <= number < self.pieces:
            raise IndexError(number)
        first = number * self.piece_rows
        return self._at(np.arange(first, min(first + self.piece_rows, self.rows)))

    def overview(self) -> bytes:
        """The whole run, thinned: what a page shows until it has a piece, and all that a report holds."""
        chosen = np.arange(0, self.rows, self.stride)
        return self._at(chosen if chosen[-1] == self.rows - 1 else np.append(chosen, self.rows - 1))

    def _at(self, chosen: np.ndarray[tuple[int], np.dtype[np.int64]]) -> bytes:
        analysis, recording = self._result.analysis, self._result.recording
        t = analysis.grid[chosen]
        robots = np.full((len(chosen), len(analysis.ids), len(COLUMNS)), np.nan, dtype="<f4")
        robots[:, :, 0:2] = analysis.hands[chosen]
        robots[:, :, 4:6] = analysis.desired[chosen]
        for index, data in enumerate(recording.robots.values()):
            body, hand = data.body, data.hand
            heading = data.heading(t)
            robots[:, index, 2] = np.arctan2(np.sin(heading), np.cos(heading))
            if len(body):
                robots[:, index, 3] = np.interp(t, body.t, body["speed"])
            if len(data.status):
                robots[:, index, 6], robots[:, index, 7] = _of_statuses(data.status, t)
            if len(hand):
                held = _held(hand.t, t)
                for column, name in enumerate(_FORCES, len(COLUMNS) - len(_FORCES)):
                    robots[:, index, column] = np.where(held >= 0, hand[name][held], np.nan)
        flat = robots.reshape(len(chosen), -1)
        return np.concatenate([flat, analysis.wanted[chosen].astype("<f4")], axis=1).tobytes()


def _of_statuses(status: StatusTable, t: Floats) -> tuple[Floats, Floats]:
    """Oldest age (ms) and longest tick (us) by the status that holds at each of `t` (k,) s."""
    held = _held(status.t, t)
    age = status.age_max_us[held] / 1e3
    tick = status.tick_max_us[held]
    return np.where(held >= 0, age, np.nan), np.where(held >= 0, tick, np.nan)


def _held(times: Floats, t: Floats) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Rows of ascending `times` (n,) that hold at each of `t` (k,), -1 before the first."""
    return np.searchsorted(times, t, side="right").astype(np.int64) - 1


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


FORMAT: Final = 1
"""Of what a page is given; one that finds another says so."""


def ground(fleet: Fleet) -> dict[str, Any]:
    """What is known of a fleet before it drives, as JSON values.

    Lengths in m (W). `looks`: of each state one of those of `deploy.playback.looks`; `settled`: the share of
    its distance by which an edge may be off; `columns`: of a row of its motion, of each robot.
    """
    fence = fence_of(fleet)
    return {
        "format": FORMAT,
        "fleet": fleet.fleet.name,
        "law": law_name(fleet.control),
        "safe_m": fleet.formation.safe_distance_m,
        "settled": SETTLED,
        "looks": dict(LOOKS),
        "robots": [
            {"id": each.id, "hand_m": each.hand_offset_m, "vehicle": each.kind.vehicle}
            for each in fleet.robots
        ],
        "obstacles": [
            {"name": each.name, "x": each.x, "y": each.y, "radius": each.radius}
            if isinstance(each, Circle)
            else {"name": each.name, "points": each.points}
            for each in obstacles_of(fleet)
        ],
        "fence": None if fence is None else fence.points,
        "columns": list(COLUMNS),
    }


def scene(result: RunResult, track: Track) -> dict[str, Any]:
    """The scene of a run as JSON values, with which a page can read the `track`: its `ground`, and more.

    Times in s of fleet time. `states`: of each robot [t, state, why], one after the other; `edges`: pairs of
    places in `robots`.
    """
    recording, analysis, fleet = result.recording, result.analysis, result.fleet
    return {
        **ground(fleet),
        "mode": recording.mode,
        "end_s": float(analysis.grid[-1]),
        "edges": analysis.edges.tolist(),
        "states": [
            [[round(change.t_s, 3), change.state, change.reason] for change in data.status.changes()]
            for data in recording.robots.values()
        ],
        "marks": [mark._asdict() for mark in marks(result)],
        "series": series(result),
        "verdict": {
            "passed": result.passed,
            "reasons": list(result.reasons),
            "warnings": list(result.warnings),
        },
        "track": {
            "width": track.width,
            "rate_hz": float(fleet.fleet.rate_hz),
            "rows": track.rows,
            "stride": track.stride,
            "piece_rows": track.piece_rows,
        },
    }
