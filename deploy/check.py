"""What a fleet will do, and what in its file would go wrong: `handfast check`.

`check` looks for what is valid field by field (`agent.fleet` sees to that) but does not fit together:
distances that contradict places, robots that start too close, gains that the rate cannot carry. It
computes and never drives: everything here is geometry and linear algebra, in well under a second
for a few dozen robots. All findings come at once.

The sampled loop
    Near the formation the law is linear in e = r - r_d, and for every coupling its gains act mode by
    mode. With A the constraint matrix of all edges at the formation, phi ~ A e, and u = -K1 e - K2 edot
    in each mode of these symmetric matrices (mu their eigenvalue):

        joint    A^T (k2 + A A^T)^-1 A            K = (1 - mu) (c1, c2) + mu (kp, kd),  0 <= mu < 1
        edge     A^T (k2 + diag(A A^T))^-1 A      the same, but mu can pass 1: the gap in Theorem 1
        penalty  A^T A                            K = (c1, c2) + mu (kp, kd)

    A mode is a double integrator under a zero-order hold: its sampled eigenvalues are computed, not
    estimated, with the transport delay of one period predicted away (as the agents do) and not. The joint
    law's multipliers move by one sweep a tick; for fleets up to `SWEEP_ROBOTS_MAX` robots these
    dynamics are in the eigenvalues too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from math import atan2, exp, hypot, inf, isfinite, log, pi, sqrt
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent import formation, law, trajectory
from agent.fleet import ControlSection, Fleet, Robot
from agent.formation import FormationError, Geometry
from agent.trajectory import make_trajectory

Level = Literal["error", "warning", "info"]
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
SETTLED: Final = 0.05
"""Share of its distance within which an edge counts as settled."""
_NAMES_SHOWN: Final = 8
_ORDER: Final = {"error": 0, "warning": 1, "info": 2}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that the file's author should know.

    Attributes:
        level: error: it would not work; warning: it may not; info: good to know.
        place: field of the fleet file; arrays count from 1 as in `agent.schema`.
        message: what is found, its values, and what would be right.
    """

    level: Level
    place: str
    message: str

    def __str__(self) -> str:
        return f"{self.level}: {self.place}: {self.message}"


class Mode(NamedTuple):
    """One mode of the linearised formation: u = -k1 e - k2 edot; `shape`: it changes edges' lengths."""

    k1: float
    k2: float
    shape: bool


def check(fleet: Fleet) -> list[Finding]:
    """Everything worth saying about a fleet, errors first. Never raises for a fleet that was parsed."""
    findings = list(_structure(fleet))
    geometry: Geometry | None = None
    if not any(finding.level == "error" for finding in findings):
        try:
            geometry = formation.resolve(fleet)
        except FormationError as error:
            findings.append(Finding("error", "formation.distance_m", _unplaced(str(error))))
    if geometry is not None:
        findings += _shape(fleet, geometry)
        findings += _starts(fleet, geometry)
        if float(geometry.distances.min(initial=inf)) > fleet.formation.safe_distance_m:
            findings += _law(fleet, geometry)
            findings += _loop(fleet, geometry)
    findings += _gains(fleet)
    findings += _motion(fleet, geometry)
    findings += _noise(fleet)
    return sorted(findings, key=lambda finding: _ORDER[finding.level])


# --- formation -----------------------------------------------------------------------------------


def _structure(fleet: Fleet) -> Iterator[Finding]:
    """What must hold before a formation can be resolved."""
    try:
        edges = formation.edge_indices(fleet)
        offsets = formation.given_offsets(fleet)
        distances = formation.given_distances(fleet)
    except FormationError as error:
        yield Finding("error", "formation", str(error))
        return
    try:
        make_trajectory(fleet.trajectory)
    except ValueError as error:
        yield Finding("error", "trajectory", str(error).removeprefix("trajectory."))
    n = len(fleet.robots)
    parts = formation.components(n, edges)
    if len(parts) > 1:
        ids = [[fleet.robots[k].id for k in part] for part in parts]
        shown = ", ".join("{" + _some(part) + "}" for part in ids[:_NAMES_SHOWN])
        more = f" and {len(ids) - _NAMES_SHOWN} more" if len(ids) > _NAMES_SHOWN else ""
        yield Finding(
            "error",
            "formation.edges",
            f"the graph is in {len(parts)} parts, {shown}{more}: robots of different parts know nothing of "
            "each other; add edges that join the parts, or run them as fleets of their own",
        )
    if offsets is not None and distances is not None:
        yield from _contradictions(fleet, formation.edge_lengths(offsets, edges), distances)


