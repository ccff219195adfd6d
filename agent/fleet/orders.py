"""``[[order]]`` of a fleet file: an operator's orders at given times of the drive, and their checks (PURE).

An operator gives the same orders by hand with ``handfast change``, ``stop`` and ``resume``. Whether an order
can be carried out depends on the ones before it; `deploy.orders.mission_editing` decides that. The checks of
a trajectory, whose fields may be valid one by one but not together, are here too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from handfast.agent.common.quantities import FAR_M, Vector
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import about, entries, setting
from handfast.agent.common.wording import example, show
from handfast.agent.fleet.sections import TRAJECTORY_FIELDS, TrajectorySection


def check_trajectory(
    trajectory: Mapping[str, Any], raw: Mapping[str, Any], reader: Reader, place: str = "trajectory"
) -> None:
    """Adds to `reader` what is wrong with a trajectory's values, which were read from the table `raw`."""
    kind = trajectory.get("kind")
    if kind is None:
        return
    needed, taken = TRAJECTORY_FIELDS[kind]
    for key in needed:
        if key not in raw:
            example = entries(TrajectorySection)[key].setting.example
            reader.add(
                f"{place}.{key}", f'is missing: kind = "{kind}" needs it, for example {key} = {example}'
            )
    for key, kinds in kinds_by_field().items():
        if key in raw and key not in (*needed, *taken):
            users = " and ".join(f'kind = "{name}"' for name in kinds)
            reader.add(f"{place}.{key}", f'is used by {users} only, but here kind = "{kind}": leave it out')
    if kind == "waypoints" and trajectory.get("waypoints_m") is not None:
        points = trajectory["waypoints_m"]
        if len(points) < 2:
            reader.add(f"{place}.waypoints_m", f"must have at least 2 points, got {len(points)}")
        for number in range(1, len(points)):
            if points[number] is not None and points[number] == points[number - 1]:
                reader.add(
                    f"{place}.waypoints_m[{number + 1}]",
                    f"{show(points[number])} is the point before it again",
                )


def kinds_by_field() -> dict[str, list[str]]:
    """Kinds of trajectory that have a field, by its name."""
    kinds: dict[str, list[str]] = {}
    for kind, (needed, taken) in TRAJECTORY_FIELDS.items():
        for key in (*needed, *taken):
            kinds.setdefault(key, []).append(kind)
    return kinds


# ruff: noqa: RUF009 (setting() is dataclasses.field)


Kind = Literal["join", "leave", "replace", "remove", "reshape", "stop", "resume"]

ORDER_FIELDS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "join": (("robot", "edges"), ("distance_m", "offset_m", "over_s")),
    "leave": (("robot",), ("over_s",)),
    "replace": (("robot", "by"), ("over_s",)),
    "remove": (("robots",), ()),
    "reshape": ((), ("formation", "trajectory", "scale", "over_s")),
    "stop": ((), ()),
    "resume": ((), ("robots",)),
}
"""Fields that each kind of order needs, and those that it takes besides; others are errors with it."""


@dataclass(frozen=True, slots=True)
class ShapeSection:
    """``[order.formation]``: the formation that is to be taken up."""

    offsets: tuple[Vector, ...] | None = setting(
        None,
        "New places, one pair for each member in the order of the file.",
        unit="m",
        ge=-FAR_M,
        le=FAR_M,
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
        le=FAR_M,
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
            "What is ordered: `join`, `leave`, `replace`, `remove`, `reshape`, `stop` or `resume`. Fields of "
            "other kinds are errors.",
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
        le=FAR_M,
        example="1.0",
    )
    offset_m: Vector | None = setting(
        None,
        "`join`: its place in the formation. Left out: found from its edges, away from the others.",
        unit="m",
        ge=-FAR_M,
        le=FAR_M,
        example="[1.5, 0.5]",
    )
    scale: float | None = setting(
        None,
        "`reshape`: makes the formation so many times as large, about its reference.",
        gt=0,
        le=1000,
        example="1.5",
    )
    formation: ShapeSection | None = setting(
        None,
        "`reshape`: `offsets` are new places, one for each member in the order of the file; `edges` the "
        "new graph, left out: as it was; `distance_m` new distances, left out: taken from `offsets`, else as "
        "they were. Without `offsets` places are found that meet the distances.",
    )
    trajectory: TrajectorySection | None = setting(
        None,
        "`reshape`: where to go from now on; its time counts from the change. `start_m` of a `line` or "
        "`hold` counts from where the formation's reference will be half way through the change, so that "
        "left out it goes on from there; a `circle` and `waypoints` are where they are.",
    )
    over_s: float | None = setting(
        None,
        "How long it takes to come from the old places to the new. Left out: as long as it needs at the "
        "limits of speed and acceleration; what would need more than ten minutes is refused.",
        unit="s",
        ge=0.1,
        le=600,
        example='"5s"',
    )
    robots: tuple[int, ...] | None = setting(
        None,
        "`remove`: whose bodies have been carried off the field; `resume`: who may drive again, left out: "
        "all.",
        ge=1,
        le=9999,
        example="[1, 2]",
    )


