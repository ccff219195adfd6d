"""The tables of a fleet file about safety: avoidance, obstacles, geofence, supervision (PURE).

Lengths in m, times in s; frame W (ENU: x east, y north).
"""

# ruff: noqa: RUF009 (setting() is dataclasses.field)
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from agent.common.schema import about, setting

Pair = tuple[float, float]

_FAR_M: Final = 1e6
CORNERS_MAX: Final = 200
"""Corners of one polygon: every robot measures its way to each side in every tick."""
_SLOW_SHARE: Final = 0.75


@dataclass(frozen=True, slots=True)
class AvoidanceSection:
    """``[avoidance]``."""

    enabled: bool = setting(
        True,
        "Robots keep away from robots that they share no edge with, from obstacles and from the geofence, "
        "and what the law asks for passes a last filter. false: the bare law, as published.",
    )
    distance_m: float | None = setting(
        None,
        "d_a: robots that share no edge push each other apart when they are nearer than this. Left out: half "
        "way between the safe distance and the shortest edge, but less than what the formation itself "
        "puts between two such robots.",
        unit="m",
        gt=0,
        le=_FAR_M,
        example="0.6",
    )
    clearance_m: float | None = setting(
        None,
        "No hand point comes nearer to an obstacle than this. Left out: half of `formation.safe_distance_m`.",
        unit="m",
        gt=0,
        le=_FAR_M,
        example="0.3",
    )
    sensing_m: float | None = setting(
        None,
        "Robots nearer than this are listened to closely, in every tick. Left out: 0.9 m more than "
        "`distance_m`, or more where two robots at `control.max_speed_mps` need it to brake in.",
        unit="m",
        gt=0,
        le=_FAR_M,
        example="2.0",
    )
    beacon_hz: float = setting(
        5.0, "How often every robot tells all others where it is.", unit="Hz", ge=0.5, le=50
    )
    barrier_rate: float | None = setting(
        None,
        "p of the last filter: the share of what is left of a distance that a robot may close in a second "
        "(docs/theory.md). Left out: 3, or `control.max_acceleration` / `control.max_speed_mps` if that is "
        "less: braking from full speed takes p times that speed.",
        unit="1/s",
        gt=0,
        le=100,
        example="2.0",
    )
    margin_m: float = setting(
        0.05, "The last filter keeps this much more than the safe distance.", unit="m", ge=0, le=100
    )


@dataclass(frozen=True, slots=True)
class ObstacleSection:
    """One ``[[obstacle]]``: a circle, or a polygon."""

    name: str = setting(
        "",
        "What messages call it; left out: `obstacle 1`, `obstacle 2`, ...",
        pattern=r"[^\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]{0,40}",
        pattern_says="up to 40 printable characters",
        example='"shed"',
    )
    centre_m: Pair | None = setting(
        None, "Of a circle: its centre.", unit="m", ge=-_FAR_M, le=_FAR_M, example="[2.0, 1.0]"
    )
    radius_m: float | None = setting(
        None, "Of a circle: its radius.", unit="m", gt=0, le=_FAR_M, example="0.4"
    )
    points_m: tuple[Pair, ...] | None = setting(
        None,
        f"Of a polygon: its corners in order, either way round, 3 to {CORNERS_MAX}; it need not be convex.",
        unit="m",
        ge=-_FAR_M,
        le=_FAR_M,
        example="[[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]]",
    )


@dataclass(frozen=True, slots=True)
class GeofenceSection:
    """``[geofence]``: where robots may be."""

    points_m: tuple[Pair, ...] = field(
        metadata=about(
            f"Its corners in order, either way round, 3 to {CORNERS_MAX}. A robot whose hand point is "
            "outside holds.",
            unit="m",
            ge=-_FAR_M,
            le=_FAR_M,
            example="[[-10.0, -10.0], [30.0, -10.0], [30.0, 30.0], [-10.0, 30.0]]",
        )
    )
    warn_m: float = setting(
        0.5, "Nearer to it than this, a robot is pushed back, and says so.", unit="m", gt=0, le=_FAR_M
    )


@dataclass(frozen=True, slots=True)
class SupervisionSection:
    """``[supervision]``."""

    slow_after_s: float | None = setting(
        None,
        "A neighbour that has been silent for so long makes a robot drive slower and slower, until at "
        "`control.prediction_horizon_s` it is given up. Left out: three quarters of that.",
        unit="s",
        gt=0,
        le=60,
        example="1.5",
    )
    silence: Literal["drop", "hold"] = setting(
        "drop",
        "What a robot does when it has given up a neighbour: `drop`: drives on without that edge, and keeps "
        "away from where that neighbour may be, but holds when it hears none of its neighbours any more; "
        "`hold`: brakes until it hears all of them.",
    )
    deadman_s: float | None = setting(
        None,
        "Dead-man's switch: robots hold when no operator's heartbeat has come for so long. `handfast run` "
        "sends it, and `handfast heartbeat`. Left out: robots need no operator.",
        unit="s",
        ge=0.2,
        le=600,
        example="1.0",
    )

    def slow_from_s(self, prediction_horizon_s: float) -> float:
        """Age (s) of a neighbour's last state from which on a robot slows down."""
        return _SLOW_SHARE * prediction_horizon_s if self.slow_after_s is None else self.slow_after_s