def _contradictions(fleet: Fleet, lengths: Floats, distances: Floats) -> Iterator[Finding]:
    each = not isinstance(fleet.formation.distance_m, int | float)
    wrong = np.flatnonzero(np.abs(lengths - distances) > DISTANCE_TOLERANCE * distances)
    for k in wrong.tolist():
        i, j = fleet.formation.edges[k]
        yield Finding(
            "error",
            f"formation.distance_m[{k + 1}]" if each else "formation.distance_m",
            f"edge [{i}, {j}] is to be {distances[k]:.4g} m long, but its offsets are {lengths[k]:.4g} m "
            "apart: "
            "navigation and constraint would work against each other; leave distance_m out (it then comes "
            "from the offsets) or correct one of them",
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
                "distance "
                f"below every distance, at best below {SAFE_SHARE * least:.3g} m",
            )
        elif safe > SAFE_SHARE * least:
            yield Finding(
                "warning",
                "formation.safe_distance_m",
                f"{safe:.4g} m is {safe / least:.0%} of the shortest edge, [{i}, {j}] with {least:.4g} m: "
                f"phi' = 1/(d - r_s) = {1.0 / (least - safe):.3g} 1/m there, a very stiff constraint that "
                "small "
                f"errors excite; take at most {SAFE_SHARE * least:.3g} m, or longer edges",
            )
    joined = {frozenset(edge) for edge in edges.tolist()}
    for i, j, apart in _closer(offsets, safe):
        if frozenset((i, j)) in joined:
            continue
        yield Finding(
            "error",
            "formation.offsets" if fleet.formation.offsets is not None else "formation.distance_m",
            f"robots {ids[i]} and {ids[j]} share no edge and their places are {apart:.3g} m apart, below the "
            f"safe distance {safe:.4g} m: no constraint keeps them apart; move the places or "
            "join them by an edge",
        )
    if fleet.formation.offsets is None and len(distances):
        lengths = formation.edge_lengths(offsets, edges)
        misfit = np.abs(lengths / distances - 1.0)
        if misfit.max() > 1e-4:
            k = int(np.argmax(misfit))
            i, j = (ids[end] for end in edges[k].tolist())
            yield Finding(
                "info",
                "formation.distance_m",
                f"the distances do not quite fit together: edge [{i}, {j}] is to be {distances[k]:.6g} m "
                "long and "
                f"comes to {lengths[k]:.6g} m; the rest stays as a small error, unless they are given more "
                "precisely",
            )
    yield from _rigidity(geometry)


def _rigidity(geometry: Geometry) -> Iterator[Finding]:
    n = len(geometry.ids)
    if n < 2 or formation.is_rigid(geometry.offsets, geometry.edges):
        return
    if not formation.connected(n, geometry.edges):
        return  # an error of its own
    ids = [geometry.ids[k] for k in formation.loose(geometry.offsets, geometry.edges)]
    shift = f"{_robots(ids)} can shift, seen from the others, with every distance kept"
    rank = formation.rigidity_rank(geometry.offsets, geometry.edges)
    if formation.is_collinear(geometry.offsets):
        yield Finding(
            "warning",
            "formation.edges",
            f"all places are in one line, which no set of edges makes rigid: to first order {shift}. "
            "Across the "
            "line only navigation (c1, c2) holds the robots; place one robot off the line for a rigid shape",
        )
        return
    yield Finding(
        "warning",
        "formation.edges",
        f"the distances do not fix the shape (rank {rank} of {2 * n - 3}): {shift}; there only navigation "
        "(c1, c2) "
        f"holds the shape. At least {2 * n - 3 - rank} more edge{'s' if 2 * n - 3 - rank > 1 else ''} to "
        "these "
        "robots would fix it",
    )


