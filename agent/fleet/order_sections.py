"""``[[order]]`` of a fleet file: what its operator does at times of the drive (PURE).

The same can be ordered by hand: ``handfast join``, ``leave``, ``replace``, ``reshape``, ``stop``, ``resume``.
"""

# ruff: noqa: RUF009 (setting() is dataclasses.field)
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from agent.common.schema import about, setting
from agent.fleet.safety_sections import Pair
from agent.fleet.sections import TrajectorySection

_FAR_M: Final = 1e6

Kind = Literal["join", "leave", "replace", "reshape", "stop", "resume"]

ORDER_FIELDS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "join": (("robot", "edges"), ("distance_m", "offset_m", "over_s")),
    "leave": (("robot",), ("over_s",)),
    "replace": (("robot", "by"), ("over_s",)),
    "reshape": ((), ("formation", "trajectory", "scale", "over_s")),
    "stop": ((), ("reason",)),
    "resume": ((), ("robots",)),
}
"""Fields that each kind of order needs, and those that it takes besides; others are errors with it."""


@dataclass(frozen=True, slots=True)
class ShapeSection:
    """``[order.formation]``: the formation that is to be taken up."""

    offsets: tuple[Pair, ...] | None = setting(
        None,
        "New places, one pair for each member in the order of the file.",
        unit="m",
        ge=-_FAR_M,
        le=_FAR_M,
        example="[[0.0, 0.5], [0.0, -0.5]]",
    )
    edges: tuple[tuple[int, int], ...] | None = setting(
        None, "New formation graph, of robots' ids; left out: as it was.", example="[[1, 2], [2, 3]]"
    )
    distance_m: float | tuple[float, ...] | None = setting(
        None,
        "New distance of every edge, or one per edge. Left out: taken from `offsets`, else as it was. "
        "Without `offsets` new places are found that meet them.",
        unit="m",
        gt=0,
        le=_FAR_M,
        example="1.5",
    )


@dataclass(frozen=True, slots=True)
class OrderSection:
    """One ``[[order]]``."""

    at: float = field(
        metadata=about(
            "When it is given, from the start of the drive.", unit="s", ge=0, le=1e6, example='"10s"'
        )
    )
    kind: Kind = field(
        metadata=about(
            "What is ordered: `join`, `leave`, `replace`, `reshape`, `stop` or `resume`. Fields of other "
            "kinds are errors.",
            example='"leave"',
        )
    )
    robot: int | None = setting(
        None,
        "`join`: who comes (a robot in reserve); `leave`, `replace`: who goes.",
        ge=1,
        le=9999,
        example="7",
    )
    by: int | None = setting(
        None, "`replace`: who takes its place (a robot in reserve).", ge=1, le=9999, example="7"
    )
    edges: tuple[int, ...] | None = setting(
        None,
        "`join`: members with which it is to share an edge, maybe none: `[]`.",
        ge=1,
        le=9999,
        example="[3, 5]",
    )
    distance_m: float | tuple[float, ...] | None = setting(
        None,
        "`join`: length of the new edges, or one for each. Left out: from `offset_m`, else that of the edges "
        "there are.",
        unit="m",
        gt=0,
        le=_FAR_M,
        example="1.0",
    )
    offset_m: Pair | None = setting(
        None,
        "`join`: its place in the formation. Left out: found from its edges, away from the others.",
        unit="m",
        ge=-_FAR_M,
        le=_FAR_M,
        example="[1.5, 0.5]",
    )
    scale: float | None = setting(
        None,
        "`reshape`: makes the formation so many times as large, about its reference.",
        gt=0,
        le=1000,
        example="1.5",
    )
    formation: ShapeSection | None = setting(None, "`reshape`: new places, edges or distances.")
    trajectory: TrajectorySection | None = setting(
        None,
        "`reshape`: where to go from now on; its time counts from the change. `start_m` of a `line` or "
        "`hold` counts from where the formation's reference is then, so that left out it goes on from there; "
        "a `circle` and `waypoints` are where they are.",
    )
    over_s: float | None = setting(
        None,
        "How long it takes to come from the old places to the new. Left out: as long as it needs at the "
        "limits of speed and acceleration.",
        unit="s",
        ge=0.1,
        le=600,
        example='"5s"',
    )
    reason: str = setting("", "`stop`: why, for people.", example='"a person on the field"')
    robots: tuple[int, ...] | None = setting(
        None,
        "`resume`: who may drive again; left out: all.",
        ge=1,
        le=9999,
        example="[1, 2]",
    )
