"""Can robots do what the safety filter counts on: brake, see each other in time, follow each other."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from math import dist, floor, inf, log10, sqrt
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.limits import (
    acceleration_max,
    barrier_rate,
    speed_max,
)
from handfast.agent.control.peers.beliefs import said_doubt
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.fleet.sections import Robot
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry
from handfast.deploy.check.finding import Finding
from handfast.deploy.console.wording import robots, speed_limit

_ROUNDING: Final = 1e-9
MARGIN_M: Final = 0.05
"""With this margin beyond what the lag asks for, `make chaos` finds no pair below the safe distance."""


def check_braking(fleet: Fleet) -> Iterator[Finding]:
    """What speaks against (F4) of docs/theory.md: p V_max is the braking that keeps every distance."""
    if not fleet.avoidance.enabled:
        return
    rate, control = barrier_rate(fleet), fleet.control
    yield from _unheard(rate, control.wrench_timeout_s)
    most = speed_max(fleet)
    needed = rate * most
    yield from _bodies(fleet, needed)
    yield from _lag(fleet)


def _unheard(rate: float, timeout_s: float) -> Iterator[Finding]:
    """p against how long a body drives on that hears nothing of its agent: (F1) lets two come nearer by p h a
    second where they are h too far. One of them goes on as it went and the other, which sees that, does not
    add to it: so it takes 2 / p to come too near."""
    room_s = 2.0 / rate
    if timeout_s <= room_s * (1.0 + _ROUNDING):
        return
    yield Finding(
        "warning",
        "control.wrench_timeout_s",
        f"{timeout_s:.4g} s: for so long a body goes on as it last went while its agent is late, and what "
        f"keeps distances leaves room for {room_s:.2g} s of that: robots may come nearer than the safe "
        f"distance on a machine that has too much to do; take {_below(room_s)} s or less",
    )


def _bodies(fleet: Fleet, needed: float) -> Iterator[Finding]:
    able = {robot.id: min(_braking(robot), default=(inf, "")) for robot in fleet.robots}
    weak = [robot for robot, (most, _) in able.items() if most < needed * (1.0 - _ROUNDING)]
    if not weak:
        return
    weakest = min(weak, key=lambda robot: able[robot])
    most, field = able[weakest]
    yield Finding(
        "warning",
        "control.max_acceleration",
        f"{robots(weak)} cannot brake as the safety filter counts on: from {speed_limit(fleet)} that takes "
        f"{needed:.3g} m/s2, and {field} of robot {weakest} allows {most:.3g}; set it to "
        f"{_below(most)} or less, or lower the speed",
    )


def _braking(robot: Robot) -> Iterator[tuple[float, str]]:
    """The accelerations (m/s^2) that a body can give its hand, each with the field that limits it."""
    if (link := robot.section(MavlinkSection)) is not None:
        yield link.max_acceleration, "mavlink.max_acceleration"
    if robot.max_force_n is not None:
        yield robot.max_force_n / robot.mass_kg, "max_force_n"
    if robot.max_torque_nm is not None:
        yield robot.hand_offset_m * robot.max_torque_nm / robot.inertia_kgm2, "max_torque_nm"


def check_room(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Places between which one robot cannot follow another at the formation's speed, (F4).

    Raises:
        ValueError: a trajectory that `agent.formation.trajectory` cannot make.
    """
    if not fleet.avoidance.enabled:
        return
    late_s = _late_s(fleet)
    unsure = said_doubt(late_s)
    keep = fleet.formation.safe_distance_m + fleet.avoidance.margin_m
    rate, section = barrier_rate(fleet), fleet.trajectory
    fastest = trajectory.maximum_speed(section)
    closest, tight = [], []
    for (i, a), (j, b) in combinations(zip(geometry.ids, geometry.offsets.tolist(), strict=True), 2):
        apart = dist(a, b)
        if apart < keep * (1.0 - _ROUNDING):
            closest.append((apart, i, j))
        elif apart < keep + unsure + fastest / rate:
            along = trajectory.maximum_speed_along(section, (b[0] - a[0]) / apart, (b[1] - a[1]) / apart)
            possible = rate * (apart - keep - unsure)
            if along > max(0.0, possible) * (1.0 + _ROUNDING):
                tight.append((possible / along, i, j, apart, keep + unsure + along / rate))
    if closest:
        apart, i, j = min(closest)
        more = f" ({len(closest)} such pairs in all)" if len(closest) > 1 else ""
        yield Finding(
            "warning",
            "avoidance.margin_m",
            f"robots {i} and {j} have places {apart:.3g} m apart{more}, and the safety filter keeps robots "
            f"{keep:.3g} m from each other, the safe distance and {fleet.avoidance.margin_m:.3g} m: put them "
            "farther apart, or take less",
        )
    if not tight:
        return
    share, i, j, apart, needed = min(tight)
    more = f" ({len(tight)} such pairs in all)" if len(tight) > 1 else ""
    late = f" and its messages are {late_s:.3g} s late" if unsure else ""
    slower = f"take at most {_below(share * fastest)} m/s, or " if share > 0.0 else ""
    yield Finding(
        "warning",
        f"trajectory.{'velocity_mps' if section.kind == 'line' else 'speed_mps'}",
        f"{fastest:.4g} m/s is too fast for robots {i} and {j}, whose places are {apart:.4g} m apart{more}: "
        f"where one follows the other, the safety filter keeps it {needed:.4g} m behind, so that it can "
        f"brake when the other does{late}; {slower}put them farther apart",
    )