def _starts(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Hand points at the start that are closer than the safe distance."""
    safe = fleet.formation.safe_distance_m
    joined = {frozenset(edge) for edge in geometry.edges.tolist()}
    for i, j, apart in _closer(formation.start_hands(fleet), safe):
        edge = frozenset((i, j)) in joined
        a, b = geometry.ids[i], geometry.ids[j]
        where = f"robots {a} and {b} start with their hand points {apart:.3g} m apart"
        if edge:
            yield Finding(
                "error",
                f"robot[{j + 1}]",
                f"{where}; they share an edge and must start more than the safe distance {safe:.4g} m "
                "apart: below "
                "it phi has the wrong sign. Move or turn one of them (the hand point is hand_offset_m ahead)",
            )
        else:
            yield Finding(
                "warning",
                f"robot[{j + 1}]",
                f"{where}, less than the safe distance {safe:.4g} m; they share no edge, so the law does not "
                "part them: move one of them",
            )


def _closer(points: Floats, limit: float) -> Iterator[tuple[int, int, float]]:
    """Pairs of points at most `limit` apart, and their distance."""
    i, j = np.triu_indices(len(points), 1)
    apart = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
    for k in np.flatnonzero(apart <= limit).tolist():
        yield int(i[k]), int(j[k]), float(apart[k])


# --- law -----------------------------------------------------------------------------------------


class _Start(NamedTuple):
    """The law at t = 0: |u| and |e| of every robot, energy E(0) of the whole fleet."""

    demand: Floats
    error: Floats
    energy: float


def _at_start(fleet: Fleet, geometry: Geometry) -> _Start:
    control = fleet.control
    gains = law.Gains(control.kd, control.k2, control.kp)
    x, y, vx, vy, ax, ay = make_trajectory(fleet.trajectory).at(0.0)
    error = (formation.start_hands(fleet) - geometry.offsets - (x, y)).T
    rate = np.broadcast_to(np.array([[-vx], [-vy]]), error.shape)  # the robots start at rest
    navigation = law.navigation_force(np.array([[ax], [ay]]), error, rate, control.c1, control.c2)
    i, j = geometry.edges[:, 0], geometry.edges[:, 1]
    n = len(geometry.ids)
    if not len(i):
        energy = 0.5 * control.k2 * float(control.c1 * np.sum(error**2) + np.sum(rate**2))
        return _Start(np.hypot(*navigation), np.hypot(*error), energy)
    position = error + geometry.offsets.T
    edges = law.edges(
        position[:, i] - position[:, j],
        np.zeros((2, len(i))),
        navigation[:, i] - navigation[:, j],
        geometry.distances,
        fleet.formation.safe_distance_m,
        gains,
    )
    if control.coupling == "joint":
        multipliers = law.multipliers_joint(edges, i, j, n, gains)
    elif control.coupling == "edge":
        multipliers = law.multipliers_edge(edges, gains)
    else:
        multipliers = law.multipliers_penalty(edges, gains)
    total = navigation + law.total_forces(law.forces(edges, multipliers), i, j, n)
    return _Start(np.hypot(*total), np.hypot(*error), law.energy(edges, error, rate, control.c1, gains))


def _law(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Saturation at the start."""
    start = _at_start(fleet, geometry)
    limit = fleet.control.max_acceleration
    over = np.flatnonzero(start.demand > limit)
    if len(over):
        worst = int(np.argmax(start.demand))
        yield Finding(
            "info",
            "control.max_acceleration",
            f"{_robots([geometry.ids[k] for k in over.tolist()])} will be clipped at {limit:.4g} m/s2 at "
            "first: the law "
            f"asks for {start.demand[worst]:.3g} m/s2 of robot {geometry.ids[worst]}, which starts "
            f"{start.error[worst]:.3g} m from its place. The guarantee of the theory holds from where it "
            "is no "
            "longer clipped; start nearer, or raise the limit if the robots can do it",
        )


def _gains(fleet: Fleet) -> Iterator[Finding]:
    control, n = fleet.control, len(fleet.robots)
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
            "(measured: "
            "45 % of random starts not settled in 40 s even with the joint law); 1 is the measured best",
        )
    elif control.kp > KP_HIGH:
        yield Finding(
            "warning",
            "control.kp",
            f"{control.kp:.4g} is above {KP_HIGH:g}: edges become so stiff against navigation that "
            "triangles stay "
            "folded the wrong way (measured: 16 % of random starts at 4); about 1 is the measured best",
        )


