"""What a fleet will do, in plain words: the first half of `handfast check`."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, pi
from typing import Final

import numpy as np

from handfast.agent.common.models import plain
from handfast.agent.common.wording import show
from handfast.agent.control.boundaries import obstacles_of
from handfast.agent.control.limits import clearance, sensing_distance, speed_share, steps, why_not
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import SIMULATOR, MavlinkSection
from handfast.agent.fleet.safety import FENCE_WARN_M
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry, resolve, start_hands
from handfast.agent.formation.trajectory import make_trajectory
from handfast.agent.links.fault_plan import FaultPlan
from handfast.deploy.analysis.couplings import coupling_of, law_of
from handfast.deploy.analysis.shapes import is_rigid
from handfast.deploy.analysis.stability import SETTLED, guaranteed_distance, settling_time
from handfast.deploy.check.capacity import describe_cost
from handfast.deploy.check.network import describe_links, describe_radio, describe_topology
from handfast.deploy.check.safety import parting
from handfast.deploy.console.wording import robots, some
from handfast.deploy.faults.rules import defaults, described, words

FAULTS_SHOWN: Final = 12


def describe(fleet: Fleet) -> str:
    """In plain words, several lines: who drives, in what shape, by which law, where to, and how near it gets.

    For a fleet that cannot be resolved it says what it can; `check` says why.
    """
    n, edges = len(fleet.members), len(fleet.formation.edges)
    description = " ".join(fleet.fleet.description.split())
    about = f": {description}" if description else ""
    lines = [f"{fleet.fleet.name}{about}"]
    lines.append(
        f"  {n} robot{'s' * (n != 1)} ({some([robot.id for robot in fleet.members])}), {edges} "
        f"edge{'s' * (edges != 1)}, {fleet.fleet.rate_hz:g} Hz for {fleet.fleet.duration_s:g} s, "
        f"seed {fleet.fleet.seed}"
    )
    try:
        geometry = resolve(fleet)
        make_trajectory(fleet.trajectory)
    except ValueError as error:
        lines.append(f"  cannot be driven: {error}")
        return "\n".join(lines)
    lines.append(f"  formation: {_describe_shape(fleet, geometry)}")
    lines.append(f"  law: {_describe_law(fleet, geometry)}")
    lines.append(f"  trajectory: {_describe_trajectory(fleet)}")
    lines += [f"  {line}" for line in _describe_start(fleet, geometry)]
    lines += [f"  {line}" for line in _describe_safety(fleet, geometry)]
    lines.append(f"  overloaded: {_describe_overload(fleet)}")
    lines += [f"  {line}" for line in _describe_vehicles(fleet)]
    lines += [f"  {line}" for line in _describe_faults(fleet)]
    lines += [f"  {line}" for line in _describe_network(fleet)]
    lines.append(f"  topology: {describe_topology(fleet)}")
    lines.append(f"  links: {describe_links(fleet)}")
    lines.append(f"  processor: {describe_cost(fleet)}")
    lines.append(f"  radio: {describe_radio(fleet, geometry)}")
    return "\n".join(lines)


def _describe_network(fleet: Fleet) -> Iterator[str]:
    network = fleet.network
    where = f"ports from {network.base_port} up"
    where += (
        ", secured" if fleet.is_secured else ", not secured: whoever is on this network can drive the robots"
    )
    if not fleet.robots[0].host:
        on_loopback = network.address in ("127.0.0.1", "localhost", "[::1]")
        yield f"network: {network.address}, {where.split(', not')[0] if on_loopback else where}"
        return
    yield f"network: {where}"
    for host in fleet.hosts:
        there = [robot.id for robot in fleet.robots if robot.host == host.name]
        address = f" ({host.address})" if host.address else ""
        router = fleet.router_on(host.name)
        beside = f", router {router.number}" if router else ""
        yield f"  host {host.name}{address}: {robots(there) if there else 'no robot'}{beside}"


def _describe_shape(fleet: Fleet, geometry: Geometry) -> str:
    n = len(geometry.ids)
    parts = []
    if len(geometry.distances):
        least, most = float(geometry.distances.min()), float(geometry.distances.max())
        parts.append(
            f"edges of {least:.4g} m" if most - least < 1e-9 else f"edges of {least:.4g} to {most:.4g} m"
        )
    if n > 1:
        parts.append("rigid" if is_rigid(geometry.offsets, geometry.edges) else "not rigid")
    parts.append(f"safe distance {fleet.formation.safe_distance_m:.4g} m")
    if fleet.formation.offsets is None and n > 1:
        parts.append("places found from the distances")
    if fleet.formation.assign:
        parts.append("robots take the places nearest to them")
    return ", ".join(parts)


def _describe_law(fleet: Fleet, geometry: Geometry) -> str:
    control, coupling = fleet.control, coupling_of(fleet)
    if coupling is None:
        settings = [plain(section) for _, section in control.sections]
        own = "".join(f" {name} {show(value)}," for table in settings for name, value in table.items())
        return (
            f"{control.law}, a plugin;{own} c1 {control.c1:g}, c2 {control.c2:g}; at most "
            f"{control.max_acceleration:g} m/s2"
        )
    softness = coupling.softness(geometry) if len(geometry.distances) else np.array([control.k2 or 0.0])
    least, most = float(softness.min()), float(softness.max())
    k2 = f"{least:.3g}" if most - least < 1e-3 * most else f"{least:.3g} to {most:.3g}"
    return (
        f"{coupling.title}; c1 {control.c1:g}, c2 {control.c2:g}, kd {control.kd:g}, k2 {k2}, "
        f"kp {control.kp:g}; at most {control.max_acceleration:g} m/s2"
    )


def _describe_trajectory(fleet: Fleet) -> str:
    section, seconds = fleet.trajectory, fleet.fleet.duration_s
    if section.kind == "hold":
        return f"holds at ({section.start_m[0]:g}, {section.start_m[1]:g}) m"
    if section.kind == "line" and section.velocity_mps is not None:
        vx, vy = section.velocity_mps
        end = (section.start_m[0] + vx * seconds, section.start_m[1] + vy * seconds)
        return (
            f"a line from ({section.start_m[0]:g}, {section.start_m[1]:g}) m at {hypot(vx, vy):.3g} m/s, "
            f"{hypot(vx, vy) * seconds:.3g} m to ({end[0]:.3g}, {end[1]:.3g}) m"
        )
    if section.kind == "circle" and section.radius_m is not None and section.speed_mps is not None:
        turns = section.speed_mps * seconds / (2.0 * pi * section.radius_m)
        return (
            f"a circle of {section.radius_m:g} m radius at {section.speed_mps:g} m/s, "
            f"{'clockwise' if section.clockwise else 'counter-clockwise'}, {turns:.3g} turns"
        )
    legs = trajectory.legs(section)
    cuts = trajectory.corner_distances(section)
    return (
        f"{len(legs) + 1} waypoints, {sum(leg.length for leg in legs):.4g} m at up to "
        f"{max((leg.speed for leg in legs), default=0.0):.3g} m/s, corners passed within {max(cuts):.2g} m, "
        f"at rest after {trajectory.duration(section):.4g} s"
    )


def _describe_safety(fleet: Fleet, geometry: Geometry) -> Iterator[str]:
    reserve = [robot.id for robot in fleet.robots if robot.reserve]
    if reserve:
        stand = "stand" if len(reserve) > 1 else "stands"
        yield f"reserve: {robots(reserve)} {stand} by, without a place, until an order to join"
    settings, obstacles = fleet.avoidance, [obstacle.name for obstacle in obstacles_of(fleet)]
    if not settings.enabled:
        yield "avoidance: off: only edges keep robots apart"
    elif len(fleet.robots) > 1:
        distance, _ = parting(fleet, geometry)
        yield (
            f"avoidance: robots without an edge part below {distance:.3g} m, and listen to each other "
            f"closely below {sensing_distance(fleet, distance):.3g} m"
        )
    if obstacles:
        keep = clearance(settings.clearance_m, fleet.formation.safe_distance_m)
        kept = f", kept {keep:.3g} m away from" if settings.enabled else ", not kept away from"
        yield f"obstacle{'s' * (len(obstacles) > 1)}: {some(obstacles)}{kept}"
    if fleet.geofence is not None:
        xs, ys = zip(*fleet.geofence.points_m, strict=True)
        yield (
            f"geofence: {len(xs)} corners, x from {min(xs):.4g} to {max(xs):.4g} m, y from {min(ys):.4g} to "
            f"{max(ys):.4g} m; robots are pushed back from {FENCE_WARN_M:.3g} m inside of it, and "
            "hold outside"
        )
    if fleet.supervision.deadman_s is not None:
        yield (
            "dead-man's switch: robots hold when no operator's heartbeat has come for "
            f"{fleet.supervision.deadman_s:.3g} s"
        )


def _describe_overload(fleet: Fleet) -> str:
    most = steps(fleet)
    lowest, why = fleet.fleet.rate_hz / (1 << most), why_not(fleet, most + 1)
    rate = (
        f"the rate falls by halves to {lowest:g} Hz, not further: {why}" if most else f"the rate stays: {why}"
    )
    if not fleet.avoidance.enabled:  # nothing keeps their speed
        return rate
    return (
        f"{rate}; robots drive at {100.0 * speed_share(fleet, most + 1):.0f} % of their speed limit at least"
    )


def _describe_vehicles(fleet: Fleet) -> Iterator[str]:
    datum = fleet.datum
    if datum is not None:
        yield (
            f"datum: x = 0, y = 0 is at {datum.latitude_deg:.7f}, {datum.longitude_deg:.7f}, "
            f"{datum.altitude_m:g} m above the sea"
        )
    links = {robot.id: link for robot in fleet.robots if (link := robot.section(MavlinkSection))}
    simulated = [robot for robot, link in links.items() if link.connection == SIMULATOR]
    if simulated:
        yield f"vehicles: {robots(simulated)}, ArduPilot Rovers that are simulated on this machine"
    for robot, link in links.items():
        if robot not in simulated:
            speed = f" at {link.baud} baud" if str(link.connection).startswith("/") else ""
            signed = ", signed" if link.signing_key is not None else ""
            yield f"vehicle: robot {robot}, an ArduPilot Rover on {link.connection}{speed}{signed}"
    for arms, who, alone in (
        (
            False,
            "their operators put them into GUIDED and arm them",
            "its operator puts it into GUIDED and arms it",
        ),
        (
            True,
            "their bridges put them into GUIDED and arm them, by themselves",
            "its bridge puts it into GUIDED and arms it, by itself",
        ),
    ):
        ids = [robot for robot, link in links.items() if link.arm is arms and robot not in simulated]
        if ids:
            yield f"arming of {robots(ids)}: {who if len(ids) > 1 else alone}"


def _describe_faults(fleet: Fleet) -> Iterator[str]:
    everywhere = defaults(fleet.faults)
    if everywhere is not None:
        yield f"faults: {words(everywhere)}, all the time"
    rules = FaultPlan(fleet).file_rules()
    for rule in rules[:FAULTS_SHOWN]:
        yield f"fault {rule.name}: {described(rule)}"
    if len(rules) > FAULTS_SHOWN:
        yield f"and {len(rules) - FAULTS_SHOWN} further faults"


def _describe_start(fleet: Fleet, geometry: Geometry) -> Iterator[str]:
    hands = start_hands(fleet)
    n = len(hands)
    if n > 1:
        i, j = np.triu_indices(n, 1)
        apart = np.hypot(hands[i, 0] - hands[j, 0], hands[i, 1] - hands[j, 1])
        k = int(np.argmin(apart))
        joined = {frozenset(edge) for edge in geometry.edges.tolist()}
        a, b = int(i[k]), int(j[k])
        kind = "share an edge" if frozenset((a, b)) in joined else "share no edge"
        yield (
            f"start: closest are robots {geometry.ids[a]} and {geometry.ids[b]}, hand points {apart[k]:.3g} "
            f"m apart ({kind})"
        )
    safe = fleet.formation.safe_distance_m
    if not len(geometry.edges) or float(geometry.distances.min()) <= safe:
        return
    law = law_of(fleet)
    settling = None if law is None else settling_time(fleet, geometry, law)
    if law is not None and settling is None:
        yield f"settling: edges do not come within {SETTLED:.0%}: the law is unstable at the formation"
    elif settling == 0.0:
        yield f"settling: edges are within {SETTLED:.0%} at the start"
    elif settling is not None:
        yield (
            f"settling: edges within {SETTLED:.0%} after about {settling:.2g} s, half to twice that; longer "
            "where limits or others hinder"
        )
    least = guaranteed_distance(fleet, geometry)
    if least is not None:
        yield (
            f"bound: while nothing is clipped, no edge comes closer than {least:.3f} m ({least - safe:.3f} m "
            "above the safe distance), by the energy at the start"
        )