def check_orders(
    orders: Sequence[Mapping[str, Any]], raw: Mapping[str, Any], ids: Sequence[int | None], reader: Reader
) -> None:
    """Adds to `reader` what is wrong with the values of all orders.

    Args:
        orders: as `reader` has read them.
        raw: the file's tables.
        ids: of all robots, None for one that could not be read.
    """
    rows = raw.get("order")
    for number, order in enumerate(orders, 1):
        place = f"order[{number}]"
        row = rows[number - 1] if isinstance(rows, (list, tuple)) else {}
        given = row if isinstance(row, Mapping) else {}
        _check_fields(order, given, place, reader)
        if ids and None not in ids:
            _check_robots(order, ids, place, reader)
        if order.get("robot") is not None and order.get("robot") == order.get("by"):
            reader.add(f"{place}.by", f"{show(order['by'])} is the robot that it is to replace")
        _check_join(order, place, reader)
        if order.get("kind") == "remove":
            _check_removed(order.get("robots"), f"{place}.robots", reader)
        _check_shape(order.get("formation"), f"{place}.formation", reader)
        if order.get("trajectory") is not None:
            inside = given.get("trajectory")
            table = inside if isinstance(inside, Mapping) else {}
            check_trajectory(order["trajectory"], table, reader, f"{place}.trajectory")


def _check_fields(order: Mapping[str, Any], given: Mapping[str, Any], place: str, reader: Reader) -> None:
    kind = order.get("kind")
    if kind is None:
        return
    needed, taken = ORDER_FIELDS[kind]
    known = entries(OrderSection)
    for key in needed:
        if key not in given:
            shown = example(known[key].hint, known[key].setting)
            reader.add(f"{place}.{key}", f'is missing: kind = "{kind}" needs it, for example {key} = {shown}')
    for key in known:
        if key in given and key not in ("at", "kind", *needed, *taken):
            kinds = [name for name, fields in ORDER_FIELDS.items() if key in (*fields[0], *fields[1])]
            users = " and ".join(f'kind = "{name}"' for name in kinds)
            reader.add(f"{place}.{key}", f'is used by {users} only, but here kind = "{kind}": leave it out')
    if kind == "reshape" and not any(key in given for key in ("formation", "trajectory", "scale")):
        reader.add(place, 'changes nothing: kind = "reshape" takes formation, trajectory or scale')


def _check_robots(order: Mapping[str, Any], ids: Sequence[int | None], place: str, reader: Reader) -> None:
    shape = order.get("formation") or {}
    named = [(f"{place}.{key}", order.get(key)) for key in ("robot", "by")]
    for key in ("edges", "robots"):
        named += [(f"{place}.{key}[{k}]", robot) for k, robot in enumerate(order.get(key) or (), 1)]
    for k, edge in enumerate(shape.get("edges") or (), 1):
        named += [(f"{place}.formation.edges[{k}]", robot) for robot in edge or ()]
    for where, robot in named:
        if robot is not None and robot not in ids:
            reader.add(where, f"there is no robot {show(robot)}; ids are {show(_known(ids), 80)[1:-1]}")


def _known(ids: Sequence[int | None]) -> list[int]:
    return sorted(robot for robot in ids if robot is not None)


def _check_join(order: Mapping[str, Any], place: str, reader: Reader) -> None:
    edges, distance = order.get("edges"), order.get("distance_m")
    if edges is None:
        return
    for k, robot in enumerate(edges, 1):
        if robot is not None and robot in edges[: k - 1]:
            reader.add(f"{place}.edges[{k}]", f"robot {show(robot)} is given twice")
        if robot is not None and robot == order.get("robot"):
            reader.add(f"{place}.edges[{k}]", f"robot {show(robot)} cannot share an edge with itself")
    if isinstance(distance, tuple) and len(distance) != len(edges):
        reader.add(
            f"{place}.distance_m",
            f"must be one number or one per edge, got {len(distance)} for {len(edges)} edges",
        )


def _check_removed(robots: Sequence[int | None] | None, place: str, reader: Reader) -> None:
    if robots is not None and not robots:
        reader.add(place, "names no robot: write for example robots = [7]")
    for k, robot in enumerate(robots or (), 1):
        if robot is not None and robots is not None and robot in robots[: k - 1]:
            reader.add(f"{place}[{k}]", f"robot {show(robot)} is given twice")


def _check_shape(shape: Mapping[str, Any] | None, place: str, reader: Reader) -> None:
    if shape is None:
        return
    edges, distance = shape.get("edges"), shape.get("distance_m")
    if all(shape.get(key, ()) is None for key in ("offsets", "edges", "distance_m")):
        reader.add(place, "gives nothing: write offsets, edges or distance_m")
    if edges is None:
        return
    seen: set[frozenset[int]] = set()
    for k, edge in enumerate(edges, 1):
        if edge is None:
            continue
        if edge[0] == edge[1]:
            reader.add(f"{place}.edges[{k}]", f"{show(edge)} joins robot {show(edge[0])} to itself")
        elif frozenset(edge) in seen:
            reader.add(f"{place}.edges[{k}]", f"{show(edge)} is given twice")
        seen.add(frozenset(edge))
    if isinstance(distance, tuple) and len(distance) != len(edges):
        reader.add(
            f"{place}.distance_m",
            f"must be one number or one per edge, got {len(distance)} for {len(edges)} edges",
        )
