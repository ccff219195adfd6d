"""Do trajectory, bodies and measurements suit each other: speeds, forces, hand offsets, noise."""

from __future__ import annotations

from collections.abc import Iterator
from math import atan2, exp, hypot, inf, pi, sqrt
from typing import Final

import numpy as np

from handfast.agent.control.limits import TURN_MAX, barrier_rate, speed_max
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import Robot
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry, start_hands
from handfast.agent.formation.points import Floats
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.check.finding import Finding
from handfast.deploy.console.wording import counted, robots, some, speed_limit

TURN_PER_TICK_WARN: Final = 0.5
FAST_SHARE: Final = 0.9
"""Of the speed limit: a faster trajectory leaves too little to catch up with."""
TURN_BACK_RAD: Final = 0.92 * pi
"""A reference that turns by more drives bodies backwards."""
_SWING: Final = 4.0
_SWING_S: Final = 0.5
"""Bodies driven back faster than `_SWING` p L swing round as slowly as (F9) lets them; where the reference
is so fast within `_SWING_S` p L/a they fall behind by 0.15 m to 1.5 m (two robots, 0.2 to 0.7 m/s, 0.5 to 3
m/s^2, corners of 0.05 to 0.5 m/s^2), elsewhere by up to 0.2 m."""
TURN_PER_TICK_MAX: Final = 2.0
"""V / (L rate), what a robot driven across its heading turns in one tick, rad.

The heading follows the hand with thetadot = V / L sin(.); held over a period this has the multiplier
1 - V / (L rate), unstable from 2 on. Measured with unicycles turned by 90 to 179 degrees, the loop
broke between 1 and 1.5 at 150 degrees and beyond; half of that is the warning.
"""


def check_motion(fleet: Fleet, geometry: Geometry | None) -> Iterator[Finding]:
    """Does the trajectory suit the law's limits, the bodies and the run's length."""
    section, control = fleet.trajectory, fleet.control
    try:
        speed = trajectory.maximum_speed(section)
        acceleration = trajectory.maximum_acceleration(section)
        ends = trajectory.duration(section)
    except ValueError:
        return  # `deploy.check.shape` says so
    place = "trajectory.corner_acceleration" if section.kind == "waypoints" else "trajectory.speed_mps"
    source = (
        f"a corner_acceleration of {acceleration:.3g} m/s2"
        if section.kind == "waypoints"
        else f"{speed:.3g} m/s on a circle of {section.radius_m} m ({acceleration:.3g} m/s2 to its centre)"
    )
    if acceleration > control.max_acceleration:
        yield Finding(
            "error",
            place,
            f"{source} is more than control.max_acceleration = {control.max_acceleration:.4g} m/s2: the "
            f"robots cannot follow; {_slower(fleet, control.max_acceleration)}",
        )
    elif acceleration > 0.5 * control.max_acceleration:
        yield Finding(
            "warning",
            place,
            f"{source} takes {acceleration / control.max_acceleration:.0%} of control.max_acceleration = "
            f"{control.max_acceleration:.4g} m/s2 and leaves little to form up with; "
            f"{_slower(fleet, 0.5 * control.max_acceleration)}",
        )
    yield from _speed(fleet, speed)
    if ends is not None and 0.0 < ends < fleet.fleet.duration_s:
        yield Finding(
            "info",
            "trajectory",
            f"comes to rest after {ends:.4g} s, before the run ends at {fleet.fleet.duration_s:.4g} s: the "
            "formation then stands",
        )
    if ends is not None and ends > fleet.fleet.duration_s:
        yield Finding(
            "info",
            "trajectory",
            f"needs {ends:.4g} s, but fleet.duration_s = {fleet.fleet.duration_s:.4g}: it is not driven to "
            "its end",
        )
    slowed = [
        (leg.speed, k, leg.length)
        for k, leg in enumerate(trajectory.legs(section), 1)
        if section.speed_mps is not None and leg.speed < section.speed_mps
    ]
    if slowed:
        slowest, k, length = min(slowed)
        yield Finding(
            "info",
            "trajectory.waypoints_m",
            f"{counted('leg', [k for _, k, _ in slowed])} too short for {section.speed_mps:.4g} m/s with "
            f"corner_acceleration = {section.corner_acceleration:.4g} m/s2 and driven slower: leg {k} "
            f"({length:.4g} m) at {slowest:.3g} m/s; longer legs or a larger corner_acceleration would be "
            "faster",
        )
    yield from _turning_back(fleet)
    yield from _bodies(fleet, geometry, speed, acceleration)


