"""Couplings for a whole fleet at once, one class for each `control.coupling`: what `check` and analyses ask
of a law by linear algebra.

Pure (numpy only). `agent.control.couplings` has each for one robot's own constraints.

Near the formation the law is linear in e = r - r_d, and for every coupling its gains act mode by mode. With A
the constraint matrix of all edges at the formation, phi ~ A e, and u = -K1 e - K2 edot in each mode of these
symmetric matrices (mu their eigenvalue):

    joint    A^T (K2 + A A^T)^-1 A            K = (1 - mu) (c1, c2) + mu (kp, kd),  0 <= mu < 1
    edge     A^T (K2 + diag(A A^T))^-1 A      the same, but mu can pass 1: the gap in Theorem 1
    penalty  A^T A                            K = (c1, c2) + mu (kp, kd)

K2 is diagonal: the softness of each edge (J4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.common.errors import Error
from handfast.agent.control.limits import gains_of
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry
from handfast.deploy.analysis import fleet_law, patience
from handfast.deploy.analysis.fleet_law import Array, Edges
from handfast.deploy.analysis.shapes import rigidity_matrix

SQUARES_MAX: Final = 12
"""So often a matrix is squared at most to see whether its powers die away: to its 4096th power."""
_HUGE: Final = 1e100


class Mode(NamedTuple):
    """One mode of the linearised formation: u = -k1 e - k2 edot; `shape`: it changes edges' lengths."""

    k1: float
    k2: float
    shape: bool


class FleetLaw:
    """The law of a whole fleet, linearised.

    Attributes:
        place: field of the fleet file that chooses it.
        unstable: what makes it unstable at the formation, and what would not, "" where nobody knows.
        softer, damped: what to do where it is too stiff for the rate, or for a lag.
    """

    place: ClassVar[str] = "control.law"
    unstable: ClassVar[str] = ""
    softer: ClassVar[str] = "lower its gains"
    damped: ClassVar[str] = "make it softer or raise its damping"

    def modes(self, geometry: Geometry) -> tuple[Mode, ...]:
        """Modes of the law linearised at the formation, 2n of them; every distance is above the safe one."""
        raise NotImplementedError

    @property
    def stiffest(self) -> tuple[Mode, ...]:
        """Modes that it can have away from the formation, where these are stiffer."""
        return ()

    def sweep_radius(self, geometry: Geometry, rate_hz: float) -> float:
        """Largest |eigenvalue| of the sampled law with the dynamics of its multipliers; 0 where these have
        none."""
        return 0.0

    def sweeps_stably(self, geometry: Geometry, rate_hz: float) -> bool:
        """Whether that is below 1."""
        return True


class FleetCoupling(FleetLaw):
    """The law of a whole fleet with one coupling.

    Attributes:
        title: what it is, in a few words.
        shares_navigation: an edge takes its share of a mode from navigation, instead of adding to it.
        bounded: while nothing is clipped, and with k_p > 0, the energy at the start bounds phi of every edge
            for all time (J3).
    """

    title = ""
    place = "control.coupling"
    unstable = ' (edges that share a robot overcorrect each other); take coupling = "joint", or kp of about 1'
    softer = "lower kd and kp"
    damped = "lower kp or raise kd"
    shares_navigation: ClassVar[bool] = True
    bounded: ClassVar[bool] = False

    def __init__(self, fleet: Fleet) -> None:
        self.control, self.safe_distance = fleet.control, fleet.formation.safe_distance_m
        self.gains: Final = gains_of(fleet)

    def multipliers(self, e: Edges, i: NDArray[np.intp], j: NDArray[np.intp], robots: int) -> Array:
        """Multipliers of all edges of a fleet, (m,); where robots reach them by sweeps, exactly."""
        raise NotImplementedError

    def modes(self, geometry: Geometry) -> tuple[Mode, ...]:
        n, control = len(geometry.ids), self.control
        values = self._eigenvalues(self._jacobian(geometry), self.softness(geometry)).tolist()
        found = []
        for value in [*values, *[0.0] * (2 * n - len(values))][: 2 * n]:
            rest = 1.0 - value if self.shares_navigation else 1.0
            k1, k2 = rest * control.c1 + value * control.kp, rest * control.c2 + value * control.kd
            found.append(Mode(k1, k2, value > 1e-9))
        return tuple(found)

    @property
    def stiffest(self) -> tuple[Mode, ...]:
        """Near the safe distance phi' grows without limit, and the joint law's modes become (kp, kd)."""
        kp, kd = self.control.kp, self.control.kd
        return (Mode(kp, kd, True),) if kp > 0.0 and kd > 0.0 else ()

    def remark(self, robots: int) -> str:
        """What the author of a fleet of so many robots should know of this coupling, "" for nothing."""
        return ""

    def _eigenvalues(self, jacobian: Array, softness: Array) -> Array:
        """mu of the modes in which edges change; `softness`: of each edge, 1/m^2."""
        return _squares(jacobian)

    def softness(self, geometry: Geometry) -> Array:
        """Of each edge (J4), (m,), 1/m^2."""
        gains, span = self.gains, geometry.distances - self.safe_distance
        found: Array = gains.k2 + np.maximum(gains.near, gains.far * span) / span**2
        return found

    def _jacobian(self, geometry: Geometry) -> Array:
        """A of all edges at the formation, (m, 2n): phi' = 1 / (d - r_s) where rho = d (10)."""
        slope = 1.0 / (geometry.distances - self.safe_distance)
        jacobian: Array = rigidity_matrix(geometry.offsets, geometry.edges) * slope[:, None]
        return jacobian


