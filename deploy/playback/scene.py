"""What a page is told of a run besides its motion: its fleet, ground and edges, the states of its robots,
what happened, the verdict."""

from __future__ import annotations

from typing import Any, Final

from handfast.agent.control.boundaries import Circle, fence_of, obstacles_of
from handfast.agent.fleet.loading import law_name
from handfast.agent.fleet.model import Fleet
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.playback.looks import LOOKS
from handfast.deploy.playback.marks import marks
from handfast.deploy.playback.series import series
from handfast.deploy.playback.track import COLUMNS, Track
from handfast.deploy.verdict.run_result import RunResult

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