def _turning_back(fleet: Fleet) -> Iterator[Finding]:
    """Waypoints at which the formation turns back, and bodies have to turn about at once, (F9)."""
    section = fleet.trajectory
    back = [k for k, turn in enumerate(trajectory.corner_turns(section), 1) if turn > TURN_BACK_RAD]
    if not back or not fleet.avoidance.enabled:
        return
    rate = barrier_rate(fleet)
    shortest = min(fleet.robots, key=lambda robot: robot.hand_offset_m)
    able = rate * shortest.hand_offset_m
    wanted = section.corner_acceleration
    if able >= _SWING_S * wanted or (section.speed_mps or 0.0) <= _SWING * able:
        return
    yield Finding(
        "warning",
        "trajectory.corner_acceleration",
        f"the course turns back at waypoint{'s' * (len(back) != 1)} {some(back)} with {wanted:.4g} m/s2: "
        f"robot {shortest.id}, whose hand is {shortest.hand_offset_m:.4g} m ahead, cannot turn about so soon "
        f"and falls behind at each of them; take at most {able / _SWING_S:.2g} m/s2, or a longer "
        "hand_offset_m",
    )


def _speed(fleet: Fleet, speed: float) -> Iterator[Finding]:
    """The trajectory's speed and turning against the limits that the safety filter keeps, (F6), (F9).

    A formation keeps its directions while it follows its trajectory: all its places move alike.
    """
    if not fleet.avoidance.enabled:
        return
    section, most, limit = fleet.trajectory, speed_max(fleet), speed_limit(fleet)
    place = f"trajectory.{'velocity_mps' if section.kind == 'line' else 'speed_mps'}"
    control = fleet.control
    if most < control.max_speed_mps:
        yield Finding(
            "info",
            "control.max_speed_mps",
            f"{control.max_speed_mps:.4g} m/s is not made use of: with control.max_acceleration = "
            f"{control.max_acceleration:.4g} m/s2 robots brake and turn too slowly from more than "
            f"{most:.4g} m/s to come to rest at their places; that takes max_speed_mps c1/c2 = "
            f"{control.max_speed_mps * control.c1 / control.c2:.3g} m/s2",
        )
    if speed > most:
        yield Finding(
            "error",
            place,
            f"{speed:.4g} m/s is faster than {limit}: all robots fall behind, by "
            f"{speed - most:.3g} m in every second; take at most {FAST_SHARE * most:.3g} m/s, so that who is "
            f"late can catch up, or a limit of {1.005 * speed / FAST_SHARE:.3g}",
        )
    elif speed > FAST_SHARE * most:
        yield Finding(
            "warning",
            place,
            f"{speed:.4g} m/s leaves {most - speed:.2g} m/s of {limit} to catch "
            f"up with: a robot 1 m behind its place takes {1.0 / (most - speed):.3g} s or more; take at most "
            f"{FAST_SHARE * most:.3g} m/s, or a higher limit"
            if speed < most
            else f"{speed:.4g} m/s is all of {limit}: who is behind its place stays behind; "
            f"take at most {FAST_SHARE * most:.3g} m/s, or a higher limit",
        )
    if section.kind != "circle" or section.radius_m is None:
        return
    turning, able = speed / section.radius_m, TURN_MAX * fleet.fleet.rate_hz
    if turning > able:
        yield Finding(
            "error",
            place,
            f"{speed:.4g} m/s on a circle of {section.radius_m:.4g} m turns by {turning:.3g} rad/s, and at "
            f"{fleet.fleet.rate_hz:.4g} Hz a body may turn by {able:.3g} rad/s: the robots cannot follow; "
            f"take at most {0.9 * able * section.radius_m:.3g} m/s, a radius of "
            f"{speed / (0.9 * able):.3g} m, or {turning / (0.9 * TURN_MAX):.3g} Hz",
        )


def _slower(fleet: Fleet, limit: float) -> str:
    section = fleet.trajectory
    if section.kind == "waypoints":
        return f"take corner_acceleration = {limit:.3g} or less"
    radius = section.radius_m or 0.0
    return f"take speed_mps = {sqrt(limit * radius):.3g} or less, or a larger radius_m"


