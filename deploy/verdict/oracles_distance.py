"""Oracles of places: robots from each other, from obstacles, and within the geofence."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.control.boundaries import fence_of, obstacles_of
from handfast.agent.control.limits import clearance as clearance_of
from handfast.agent.fleet.model import Fleet
from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.deploy.analysis.analysis import Analysis, Approaches
from handfast.deploy.analysis.presence import Flags, said
from handfast.deploy.analysis.shapes import distances
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.violations import Violation, lasting
from handfast.plant.unicycle import BRAKE_DECELERATION_MAX

SEPARATION: Final = "separation"
"""Name of the oracle of robots and each other."""
CLEARANCE_TOLERANCE_M: Final = 0.01
OUTSIDE_S: Final = 1.0
"""A robot outside the geofence must hold within so long."""
_BARE: Final = "With avoidance.enabled = false nothing keeps such pairs apart."
_NOBODY: Final = " Nothing steered either of them."
_RELEASED: Final = frozenset({State.RELEASED.value})


def separation(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """No two robots below the safe distance, whatever the law promises of them."""
    if len(a.ids) < 2:
        return None
    more = "" if fleet.avoidance.enabled else f" {_BARE}"
    return [
        *_too_close(a.with_edge, a.safe_m, "share an edge"),
        *_too_close(a.without_edge, a.safe_m, "share no edge", more),
    ]


def _too_close(approaches: Approaches, safe_m: float, relation: str, more: str = "") -> Iterator[Violation]:
    """One violation for all pairs of a kind that came below the safe distance: the closest is named."""
    for near, words, avoidable in (
        (approaches.unsafe, more, True),
        (approaches.unavoidable, _NOBODY, False),
    ):
        if near:
            distance_m, t_s, (i, j) = near[0]
            others = {1: "", 2: " One other such pair came too close as well."}.get(
                len(near), f" {len(near) - 1} other such pairs came too close as well."
            )
            message = (
                f"Robots {i} and {j}, which {relation}, came within {distance_m:.3f} m of each other at "
                f"{t_s:.2f} s; the safe distance is {safe_m:.3f} m.{others}{words}"
            )
            yield Violation(SEPARATION, t_s, message, avoidable)


def clearance(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """No hand inside an obstacle, nor, with avoidance, nearer to one than the clearance."""
    obstacles = obstacles_of(fleet)
    if not obstacles:
        return None
    least_m = clearance_kept_m(fleet, a.safe_m)
    found = []
    for index, robot, rows, words, avoidable in _judged(recording, a):
        for obstacle in obstacles:
            away_m = distances(obstacle, a.hands[:, index])
            near = away_m < least_m
            out = away_m >= least_m  # neither where a gap hides it
            has_place = np.isfinite(a.desired[:, index, 0]).any()
            stays = has_place and not out.any()  # though its place is elsewhere
            near &= np.logical_or.accumulate(out) | stays  # begun there: only once it has been out
            near &= rows
            if not near.any():
                continue
            k = int(np.where(near, away_m, np.inf).argmin())
            worst_m, t_s = float(away_m[k]), float(a.grid[k])
            what = (
                f"was {-worst_m:.3f} m inside"
                if worst_m < 0.0
                else f"came within {worst_m:.3f} m (at least {least_m + CLEARANCE_TOLERANCE_M:.3f} m) of"
            )
            message = f"Robot {robot} {what} {obstacle.name} at {t_s:.2f} s.{words}"
            found.append(Violation("clearance", t_s, message, avoidable))
    return found


def clearance_kept_m(fleet: Fleet, safe_m: float) -> float:
    """What hands have to keep from obstacles, m."""
    if not fleet.avoidance.enabled:
        return 0.0
    return clearance_of(fleet.avoidance.clearance_m, safe_m) - CLEARANCE_TOLERANCE_M


def geofence(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """Outside it robots hold, and are not further outside than they can have been driving when it began."""
    fence = fence_of(fleet)
    if fence is None or not fleet.avoidance.enabled:
        return None
    furthest_m = furthest_outside_m(fleet)
    found = []
    for index, robot, rows, words, avoidable in _judged(recording, a):
        inside_m = distances(fence, a.hands[:, index])
        outside = (inside_m < 0.0) & rows
        inside = inside_m >= 0.0
        outside &= np.logical_or.accumulate(inside) | (not inside.any())
        if not outside.any():
            continue
        status = recording.robots[robot].status
        since_s = lasting(outside & said(status, a.grid, DRIVING_NAMES), a.grid, OUTSIDE_S)
        if since_s is not None:
            message = f"Robot {robot} went on driving outside the geofence, from {since_s:.2f} s on.{words}"
            found.append(Violation("geofence", since_s, message, avoidable))
        k = int(np.where(outside, inside_m, np.inf).argmin())
        if inside_m[k] < -furthest_m:
            t_s = float(a.grid[k])
            message = (
                f"Robot {robot} was {-inside_m[k]:.2f} m outside the geofence at {t_s:.2f} s: braking takes "
                f"{furthest_m:.2f} m at most.{words}"
            )
            found.append(Violation("geofence", t_s, message, avoidable))
    return found


def furthest_outside_m(fleet: Fleet) -> float:
    """How far outside the geofence a robot may be that brakes as it leaves it, m."""
    control = fleet.control
    braking = min(BRAKE_DECELERATION_MAX, control.max_acceleration)
    most_mps = 1.1 * control.max_speed_mps + 0.1
    return most_mps**2 / (2.0 * braking) + most_mps * (control.wrench_timeout_s + 0.1)


class _Judged(NamedTuple):
    """`rows` (k,) of one robot, in column `at`, that nobody else drove; and what is said of them."""

    at: int
    robot: int
    rows: Flags
    words: str
    avoidable: bool


def _judged(recording: Recording, a: Analysis) -> Iterator[_Judged]:
    """Of every robot whose place is known: when it was commanded, and when it went on by itself."""
    for index, (robot, data) in enumerate(recording.robots.items()):
        if len(data.body):
            rows = ~said(data.status, a.grid, _RELEASED)
            rolling = a.uncommanded.rolling[:, index]
            yield _Judged(index, robot, rows & ~rolling, "", True)
            if rolling.any():
                yield _Judged(index, robot, rows & rolling, " Nothing commanded it.", False)