class Joint(FleetCoupling):
    """All multipliers together (J2)."""

    title = "joint multipliers"
    bounded = True

    def multipliers(self, e: Edges, i: NDArray[np.intp], j: NDArray[np.intp], robots: int) -> Array:
        return fleet_law.multipliers_joint(e, i, j, robots)

    def sweep_radius(self, geometry: Geometry, rate_hz: float) -> float:
        return _radius(self._sampled(geometry, rate_hz))

    def sweeps_stably(self, geometry: Geometry, rate_hz: float) -> bool:
        return _dies_away(self._sampled(geometry, rate_hz))

    def _sampled(self, geometry: Geometry, rate_hz: float) -> Array:
        """The sampled joint law with its multipliers moved by one sweep a tick: next state from state.

        State: e, edot and the last force of every robot, and the multiplier of every edge, with neighbours
        predicted exactly. The law sees e and edot in the middle of the period in which its force acts, as the
        last force would bring them there (P2).
        lambda' = lambda + W^-1 (A (c1 e + c2 edot) - kd A edot - kp A e - (K2 + A A^T) lambda), the
        sweep of `agent.control.law`, and u = -c1 e - c2 edot + A^T lambda'.
        """
        control, jacobian = self.control, self._jacobian(geometry)
        m, n2 = jacobian.shape
        h = 1.0 / rate_hz
        degree = np.bincount(geometry.edges.ravel(), minlength=n2 // 2)
        slope2 = 1.0 / (geometry.distances - self.safe_distance) ** 2
        softness = self.softness(geometry)
        gain = 1.0 / (softness + slope2 * degree[geometry.edges].sum(axis=1))
        place = np.hstack([np.eye(n2), 0.5 * h * np.eye(n2), 0.125 * h * h * np.eye(n2)])
        speed = np.hstack([np.zeros((n2, n2)), np.eye(n2), 0.5 * h * np.eye(n2)])
        sweep = np.hstack(
            [
                gain[:, None]
                * jacobian
                @ ((control.c1 - control.kp) * place + (control.c2 - control.kd) * speed),
                np.eye(m) - gain[:, None] * (np.diag(softness) + jacobian @ jacobian.T),
            ]
        )
        force = np.hstack([-control.c1 * place - control.c2 * speed, np.zeros((n2, m))]) + jacobian.T @ sweep
        hold = np.hstack([np.eye(n2), h * np.eye(n2), np.zeros((n2, n2 + m))])
        velocity = np.hstack([np.zeros((n2, n2)), np.eye(n2), np.zeros((n2, n2 + m))])
        return np.vstack([hold + 0.5 * h * h * force, velocity + h * force, force, sweep])

    def _eigenvalues(self, jacobian: Array, softness: Array) -> Array:
        values = _squares(jacobian / np.sqrt(softness)[:, None])
        return values / (1.0 + values)


class EdgeByEdge(FleetCoupling):
    """Each edge on its own, as published (33)."""

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._published = fleet.control.kp == 0.0
        self.title = "edge by edge, the paper's" if self._published else "edge by edge"

    def multipliers(self, e: Edges, i: NDArray[np.intp], j: NDArray[np.intp], robots: int) -> Array:
        return fleet_law.multipliers_edge(e)

    def remark(self, robots: int) -> str:
        if robots <= 2:
            return ""
        name = "the paper's law" if self._published else 'the law edge by edge (coupling = "edge")'
        return (
            f"{name} is not proved stable for {robots} robots: a robot with several edges feels forces that "
            "(33) leaves "
            'out (docs/theory.md). coupling = "joint" is proved'
        )

    def _eigenvalues(self, jacobian: Array, softness: Array) -> Array:
        weight = softness + np.sum(jacobian**2, axis=1)
        return _squares(jacobian / np.sqrt(weight)[:, None])


class Penalty(FleetCoupling):
    """A potential field, the yardstick."""

    title = "potential field"
    shares_navigation = False

    def multipliers(self, e: Edges, i: NDArray[np.intp], j: NDArray[np.intp], robots: int) -> Array:
        return fleet_law.multipliers_penalty(e, self.gains)

    def remark(self, robots: int) -> str:
        return (
            'the potential-field law (coupling = "penalty") is a yardstick: its forces are not bounded '
            "near the safe "
            'distance and compete with navigation (docs/theory.md). coupling = "joint" is the one to drive '
            "with"
        )


COUPLINGS: Final[Mapping[str, type[FleetCoupling]]] = {
    "joint": Joint,
    "edge": EdgeByEdge,
    "penalty": Penalty,
}
"""By their name in `control.coupling`."""


def _squares(matrix: Array) -> Array:
    """The squares of its singular values, (min(m, 2n),)."""
    values: Array = np.asarray(np.linalg.svd(matrix, compute_uv=False) ** 2, dtype=np.float64)
    return values


def _radius(matrix: Array) -> float:
    """The largest |eigenvalue| of a square matrix."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def _dies_away(matrix: Array) -> bool:
    """Whether all |eigenvalues| of a square matrix are below 1, as they are if any norm of one of its powers
    is. A few squares of it mostly show that, in a tenth of the time that the eigenvalues of a large one take:
    these are asked for where it is not shown."""
    power = matrix
    for _ in range(SQUARES_MAX):
        size = float(np.abs(power).sum(axis=1).max())
        if size < 1.0:
            return True
        if not size < _HUGE:
            break
        power = power @ power
    return _radius(matrix) < 1.0


_MODES: Final = "modes(cls, fleet, settings)"
_GIVES: Final = "gives two (k1, k2, shape) for each robot, or None"


class OwnFleetLaw(FleetLaw):
    """A law of others, by the modes that its class gives."""

    def __init__(self, modes: Sequence[tuple[float, float, bool]]) -> None:
        try:
            self._modes = tuple(Mode(float(k1), float(k2), bool(shape)) for k1, k2, shape in modes)
        except (TypeError, ValueError):
            raise ValueError(f"{_MODES} {_GIVES}") from None
        if not np.isfinite(self._modes).all():
            raise ValueError("modes() must give finite numbers")

    def modes(self, geometry: Geometry) -> tuple[Mode, ...]:
        return self._modes


def coupling_of(fleet: Fleet) -> FleetCoupling | None:
    """The form of a fleet's coupling for all its robots at once; None for a law of others."""
    if fleet.control.law is not None:
        return None
    return COUPLINGS[fleet.control.coupling](fleet)


def law_of(fleet: Fleet) -> FleetLaw | None:
    """The linearised law of a fleet; None for a law of others that does not give its own."""
    coupling = coupling_of(fleet)
    if coupling is not None:
        return coupling
    try:
        return own_law_of(fleet)
    except Error:  # `check` says it
        return None


def own_law_of(fleet: Fleet) -> OwnFleetLaw | None:
    """A fleet's law of others, None when it does not give its modes.

    Raises:
        handfast.agent.control.own_law.LawError: it fails at that, or never returns; the text is one line.
    """
    from handfast.agent.control import own_law  # here: other fleets need none of it

    kind = own_law.kind_of(fleet)

    def linearised() -> OwnFleetLaw | None:
        modes = kind.modes(fleet, own_law.settings_of(fleet))
        # One more than is right: what gives them may never end.
        return None if modes is None else OwnFleetLaw(list(islice(modes, 2 * len(fleet.members) + 1)))

    def attempted() -> OwnFleetLaw | None:
        return own_law.attempt(kind, linearised, f"{_MODES}, a classmethod that {_GIVES}")

    try:
        return patience.answer("modes()", attempted)
    except TimeoutError as error:
        raise own_law.LawError(f"law {fleet.control.law}: {error}") from None
