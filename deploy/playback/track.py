"""How a run moved, as rows of numbers that a page plays: the whole thinned, or pieces of it in full."""

from __future__ import annotations

from typing import Final

import numpy as np

from handfast.agent.formation.points import Floats
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
