"""What a fleet will do, and what in its file would go wrong: `handfast check`.

`check` looks for what is valid field by field (`agent.fleet.fleet` sees to that) but does not fit together:
distances that contradict places, robots that start too close, gains that the rate cannot carry. It
computes and never drives: everything here is geometry and linear algebra, in well under a second
for a few dozen robots. All findings come at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import atan2, exp, hypot, inf, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agent.fleet.fleet import Fleet
from agent.fleet.sections import Robot
from agent.formation import trajectory
from agent.formation.geometry import (
    FormationError,
    Geometry,
    components,
    connected,
    edge_indices,
    edge_lengths,
    given_distances,
    given_offsets,
    is_collinear,
    is_rigid,
    loose,
    resolve,
    rigidity_rank,
    start_hands,
)
from agent.formation.trajectory import make_trajectory
from deploy.analysis.stability import (
    SETTLED,
    Mode,
    at_start,
    modes,
    sampled_radius,
    settling_time,
    sweep_radius,
)
from deploy.check.faults import check_faults
from deploy.check.finding import Finding
from deploy.check.orders import check_orders
from deploy.check.safety import check_safety, start_points
from deploy.check.vehicles import check_vehicles
from deploy.console.wording import NAMES_SHOWN, counted, robots, some

__all__ = ["Finding", "check"]

Floats = NDArray[np.float64]

SWEEP_ROBOTS_MAX: Final = 60
"""Largest fleet whose multiplier sweeps are in the sampled eigenvalues: their matrix grows with n."""
DISTANCE_TOLERANCE: Final = 0.01
"""Distances further than this share from what the offsets say contradict them."""
SAFE_SHARE: Final = 0.8
"""r_s / d above which phi' = 1 / (d - r_s) makes the constraint very stiff."""
KP_HIGH: Final = 4.0
"""k_p above which wrong local minima were measured (facts: 84 % of random starts converged at 4)."""
TURN_PER_TICK_WARN: Final = 0.5
TURN_PER_TICK_MAX: Final = 2.0
"""V / (L rate), what a robot driven across its heading turns in one tick, rad.

The heading follows the hand with thetadot = V / L sin(.); held over a period this has the multiplier
1 - V / (L rate), unstable from 2 on. Measured with unicycles turned by 90 to 179 degrees, the loop
broke between 1 and 1.5 at 150 degrees and beyond; half of that is the warning.
"""
_ORDER: Final = {"error": 0, "warning": 1, "info": 2}


def check(fleet: Fleet) -> list[Finding]:
    """Everything worth saying about a fleet, errors first. Never raises for a fleet that was parsed."""
    findings = list(_structure(fleet))
    geometry: Geometry | None = None
    if not any(finding.level == "error" for finding in findings):
        try:
            geometry = resolve(fleet)
        except FormationError as error:
            findings.append(Finding("error", "formation.distance_m", _unplaced(str(error))))
    if geometry is not None:
        findings += _shape(fleet, geometry)
        findings += _starts(fleet, geometry)
        if float(geometry.distances.min(initial=inf)) > fleet.formation.safe_distance_m:
            findings += _law(fleet, geometry)
            findings += _loop(fleet, geometry)
        findings += check_orders(fleet, geometry)
    findings += _gains(fleet)
    findings += _motion(fleet, geometry)
    findings += _noise(fleet)
    findings += check_safety(fleet, geometry)
    findings += check_vehicles(fleet)
    findings += check_faults(fleet)
    return sorted(findings, key=lambda finding: _ORDER[finding.level])


# --- formation -----------------------------------------------------------------------------------


def _structure(fleet: Fleet) -> Iterator[Finding]:
    """What must hold before a formation can be resolved."""
    try:
        edges = edge_indices(fleet)
        offsets = given_offsets(fleet)
        distances = given_distances(fleet)
    except FormationError as error:
        yield Finding("error", "formation", str(error))
        return
    try:
        make_trajectory(fleet.trajectory)
    except ValueError as error:
        yield Finding("error", "trajectory", str(error).removeprefix("trajectory."))
    parts = components(len(fleet.members), edges)
    if len(parts) > 1:
        ids = [[fleet.members[k].id for k in part] for part in parts]
        shown = ", ".join("{" + some(part) + "}" for part in ids[:NAMES_SHOWN])
        more = f" and {len(ids) - NAMES_SHOWN} more" if len(ids) > NAMES_SHOWN else ""
        yield Finding(
            "error",
            "formation.edges",
            f"the graph is in {len(parts)} parts, {shown}{more}: robots of different parts know nothing of "
            "each other; add edges that join the parts, or run them as fleets of their own",
        )
    if offsets is not None and distances is not None:
        yield from _contradictions(fleet, edge_lengths(offsets, edges), distances)