def modes(geometry: Geometry, control: ControlSection, safe_distance: float) -> tuple[Mode, ...]:
    """Modes of the law linearised at the formation, 2n of them; see the module's head.

    Raises nothing, but asks for every distance to be above `safe_distance` (m).
    """
    n = len(geometry.ids)
    jacobian = _jacobian(geometry, safe_distance)
    if control.coupling == "edge":
        weight = control.k2 + np.sum(jacobian**2, axis=1)
        values = np.linalg.svd(jacobian / np.sqrt(weight)[:, None], compute_uv=False) ** 2
    else:
        values = np.linalg.svd(jacobian, compute_uv=False) ** 2
    if control.coupling == "joint":
        values = values / (control.k2 + values)
    found = []
    for value in [*values.tolist(), *[0.0] * (2 * n - len(values))][: 2 * n]:
        rest = 1.0 if control.coupling == "penalty" else 1.0 - value
        found.append(
            Mode(rest * control.c1 + value * control.kp, rest * control.c2 + value * control.kd, value > 1e-9)
        )
    return tuple(found)


def _jacobian(geometry: Geometry, safe_distance: float) -> Floats:
    """A of all edges at the formation, (m, 2n): phi' = 1 / (d - r_s) where rho = d (10)."""
    slope = 1.0 / (geometry.distances - safe_distance)
    jacobian: Floats = formation.rigidity_matrix(geometry.offsets, geometry.edges) * slope[:, None]
    return jacobian


def sampled_radius(mode: Mode, rate_hz: float, *, predicted: bool = True) -> float:
    """Largest |eigenvalue| of one mode under a zero-order hold; below 1 it is stable.

    Args:
        rate_hz: of the control loop.
        predicted: the transport delay of one period is predicted away; else the force that acts is
            the one computed a period earlier.
    """
    h = 1.0 / rate_hz
    if predicted:
        matrix = np.array(
            [[1.0 - 0.5 * h * h * mode.k1, h - 0.5 * h * h * mode.k2], [-h * mode.k1, 1.0 - h * mode.k2]]
        )
    else:
        matrix = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [-mode.k1, -mode.k2, 0.0]])
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def sweep_radius(geometry: Geometry, control: ControlSection, safe_distance: float, rate_hz: float) -> float:
    """Largest |eigenvalue| of the sampled joint law with its multipliers moved by one sweep a tick.

    State: e, edot of every robot and the multiplier of every edge, with neighbours predicted exactly.
    lambda' = lambda + W^-1 (A (c1 e + c2 edot) - kd A edot - kp A e - (k2 + A A^T) lambda), the
    sweep of `agent.law`, and u = -c1 e - c2 edot + A^T lambda'.
    """
    jacobian = _jacobian(geometry, safe_distance)
    m, n2 = jacobian.shape
    h = 1.0 / rate_hz
    degree = np.bincount(geometry.edges.ravel(), minlength=n2 // 2)
    slope2 = 1.0 / (geometry.distances - safe_distance) ** 2
    gain = 1.0 / (control.k2 + slope2 * degree[geometry.edges].sum(axis=1))
    sweep = np.hstack(
        [
            (control.c1 - control.kp) * gain[:, None] * jacobian,
            (control.c2 - control.kd) * gain[:, None] * jacobian,
            np.eye(m) - gain[:, None] * (control.k2 * np.eye(m) + jacobian @ jacobian.T),
        ]
    )
    force = (
        np.hstack([-control.c1 * np.eye(n2), -control.c2 * np.eye(n2), np.zeros((n2, m))])
        + jacobian.T @ sweep
    )
    hold = np.hstack([np.eye(n2), h * np.eye(n2), np.zeros((n2, m))])
    velocity = np.hstack([np.zeros((n2, n2)), np.eye(n2), np.zeros((n2, m))])
    matrix = np.vstack([hold + 0.5 * h * h * force, velocity + h * force, sweep])
    return float(np.abs(np.linalg.eigvals(matrix)).max())


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
            f"{softest.k1:.3g} 1/s2 and "
            f"damps with {softest.k2:.3g} 1/s, where both must be above 0 (edges that share a robot "
            "overcorrect "
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
            "predicted "
            f"and no two periods in a row are missed ({gains}); take at least {needed:.3g} Hz, or lower kd "
            "and kp",
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
            "with "
            f"{slow.k1:.3g} 1/s2 and {slow.k2:.3g} 1/s is unstable from {slow.k2 / slow.k1:.3g} s on; "
            "lower kp or raise kd",
        )
    settling = settling_time(fleet, geometry)
    if settling is not None and settling > fleet.fleet.duration_s:
        yield Finding(
            "info",
            "fleet.duration_s",
            f"{fleet.fleet.duration_s:.4g} s may end before the formation stands: with these gains and "
            "starts "
            f"edges need about {settling:.3g} s to come within {SETTLED:.0%}",
        )