def check_sudden(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Places between which one that stands suddenly on late links is heard of too late.

    Raises:
        ValueError: a trajectory that `agent.formation.trajectory` cannot make.
    """
    late_s = _late_s(fleet)
    if not late_s or not fleet.avoidance.enabled:
        return
    # Its agent misses its plant after a timeout, and a message may be so much later than it usually is.
    blind_s = fleet.control.plant_timeout_s + late_s + UNSURE_NS / NS_PER_S
    keep = fleet.formation.safe_distance_m + fleet.avoidance.margin_m
    braking, section = acceleration_max(fleet), fleet.trajectory
    tight = []
    for (i, a), (j, b) in combinations(zip(geometry.ids, geometry.offsets.tolist(), strict=True), 2):
        apart = dist(a, b)
        if not keep < apart < keep + blind_s * speed_max(fleet) + speed_max(fleet) ** 2 / (2.0 * braking):
            continue
        along = trajectory.maximum_speed_along(section, (b[0] - a[0]) / apart, (b[1] - a[1]) / apart)
        needed = keep + blind_s * along + along * along / (2.0 * braking)
        if needed > apart * (1.0 + _ROUNDING):
            tight.append((apart - needed, i, j, apart, needed, along))
    if not tight:
        return
    _, i, j, apart, needed, along = min(tight)
    more = f" ({len(tight)} such pairs in all)" if len(tight) > 1 else ""
    able = braking * (sqrt(blind_s * blind_s + 2.0 * (apart - keep) / braking) - blind_s)
    yield Finding(
        "warning",
        "faults.delay",
        f"messages that are always {late_s:.3g} s late say so late that a robot stands whose plant or agent "
        f"dies: at {along:.3g} m/s who follows it needs {needed:.3g} m, and robots {i} and {j}{more} are "
        f"{apart:.4g} m apart; put them farther apart, or take at most "
        f"{_below(able * trajectory.maximum_speed(section) / along)} m/s",
    )


def _late_s(fleet: Fleet) -> float:
    """How late messages always are by the fleet file, s."""
    if fleet.faults.delay is None:
        return 0.0
    delay = fleet.faults.delay.start
    return delay.mean + delay.jitter


def _lag(fleet: Fleet) -> Iterator[Finding]:
    """A body that answers late goes on for so long as it did: only the margin allows for that."""
    slowest = max(fleet.robots, key=lambda robot: robot.actuator_lag_s)
    margin, speed = fleet.avoidance.margin_m, speed_max(fleet)
    further = slowest.actuator_lag_s * speed
    if margin < further * (1.0 - _ROUNDING):
        yield Finding(
            "warning",
            "avoidance.margin_m",
            f"{margin:.4g} m does not allow for actuator_lag_s = {slowest.actuator_lag_s:.4g} s of robot "
            f"{slowest.id}, in which it goes {further:.3g} m at {speed_limit(fleet)}: robots "
            f"may come nearer than the safe distance; take {further + MARGIN_M:.3g} m, or lower the speed",
        )


def _below(value: float) -> str:
    """A value > 0 in three digits, rounded down."""
    step = 10.0 ** (floor(log10(value)) - 2)
    return f"{floor(value / step * (1.0 + _ROUNDING)) * step:.3g}"