def _bodies(fleet: Fleet, geometry: Geometry | None, speed: float, acceleration: float) -> Iterator[Finding]:
    """Hand offsets, force and torque limits (5) against what is asked; one finding for all robots that "
    "share it."""
    section, control, rate = fleet.trajectory, fleet.control, fleet.fleet.rate_hz
    rows = list(enumerate(fleet.robots, 1))
    # The centre of a robot whose hand drives a circle of radius R drives one of sqrt(R^2 - L^2).
    longest = max(fleet.robots, key=lambda robot: robot.hand_offset_m)
    if (
        section.kind == "circle"
        and section.radius_m is not None
        and section.radius_m <= longest.hand_offset_m
    ):
        yield Finding(
            "error",
            "trajectory.radius_m",
            f"{section.radius_m:.4g} m is not above the hand offset of robot {longest.id}, "
            f"{longest.hand_offset_m:.4g} m: its centre cannot follow a circle that small; take a radius "
            "well above it",
        )
    approach = _approach_speeds(fleet, geometry)
    # With avoidance (F9) keeps every turn within a tick small.
    turns = [
        0.0 if fleet.avoidance.enabled else (speed + approach[row - 1]) / (robot.hand_offset_m * rate)
        for row, robot in rows
    ]
    quick = [row for row, turn in enumerate(turns, 1) if turn > TURN_PER_TICK_WARN]
    if quick:
        row = max(quick, key=lambda row: turns[row - 1])
        robot, turn, forming = fleet.robots[row - 1], turns[row - 1], approach[row - 1]
        enough = (speed + forming) / (TURN_PER_TICK_WARN * rate)
        yield Finding(
            "error" if turn >= TURN_PER_TICK_MAX else "warning",
            f"robot[{row}].hand_offset_m",
            f"{counted('robot', [fleet.robots[k - 1].id for k in quick])} quick for the hand offset: "
            f"robot {robot.id}'s is {robot.hand_offset_m:.4g} m at up to {speed + forming:.3g} m/s "
            f"(trajectory {speed:.3g}, forming up {forming:.3g}), so its heading may turn by {turn:.2g} rad "
            f"within one tick at {rate:.4g} Hz, and the loop breaks from about 1 on; take {enough:.3g} m or "
            "more, or a higher rate",
        )
    able = {row: robot.max_force_n / robot.mass_kg for row, robot in rows if robot.max_force_n is not None}
    weak = [row for row, most in able.items() if most < acceleration]
    if weak:
        row = min(weak, key=lambda row: able[row])
        robot = fleet.robots[row - 1]
        # On a circle the wheels' side force does it, not the drive; legs begin and end along the heading.
        yield Finding(
            "error" if section.kind == "waypoints" else "warning",
            f"robot[{row}].max_force_n",
            f"{counted('robot', [fleet.robots[k - 1].id for k in weak])} too weak: {robot.max_force_n:.4g} N "
            f"gives robot {robot.id} ({robot.mass_kg:.4g} kg) {able[row]:.3g} m/s2, but the trajectory asks "
            f"for {acceleration:.3g} m/s2; it takes {acceleration * robot.mass_kg:.3g} N, or a slower "
            "trajectory",
        )
    clipped = [row for row, most in able.items() if acceleration <= most < control.max_acceleration]
    if clipped:
        row = min(clipped, key=lambda row: able[row])
        robot = fleet.robots[row - 1]
        yield Finding(
            "info",
            f"robot[{row}].max_force_n",
            f"the drive clips before the law does ({robots([fleet.robots[k - 1].id for k in clipped])}): "
            f"{robot.max_force_n:.4g} N gives robot {robot.id} ({robot.mass_kg:.4g} kg) {able[row]:.3g} "
            f"m/s2, less than control.max_acceleration = {control.max_acceleration:.4g}; lower that, so "
            "that the law knows",
        )
    for row, robot in rows:
        needed = robot.inertia_kgm2 * acceleration / robot.hand_offset_m  # L tau / J = acceleration across
        if robot.max_torque_nm is not None and needed > robot.max_torque_nm:
            yield Finding(
                "warning",
                f"robot[{row}].max_torque_nm",
                f"{robot.max_torque_nm:.4g} N m, but the trajectory's {acceleration:.3g} m/s2 across the "
                f"heading takes {needed:.3g} N m of robot {robot.id} (J a / L)",
            )


def _approach_speeds(fleet: Fleet, geometry: Geometry | None) -> Floats:
    """Greatest speed (m/s) that navigation alone gives each robot from its start to its place, (n,).

    From rest at the distance e0: e0 w exp(-z acos(z) / sqrt(1 - z^2)) with w^2 = c1, 2 z w = c2. For a fleet
    without avoidance, whose pull no limit cuts (N1); 0 for robots in reserve.
    """
    if geometry is None:
        return np.zeros(len(fleet.robots))
    control = fleet.control
    x, y = make_trajectory(fleet.trajectory).at(0.0)[:2]
    away = np.hypot(*(start_hands(fleet) - geometry.offsets - (x, y)).T)
    natural = sqrt(max(control.c1, 0.0))
    damping = control.c2 / (2.0 * natural) if natural > 0.0 else inf
    if damping < 0.999:
        root = sqrt(1.0 - damping * damping)
        share = exp(-damping * atan2(root, damping) / root)
    elif damping < 1.001:
        share = exp(-1.0)
    else:
        share = 1.0 / (2.0 * damping)  # overdamped: the speed is about c1 e / c2, never above it
    speeds = np.zeros(len(fleet.robots))
    speeds[[fleet.index(robot) for robot in geometry.ids]] = away * natural * share
    return speeds


def check_noise(fleet: Fleet) -> Iterator[Finding]:
    """How much commanded acceleration the gains make of measurement noise."""
    noisy = [robot for robot in fleet.robots if max(robot.position_noise_m, robot.heading_noise_rad) > 0.0]
    if not noisy:
        return
    control = fleet.control

    def hand(robot: Robot) -> float:
        return hypot(robot.position_noise_m, robot.hand_offset_m * robot.heading_noise_rad)

    worst = max(noisy, key=hand)
    yield Finding(
        "info",
        "robot",
        f"measurements of {robots([robot.id for robot in noisy])} are noisy: up to {hand(worst):.2g} m "
        f"(standard deviation) at the hand point of robot {worst.id}, which the gains turn into about "
        f"{max(control.c1, control.kp) * hand(worst):.2g} m/s2 of commanded acceleration. "
        "Distances settle to about the noise, not to zero",
    )
