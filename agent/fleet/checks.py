"""Checks across the fields of a fleet file: what is valid field by field, but does not go together (PURE).

The checks see what `agent.common.reader.Reader.read` returned: valid values only, None for an element with a
problem of its own.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from handfast.agent.common.reader import Reader
from handfast.agent.common.wording import show
from handfast.agent.fleet.fault_checks import check_faults
from handfast.agent.fleet.hosts import PORT_MAX, check_hosts, has_host_routers
from handfast.agent.fleet.orders import check_orders, check_trajectory
from handfast.agent.fleet.plants import KINDS
from handfast.agent.fleet.safety import check_safety
from handfast.agent.messages.types import NEIGHBOURS_MAX


def check_fleet(values: Mapping[str, Any], raw: Mapping[str, Any], reader: Reader) -> None:
    """Adds to `reader` what is wrong with the values that it has read from the tables `raw`."""
    robots = values.get("robots")
    formation = values.get("formation", {})
    if robots is not None:
        _check_ids(robots, reader)
        _check_ports(values.get("network", {}), robots, reader)
    ids = [row.get("id") for row in robots] if robots is not None else []
    if formation:
        _check_edges(formation, ids, reader)
        members = [row.get("id") for row in robots if not row.get("reserve")] if robots is not None else []
        _check_reserve(formation, ids, members, reader)
        _check_shape(formation, members, reader)
        _check_distances(formation, members, reader)
    check_faults(values.get("faults", {}), [robot_id for robot_id in ids if robot_id is not None], reader)
    given = raw.get("trajectory")
    check_trajectory(values.get("trajectory", {}), given if isinstance(given, dict) else {}, reader)
    _check_timeouts(values, reader)
    _check_plants(robots or [], values, reader)
    check_hosts(values, reader)
    check_safety(values, reader)
    check_orders(values.get("orders", ()), raw, ids, reader)


def _check_plants(robots: Sequence[Mapping[str, Any]], values: Mapping[str, Any], reader: Reader) -> None:
    """What each kind of plant needs of its robots, and of the fleet."""
    for kind in KINDS.values():
        rows = [(number, row) for number, row in enumerate(robots, 1) if row.get("plant") == kind.name]
        if rows and kind.needs_datum and values.get("datum", {}) is None:
            reader.add(
                "datum",
                f"table [datum] is missing: robots with plant = {show(kind.name)} need it, for example "
                "latitude_deg = -35.363261 and longitude_deg = 149.165230",
            )
        if kind.check is not None:
            kind.check(kind.name, rows, reader)


def _check_ids(robots: Sequence[Mapping[str, Any]], reader: Reader) -> None:
    first: dict[int, int] = {}
    for number, row in enumerate(robots, 1):
        robot_id = row.get("id")
        if robot_id is not None and first.setdefault(robot_id, number) != number:
            reader.add(
                f"robot[{number}].id",
                f"robot[{first[robot_id]}] has the id {robot_id} already: ids must differ",
            )


def _check_ports(network: Mapping[str, Any], robots: Sequence[Mapping[str, Any]], reader: Reader) -> None:
    base_port, has_routers = network.get("base_port"), has_host_routers(network, robots)
    ports = 2 * len(robots) + has_routers
    if base_port is not None and base_port + ports - 1 > PORT_MAX:
        reader.add(
            "network.base_port",
            f"{len(robots)} robots{' and a router' * has_routers} take ports {base_port} to "
            f"{base_port + ports - 1}, which must not pass {PORT_MAX} (the system uses those above): must be "
            f"at most {PORT_MAX + 1 - ports}",
        )


def _check_edges(formation: Mapping[str, Any], ids: Sequence[int | None], reader: Reader) -> None:
    first: dict[frozenset[int], int] = {}
    known = {robot_id for robot_id in ids if robot_id is not None}
    absent = {end for edge in formation.get("edges", ()) for end in edge or () if end not in known}
    # A robot whose id could not be read, or is another's, may be one of them: then the ids are what is wrong.
    are_ids_wrong = len(absent) <= len(ids) - len(known)
    for number, edge in enumerate(formation.get("edges", ()), 1):
        if edge is None:
            continue
        place, shown = f"formation.edges[{number}]", show(edge)
        if edge[0] == edge[1]:
            reader.add(place, f"{shown} joins robot {show(edge[0])} to itself: an edge joins two robots")
            continue
        missing = [show(end) for end in edge if end not in known]
        if missing and ids and not are_ids_wrong:
            there_are = show(sorted(known), 80)[1:-1]
            reader.add(
                place, f"{shown}: there is no robot {' and no robot '.join(missing)}; ids are {there_are}"
            )
        if first.setdefault(frozenset(edge), number) != number:
            reader.add(
                place, f"{shown} is formation.edges[{first[frozenset(edge)]}] again: give each edge once"
            )
    degrees = Counter(end for edge in first for end in edge)
    for robot_id, degree in sorted(degrees.items()):
        if degree > NEIGHBOURS_MAX:
            reader.add(
                "formation.edges",
                f"robot {robot_id} has {degree} edges: must be at most {NEIGHBOURS_MAX}, for its messages "
                "must stay small",
            )


def _check_reserve(
    formation: Mapping[str, Any], ids: Sequence[int | None], members: Sequence[int | None], reader: Reader
) -> None:
    if ids and not members:
        reader.add("robot", "all robots are in reserve: at least one must have a place")
    for number, edge in enumerate(formation.get("edges", ()), 1):
        for end in edge or ():
            if end in ids and end not in members:
                reader.add(
                    f"formation.edges[{number}]",
                    f"{show(edge)}: robot {show(end)} is in reserve, and has no edges until it joins",
                )


def _check_shape(formation: Mapping[str, Any], ids: Sequence[int | None], reader: Reader) -> None:
    if "offsets" not in formation or "distance_m" not in formation:
        return
    offsets, distance = formation["offsets"], formation["distance_m"]
    if offsets is None and distance is None:
        reader.add("formation", "gives neither offsets nor distance_m: write for example distance_m = 1.0")
    if offsets is not None and ids and len(offsets) != len(ids):
        reader.add(
            "formation.offsets",
            f"must have one pair per [[robot]] (not in reserve), got {len(offsets)} for {len(ids)} robots",
        )
    edges = formation.get("edges")
    if isinstance(distance, tuple) and edges is not None and len(distance) != len(edges):
        reader.add(
            "formation.distance_m",
            f"must be one number or one per edge, got {len(distance)} for {len(edges)} edges",
        )


def _check_distances(formation: Mapping[str, Any], ids: Sequence[int | None], reader: Reader) -> None:
    edges, safe = formation.get("edges"), formation.get("safe_distance_m")
    offsets, distance = formation.get("offsets"), formation.get("distance_m")
    rule = f"r_s must be below every distance, and safe_distance_m is {show(safe)}"
    if isinstance(distance, float) and safe is not None and distance <= safe:
        reader.add("formation.distance_m", f"{show(distance)} is too small: {rule}")
    if isinstance(distance, tuple) and safe is not None:
        for number, value in enumerate(distance, 1):
            if value is not None and value <= safe:
                reader.add(f"formation.distance_m[{number}]", f"{show(value)} is too small: {rule}")
    if offsets is None or edges is None or len(offsets) != len(ids):
        return
    slot = dict(zip(ids, offsets, strict=True))
    for number, edge in enumerate(edges, 1):
        if edge is None or edge[0] == edge[1] or slot.get(edge[0]) is None or slot.get(edge[1]) is None:
            continue
        apart = math.dist(slot[edge[0]], slot[edge[1]])
        place, shown = f"formation.edges[{number}]", show(edge)
        if apart == 0.0:
            reader.add(place, f"{shown} joins two robots with the same offset, {show(slot[edge[0]])}")
        elif distance is None and "distance_m" in formation and safe is not None and apart <= safe:
            reader.add(place, f"{shown}: the offsets are {apart:.6g} m apart, too close: {rule}")


def _check_timeouts(values: Mapping[str, Any], reader: Reader) -> None:
    rate = values.get("fleet", {}).get("rate_hz")
    for key in ("plant_timeout_s", "wrench_timeout_s", "prediction_horizon_s"):
        timeout = values.get("control", {}).get(key)
        if rate is not None and timeout is not None and timeout < 2 / rate * (1 - 1e-9):
            reader.add(
                f"control.{key}",
                f"must be at least two periods, {2 / rate:.6g} s at fleet.rate_hz = {show(rate)}, "
                f"got {show(timeout)}",
            )
    _check_lowest_rate(values, reader)


def _check_lowest_rate(values: Mapping[str, Any], reader: Reader) -> None:
    rate = values.get("fleet", {}).get("rate_hz")
    lowest = values.get("control", {}).get("rate_min_hz")
    if rate is not None and lowest is not None and lowest > rate:
        reader.add(
            "control.rate_min_hz",
            f"{show(lowest)} Hz is more than fleet.rate_hz = {show(rate)}: it is the lowest rate to which an "
            "overloaded fleet falls",
        )