def _rate_for(radius: Callable[[float], float], rate: float) -> float:
    """A rate (Hz) near the lowest, at or above `rate`, at which `radius` is below 1; inf if none up to 1 "
    "MHz."""
    while radius(rate) >= 1.0:
        rate *= 1.2
        if rate > 1e6:
            return inf
    return rate


def settling_time(fleet: Fleet, geometry: Geometry) -> float | None:
    """Estimate (s) of when every edge is within `SETTLED` of its distance; None when it never is.

    From the slowest mode that changes edges, as if all of the largest relative error at the start were
    in it: right within a factor of two for assigned slots; a formation that must unfold takes longer.
    """
    safe = fleet.formation.safe_distance_m
    lengths = formation.edge_lengths(formation.start_hands(fleet), geometry.edges)
    error = np.abs(lengths / geometry.distances - 1.0).max(initial=0.0)
    rates = [_decay(mode) for mode in modes(geometry, fleet.control, safe) if mode.shape]
    if not rates or error <= SETTLED:
        return 0.0
    return log(float(error) / SETTLED) / min(rates) if min(rates) > 0.0 else None


def _decay(mode: Mode) -> float:
    """-Re of the slower root of s^2 + k2 s + k1, 1/s."""
    root = mode.k2 * mode.k2 - 4.0 * mode.k1
    if root <= 0.0:
        return 0.5 * mode.k2
    return 2.0 * mode.k1 / (mode.k2 + sqrt(root))


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
            "robots cannot "
            f"follow; {_slower(fleet, control.max_acceleration)}",
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
            f"{_counted('leg', [k for _, k, _ in slowed])} too short for {section.speed_mps:.4g} m/s with "
            f"corner_acceleration = {section.corner_acceleration:.4g} m/s2 and driven slower: leg {k} "
            f"({length:.4g} m) "
            f"at {slowest:.3g} m/s; longer legs or a larger corner_acceleration would be faster",
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
            f"{longest.hand_offset_m:.4g} m: "
            "its centre cannot follow a circle that small; take a radius well above it",
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
            f"{_counted('robot', [fleet.robots[k - 1].id for k in quick])} quick for the hand offset: "
            f"robot {robot.id}'s is "
            f"{robot.hand_offset_m:.4g} m at up to {speed + forming:.3g} m/s (trajectory {speed:.3g}, "
            "forming up "
            f"{forming:.3g}), so its heading may turn by {turn:.2g} rad within one tick at {rate:.4g} Hz, "
            "and the loop "
            f"breaks from about 1 on; take {enough:.3g} m or more, or a higher rate",
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
            f"{_counted('robot', [fleet.robots[k - 1].id for k in weak])} too weak: "
            f"{robot.max_force_n:.4g} N gives robot "
            f"{robot.id} ({robot.mass_kg:.4g} kg) {able[row]:.3g} m/s2, but the trajectory asks for "
            f"{acceleration:.3g} m/s2; "
            f"it takes {acceleration * robot.mass_kg:.3g} N, or a slower trajectory",
        )
    clipped = [row for row, most in able.items() if acceleration <= most < control.max_acceleration]
    if clipped:
        row = min(clipped, key=lambda row: able[row])
        robot = fleet.robots[row - 1]
        yield Finding(
            "info",
            f"robot[{row}].max_force_n",
            f"the drive clips before the law does ({_robots([fleet.robots[k - 1].id for k in clipped])}): "
            f"{robot.max_force_n:.4g} N gives robot {robot.id} ({robot.mass_kg:.4g} kg) {able[row]:.3g} "
            "m/s2, less than "
            f"control.max_acceleration = {control.max_acceleration:.4g}; lower that, so that the law knows",
        )
    for row, robot in rows:
        needed = robot.inertia_kgm2 * acceleration / robot.hand_offset_m  # L tau / J = acceleration across
        if robot.max_torque_nm is not None and needed > robot.max_torque_nm:
            yield Finding(
                "warning",
                f"robot[{row}].max_torque_nm",
                f"{robot.max_torque_nm:.4g} N m, but the trajectory's {acceleration:.3g} m/s2 across the "
                "heading takes "
                f"{needed:.3g} N m of robot {robot.id} (J a / L)",
            )


