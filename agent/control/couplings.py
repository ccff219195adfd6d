"""Couplings: how a robot finds the multipliers of its own constraints, one class for each `control.coupling`
(PURE).

`deploy.analysis.couplings` has the same of a whole fleet, for analyses.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.control import law
from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.peers.prediction import Prediction
from handfast.agent.messages.types import NEIGHBOURS_MAX

Key = int | str
"""Of a multiplier: a robot's id for an edge, minus its id where it is only kept away from, the name of a
boundary with a number."""


class Constraint:
    """One constraint at one instant.

    key: of its multiplier. edge: what the law needs of it. other: the robot at its other end, None for what
    stands still. degree: how many constraints act on that. one_sided: it pushes apart, and never pulls.
    name: of what it keeps away from, for reports.
    """

    __slots__ = "degree", "edge", "key", "name", "one_sided", "other"

    def __init__(
        self,
        key: Key,
        edge: law.Edge,
        other: Prediction | None,
        degree: int,
        one_sided: bool,
        name: str = "",
    ) -> None:
        self.key: Final = key
        self.edge: Final = edge
        self.other: Final = other
        self.degree: Final = degree
        self.one_sided: Final = one_sided
        self.name: Final = name


class Coupling:
    """The multipliers of one robot's constraints: a subclass finds them in `values`.

    Args:
        gains: of the law.
        peers: the other robots, for their copies of shared multipliers.
    """

    def __init__(self, gains: law.Gains, peers: Peers) -> None:
        self._gains, self._peers = gains, peers
        self._multipliers: dict[Key, float] = {}
        self._constraints: list[Constraint] = []

    def restart(self) -> None:
        """Forgets the multipliers: the robot begins to drive."""
        self._multipliers.clear()
        self._constraints = []

    def force(self, constraints: list[Constraint]) -> Vector:
        """Own constraint force F_c (32), m/s^2; moves the multipliers on by one tick."""
        values = self.values(constraints, [self._multipliers.get(each.key, 0.0) for each in constraints])
        multipliers: dict[Key, float] = {}
        for k, each in enumerate(constraints):
            if each.one_sided:
                values[k] = law.repelling(values[k])
            multipliers[each.key] = values[k]
        self._multipliers, self._constraints = multipliers, constraints
        return _total(constraints, values)

    def multiplier(self, key: Key) -> float:
        """Own copy of the multiplier of a constraint, 0 of one that does not act."""
        return self._multipliers.get(key, 0.0)

    def shared(self) -> tuple[tuple[int, float], ...]:
        """Own copies of lambda that others have copies of: ``(robot, lambda)``, one for each robot."""
        known = self._multipliers
        shared = [
            (abs(key), value)
            for key, value in known.items()
            if type(key) is int and (key > 0 or -key not in known)
        ]
        return tuple(shared[:NEIGHBOURS_MAX])

    def slopes(self) -> dict[int, float]:
        """How much force a multiplier that is shared makes, 1/m, by robot: phi' of (10)."""
        return {abs(each.key): each.edge.slope for each in self._constraints if type(each.key) is int}

    def values(self, constraints: list[Constraint], before: list[float]) -> list[float]:
        """Multipliers of the constraints at this tick, from those of the last one."""
        raise NotImplementedError


class Joint(Coupling):
    """One sweep a tick towards the joint multipliers of all edges around (J2)."""

    def values(self, constraints: list[Constraint], before: list[float]) -> list[float]:
        values = before
        keys = {each.key for each in constraints}
        for k, each in enumerate(constraints):
            key = each.key
            # A robot with an edge that is not quite relied on has two multipliers: the edge's is shared.
            if type(key) is int and (key > 0 or -key not in keys):
                copy = self._peers.take_copy(abs(key))
                if copy is not None:
                    values[k] = 0.5 * (values[k] + copy)
        cx, cy = _total(constraints, values)
        own_degree = len(constraints)
        for k, each in enumerate(constraints):
            other = each.other
            pull = (cx, cy) if other is None else (cx - other.constraint[0], cy - other.constraint[1])
            degrees = own_degree + (0 if other is None else each.degree or 1)
            values[k] = law.multiplier_sweep(each.edge, values[k], pull, degrees)
        return values


class EdgeByEdge(Coupling):
    """Each edge on its own, as published (33)."""

    def values(self, constraints: list[Constraint], before: list[float]) -> list[float]:
        return [law.multiplier_edge(each.edge, 1 if each.other is None else 2) for each in constraints]


class Penalty(Coupling):
    """A potential field, the yardstick."""

    def values(self, constraints: list[Constraint], before: list[float]) -> list[float]:
        return [law.multiplier_penalty(each.edge, self._gains) for each in constraints]


COUPLINGS: Final[Mapping[str, type[Coupling]]] = {"joint": Joint, "edge": EdgeByEdge, "penalty": Penalty}
"""By their name in `control.coupling`."""


def _total(constraints: list[Constraint], values: list[float]) -> Vector:
    """Own constraint force (32) with these multipliers, m/s^2."""
    cx = cy = 0.0
    for k, each in enumerate(constraints):
        fx, fy = law.force(each.edge, values[k])
        cx += fx
        cy += fy
    return cx, cy