def _contradictions(fleet: Fleet, lengths: Floats, distances: Floats) -> Iterator[Finding]:
    each = not isinstance(fleet.formation.distance_m, int | float)
    wrong = np.flatnonzero(np.abs(lengths - distances) > DISTANCE_TOLERANCE * distances)
    for k in wrong.tolist():
        i, j = fleet.formation.edges[k]
        yield Finding(
            "error",
            f"formation.distance_m[{k + 1}]" if each else "formation.distance_m",
            f"edge [{i}, {j}] is to be {distances[k]:.4g} m long, but its offsets are {lengths[k]:.4g} m "
            "apart: navigation and constraint would work against each other; leave distance_m out (it then "
            "comes from the offsets) or correct one of them",
        )


def _unplaced(message: str) -> str:
    return (
        message.removeprefix("formation.distance_m: ")
        + "; correct the distances, leave an edge out, or give offsets"
    )


def _shape(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """The formation itself: safe distance, rigidity."""
    ids, offsets, edges, distances = geometry.ids, geometry.offsets, geometry.edges, geometry.distances
    safe = fleet.formation.safe_distance_m
    if len(distances):
        k = int(np.argmin(distances))
        least = float(distances[k])
        i, j = (ids[end] for end in edges[k].tolist())
        if least <= safe:
            yield Finding(
                "error",
                "formation.safe_distance_m",
                f"{safe:.4g} m, but edge [{i}, {j}] is to be {least:.4g} m long: phi (7) needs a safe "
                f"distance below every distance, at best below {SAFE_SHARE * least:.3g} m",
            )
        elif safe > SAFE_SHARE * least:
            yield Finding(
                "warning",
                "formation.safe_distance_m",
                f"{safe:.4g} m is {safe / least:.0%} of the shortest edge, [{i}, {j}] with {least:.4g} m: "
                f"phi' = 1/(d - r_s) = {1.0 / (least - safe):.3g} 1/m there, a very stiff constraint that "
                f"small errors excite; take at most {SAFE_SHARE * least:.3g} m, or longer edges",
            )
    joined = {frozenset(edge) for edge in edges.tolist()}
    both = "they cannot both stand there" if fleet.avoidance.enabled else "no constraint keeps them apart"
    for i, j, apart in _closer(offsets, safe):
        if frozenset((i, j)) in joined:
            continue
        yield Finding(
            "error",
            "formation.offsets" if fleet.formation.offsets is not None else "formation.distance_m",
            f"robots {ids[i]} and {ids[j]} share no edge and their places are {apart:.3g} m apart, below the "
            f"safe distance {safe:.4g} m: {both}; move the places or join them by an edge",
        )
    if fleet.formation.offsets is None and len(distances):
        lengths = edge_lengths(offsets, edges)
        misfit = np.abs(lengths / distances - 1.0)
        if misfit.max() > 1e-4:
            k = int(np.argmax(misfit))
            i, j = (ids[end] for end in edges[k].tolist())
            yield Finding(
                "info",
                "formation.distance_m",
                f"the distances do not quite fit together: edge [{i}, {j}] is to be {distances[k]:.6g} m "
                f"long and comes to {lengths[k]:.6g} m; the rest stays as a small error, unless they are "
                "given more precisely",
            )
    yield from _rigidity(geometry)


def _rigidity(geometry: Geometry) -> Iterator[Finding]:
    n = len(geometry.ids)
    if n < 2 or is_rigid(geometry.offsets, geometry.edges):
        return
    if not connected(n, geometry.edges):
        return  # an error of its own
    ids = [geometry.ids[k] for k in loose(geometry.offsets, geometry.edges)]
    shift = f"{robots(ids)} can shift, seen from the others, with every distance kept"
    rank = rigidity_rank(geometry.offsets, geometry.edges)
    if is_collinear(geometry.offsets):
        yield Finding(
            "warning",
            "formation.edges",
            f"all places are in one line, which no set of edges makes rigid: to first order {shift}. "
            "Across the line only navigation (c1, c2) holds the robots; place one robot off the line for a "
            "rigid shape",
        )
        return
    yield Finding(
        "warning",
        "formation.edges",
        f"the distances do not fix the shape (rank {rank} of {2 * n - 3}): {shift}; there only navigation "
        f"(c1, c2) holds the shape. At least {2 * n - 3 - rank} more "
        f"edge{'s' if 2 * n - 3 - rank > 1 else ''} to these robots would fix it",
    )


def _starts(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Hand points at the start that are closer than the safe distance."""
    safe = fleet.formation.safe_distance_m
    joined = {frozenset((geometry.ids[i], geometry.ids[j])) for i, j in geometry.edges.tolist()}
    for i, j, apart in _closer(start_points(fleet), safe):
        a, b = fleet.ids[i], fleet.ids[j]
        edge = frozenset((a, b)) in joined
        where = f"robots {a} and {b} start with their hand points {apart:.3g} m apart"
        if edge:
            yield Finding(
                "error",
                f"robot[{j + 1}]",
                f"{where}; they share an edge and must start more than the safe distance {safe:.4g} m "
                "apart: below it phi has the wrong sign. Move or turn one of them (the hand point is "
                "hand_offset_m ahead)",
            )
        else:
            parted = (
                "and avoidance has to part them first"
                if fleet.avoidance.enabled
                else "so the law does not part them"
            )
            yield Finding(
                "warning",
                f"robot[{j + 1}]",
                f"{where}, less than the safe distance {safe:.4g} m; they share no edge, {parted}: move one "
                "of them",
            )


def _closer(points: Floats, limit: float) -> Iterator[tuple[int, int, float]]:
    """Pairs of points at most `limit` apart, and their distance."""
    i, j = np.triu_indices(len(points), 1)
    apart = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
    for k in np.flatnonzero(apart <= limit).tolist():
        yield int(i[k]), int(j[k]), float(apart[k])


# --- law -----------------------------------------------------------------------------------------


def _law(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Saturation at the start."""
    start = at_start(fleet, geometry)
    limit = fleet.control.max_acceleration
    over = np.flatnonzero(start.demand > limit)
    if len(over):
        worst = int(np.argmax(start.demand))
        yield Finding(
            "info",
            "control.max_acceleration",
            f"{robots([geometry.ids[k] for k in over.tolist()])} will be clipped at {limit:.4g} m/s2 at "
            f"first: the law asks for {start.demand[worst]:.3g} m/s2 of robot {geometry.ids[worst]}, which "
            f"starts {start.error[worst]:.3g} m from its place. The guarantee of the theory holds from where "
            "it is no longer clipped; start nearer, or raise the limit if the robots can do it",
        )


def _gains(fleet: Fleet) -> Iterator[Finding]:
    control, n = fleet.control, len(fleet.members)
    if control.coupling == "edge" and n > 2:
        name = "the paper's law" if control.kp == 0.0 else 'the law edge by edge (coupling = "edge")'
        yield Finding(
            "info",
            "control.coupling",
            f"{name} is not proved stable for {n} robots: a robot with several edges feels forces that "
            "(33) leaves "
            'out (docs/theory.md). coupling = "joint" is proved',
        )
    if control.coupling == "penalty":
        yield Finding(
            "info",
            "control.coupling",
            'the potential-field law (coupling = "penalty") is a yardstick: its forces are not bounded '
            "near the safe "
            'distance and compete with navigation (docs/theory.md). coupling = "joint" is the one to drive '
            "with",
        )
    if control.kp == 0.0:
        yield Finding(
            "info",
            "control.kp",
            "0: nothing pulls an edge back to its distance but navigation, so close pairs creep apart "
            "(measured: 45 % of random starts not settled in 40 s even with the joint law); 1 is the "
            "measured best",
        )
    elif control.kp > KP_HIGH:
        yield Finding(
            "warning",
            "control.kp",
            f"{control.kp:.4g} is above {KP_HIGH:g}: edges become so stiff against navigation that "
            "triangles stay folded the wrong way (measured: 16 % of random starts at 4); about 1 is the "
            "measured best",
        )


def _loop(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Is the law stable at the formation: as it is, sampled, and with its delay not predicted."""
    control, rate = fleet.control, fleet.fleet.rate_hz
    safe = fleet.formation.safe_distance_m
    linear = modes(geometry, control, safe)
    if not linear:
        return
    softest = min(linear, key=lambda mode: min(mode.k1, mode.k2))
    if min(softest.k1, softest.k2) <= 0.0:
        yield Finding(
            "error",
            "control.coupling",
            "the law is unstable at the formation itself: in one of its modes it pulls with "
            f"{softest.k1:.3g} 1/s2 and damps with {softest.k2:.3g} 1/s, where both must be above 0 (edges "
            "that share a robot overcorrect "
            'each other); take coupling = "joint", or kp of about 1',
        )
        return
    # Near the safe distance phi' grows without limit and the joint law's modes become (kp, kd).
    extreme = (
        (*linear, Mode(control.kp, control.kd, True)) if control.kp > 0.0 and control.kd > 0.0 else linear
    )

    def radius(at: float, predicted: bool) -> float:
        return max(sampled_radius(mode, at, predicted=predicted) for mode in set(extreme))

    def whole(at: float) -> float:
        result = radius(at, True)
        if control.coupling == "joint" and len(geometry.edges) and len(geometry.ids) <= SWEEP_ROBOTS_MAX:
            result = max(result, sweep_radius(geometry, control, safe, at))
        return result

    stiffest = max(extreme, key=lambda mode: max(mode.k2, sqrt(mode.k1)))
    gains = f"its stiffest mode has {stiffest.k1:.3g} 1/s2 and {stiffest.k2:.3g} 1/s"
    if whole(rate) >= 1.0:
        needed = _rate_for(whole, rate)
        yield Finding(
            "error",
            "fleet.rate_hz",
            f"{rate:.4g} Hz is too slow for these gains: the sampled loop is unstable (largest eigenvalue "
            f"{whole(rate):.4g}; {gains}); take at least {needed:.3g} Hz, or lower kd and kp",
        )
    elif radius(rate, False) >= 1.0 or whole(0.5 * rate) >= 1.0:
        needed = _rate_for(lambda at: max(whole(0.5 * at), radius(at, False)), rate)
        yield Finding(
            "warning",
            "fleet.rate_hz",
            f"{rate:.4g} Hz leaves little margin: the loop is stable only while a delay of one period is "
            f"predicted and no two periods in a row are missed ({gains}); take at least {needed:.3g} Hz, or "
            "lower kd and kp",
        )
    # s^2 (lag s + 1) + K2 s + K1 is stable while K2 > lag K1 (Routh).
    row, robot = max(enumerate(fleet.robots, 1), key=lambda item: item[1].actuator_lag_s)
    slow = max(linear, key=lambda mode: mode.k1 / mode.k2)
    share = robot.actuator_lag_s * slow.k1 / slow.k2
    if share > 0.5:
        yield Finding(
            "error" if share >= 1.0 else "warning",
            f"robot[{row}].actuator_lag_s",
            f"{robot.actuator_lag_s:.4g} s is {'too ' if share >= 1.0 else ''}long for these gains: a mode "
            f"with {slow.k1:.3g} 1/s2 and {slow.k2:.3g} 1/s is unstable from {slow.k2 / slow.k1:.3g} s on; "
            "lower kp or raise kd",
        )
    settling = settling_time(fleet, geometry)
    if settling is not None and settling > fleet.fleet.duration_s:
        yield Finding(
            "info",
            "fleet.duration_s",
            f"{fleet.fleet.duration_s:.4g} s may end before the formation stands: with these gains and "
            f"starts edges need about {settling:.3g} s to come within {SETTLED:.0%}",
        )


def _rate_for(radius: Callable[[float], float], rate: float) -> float:
    """A rate (Hz) near the lowest, at or above `rate`, at which `radius` is below 1; inf if none up
    to 1 MHz."""
    while radius(rate) >= 1.0:
        rate *= 1.2
        if rate > 1e6:
            return inf
    return rate


# --- trajectory and bodies -----------------------------------------------------------------------


def _motion(fleet: Fleet, geometry: Geometry | None) -> Iterator[Finding]:
    """Does the trajectory suit the law's limits, the bodies and the run's length."""
    section, control = fleet.trajectory, fleet.control
    try:
        speed = trajectory.maximum_speed(section)
        acceleration = trajectory.maximum_acceleration(section)
        ends = trajectory.duration(section)
    except ValueError:
        return  # said by _structure
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
    yield from _bodies(fleet, geometry, speed, acceleration)


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
    turns = [(speed + approach[row - 1]) / (robot.hand_offset_m * rate) for row, robot in rows]
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

    From rest at the distance e0: e0 w exp(-z acos(z) / sqrt(1 - z^2)) with w^2 = c1, 2 z w = c2; 0 for robots
    in reserve.
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


def _noise(fleet: Fleet) -> Iterator[Finding]:
    noisy = [
        robot
        for robot in fleet.robots
        if max(
            robot.position_noise_m, robot.heading_noise_rad, robot.speed_noise_mps, robot.yaw_rate_noise_radps
        )
        > 0.0
    ]
    if not noisy:
        return
    control = fleet.control
    k1, k2 = max(control.c1, control.kp), max(control.c2, control.kd)

    def hand(robot: Robot) -> tuple[float, float]:
        offset = robot.hand_offset_m
        return (
            hypot(robot.position_noise_m, offset * robot.heading_noise_rad),
            hypot(robot.speed_noise_mps, offset * robot.yaw_rate_noise_radps),
        )

    worst = max(noisy, key=lambda robot: hypot(k1 * hand(robot)[0], k2 * hand(robot)[1]))
    position, velocity = hand(worst)
    yield Finding(
        "info",
        "robot",
        f"measurements of {robots([robot.id for robot in noisy])} are noisy: up to {position:.2g} m and "
        f"{velocity:.2g} m/s (standard deviation) at the hand point of robot {worst.id}, which the gains "
        f"turn into about {hypot(k1 * position, k2 * velocity):.2g} m/s2 of commanded acceleration. "
        "Distances settle to about the noise, not to zero",
    )