def _approach_speeds(fleet: Fleet, geometry: Geometry | None) -> Floats:
    """Greatest speed (m/s) that navigation alone gives each robot from its start to its place, (n,).

    From rest at the distance e0: e0 w exp(-z acos(z) / sqrt(1 - z^2)) with w^2 = c1, 2 z w = c2.
    """
    if geometry is None:
        return np.zeros(len(fleet.robots))
    control = fleet.control
    x, y = make_trajectory(fleet.trajectory).at(0.0)[:2]
    away = np.hypot(*(formation.start_hands(fleet) - geometry.offsets - (x, y)).T)
    natural = sqrt(max(control.c1, 0.0))
    damping = control.c2 / (2.0 * natural) if natural > 0.0 else inf
    if damping < 0.999:
        root = sqrt(1.0 - damping * damping)
        share = exp(-damping * atan2(root, damping) / root)
    elif damping < 1.001:
        share = exp(-1.0)
    else:
        share = 1.0 / (2.0 * damping)  # overdamped: the speed is about c1 e / c2, never above it
    speeds: Floats = away * natural * share
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
        f"measurements of {_robots([robot.id for robot in noisy])} are noisy: up to {position:.2g} m and "
        f"{velocity:.2g} m/s "
        f"(standard deviation) at the hand point of robot {worst.id}, which the gains turn into about "
        f"{hypot(k1 * position, k2 * velocity):.2g} m/s2 of commanded acceleration. Distances settle to "
        "about the "
        "noise, not to zero",
    )


# --- description ---------------------------------------------------------------------------------


def describe(fleet: Fleet) -> str:
    """In plain words, several lines: who drives, in what shape, by which law, where to, and how near it gets.

    For a fleet that cannot be resolved it says what it can; `check` says why.
    """
    n, edges = len(fleet.robots), len(fleet.formation.edges)
    about = f": {fleet.fleet.description}" if fleet.fleet.description else ""
    lines = [f"{fleet.fleet.name}{about}"]
    lines.append(
        f"  {n} robot{'s' * (n != 1)} ({_some([robot.id for robot in fleet.robots])}), "
        f"{edges} edge{'s' * (edges != 1)}, {fleet.fleet.rate_hz:g} Hz for {fleet.fleet.duration_s:g} s, "
        f"seed {fleet.fleet.seed}"
    )
    try:
        geometry = formation.resolve(fleet)
        make_trajectory(fleet.trajectory)
    except ValueError as error:
        lines.append(f"  cannot be driven: {error}")
        return "\n".join(lines)
    lines.append(f"  formation: {_describe_shape(fleet, geometry)}")
    lines.append(f"  law: {_describe_law(fleet.control)}")
    lines.append(f"  trajectory: {_describe_trajectory(fleet)}")
    lines += [f"  {line}" for line in _describe_start(fleet, geometry)]
    lines.append(f"  network: {fleet.network.address}, ports from {fleet.network.base_port} up")
    return "\n".join(lines)


def _describe_shape(fleet: Fleet, geometry: Geometry) -> str:
    n = len(geometry.ids)
    parts = []
    if len(geometry.distances):
        least, most = float(geometry.distances.min()), float(geometry.distances.max())
        parts.append(
            f"edges of {least:.4g} m" if most - least < 1e-9 else f"edges of {least:.4g} to {most:.4g} m"
        )
    if n > 1:
        parts.append("rigid" if formation.is_rigid(geometry.offsets, geometry.edges) else "not rigid")
    parts.append(f"safe distance {fleet.formation.safe_distance_m:.4g} m")
    if fleet.formation.offsets is None and n > 1:
        parts.append("places found from the distances")
    if fleet.formation.assign:
        parts.append("robots take the places nearest to them")
    return ", ".join(parts)


def _describe_law(control: ControlSection) -> str:
    name = {
        "joint": "joint multipliers",
        "edge": "edge by edge" if control.kp > 0.0 else "edge by edge, the paper's",
        "penalty": "potential field",
    }[control.coupling]
    return (
        f"{name}; c1 {control.c1:g}, c2 {control.c2:g}, kd {control.kd:g}, k2 {control.k2:g}, kp "
        f"{control.kp:g}; "
        f"at most {control.max_acceleration:g} m/s2"
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


def _describe_start(fleet: Fleet, geometry: Geometry) -> Iterator[str]:
    hands = formation.start_hands(fleet)
    n = len(hands)
    if n > 1:
        i, j = np.triu_indices(n, 1)
        apart = np.hypot(hands[i, 0] - hands[j, 0], hands[i, 1] - hands[j, 1])
        k = int(np.argmin(apart))
        joined = {frozenset(edge) for edge in geometry.edges.tolist()}
        a, b = int(i[k]), int(j[k])
        kind = "share an edge" if frozenset((a, b)) in joined else "share no edge"
        yield (
            f"start: closest are robots {geometry.ids[a]} and {geometry.ids[b]}, hand points "
            f"{apart[k]:.3g} m apart "
            f"({kind})"
        )
    safe = fleet.formation.safe_distance_m
    if not len(geometry.edges) or float(geometry.distances.min()) <= safe:
        return
    control = fleet.control
    settling = settling_time(fleet, geometry)
    if settling is None:
        yield f"settling: edges do not come within {SETTLED:.0%}: the law is unstable at the formation"
    else:
        yield f"settling: edges within {SETTLED:.0%} after about {settling:.2g} s"
    lengths = formation.edge_lengths(hands, geometry.edges)
    if control.coupling == "joint" and control.kp > 0.0 and float(lengths.min()) > safe:
        energy = _at_start(fleet, geometry).energy
        shortest = float(geometry.distances.min())
        # |phi| <= sqrt(2 E(0) / kp) for all time, and phi = (rho - d) / (rho - r_s): facts/control-law.md
        least = safe + (shortest - safe) / (1.0 + sqrt(2.0 * energy / control.kp))
        if isfinite(least):
            yield (
                f"bound: while nothing is clipped, no edge comes closer than {least:.3g} m "
                f"({1000.0 * (least - safe):.2g} mm above the safe distance), by the energy at the start"
            )


def _robots(ids: Iterable[Any]) -> str:
    shown = list(ids)
    return f"robot{'s' * (len(shown) != 1)} {_some(shown)}"


def _counted(name: str, numbers: Iterable[Any]) -> str:
    """'leg 2 is' or 'legs 2, 3 are'."""
    shown = list(numbers)
    return f"{name} {_some(shown)} is" if len(shown) == 1 else f"{name}s {_some(shown)} are"


def _some(ids: Iterable[Any]) -> str:
    """'1, 2, 3' or '1, 2, ... and 37 more'."""
    shown = list(ids)
    text = ", ".join(str(number) for number in islice(shown, _NAMES_SHOWN))
    return f"{text} and {len(shown) - _NAMES_SHOWN} more" if len(shown) > _NAMES_SHOWN else text
