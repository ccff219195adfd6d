"""What a law of others is: `Law`, its base, and the `Moment` that it acts by (PURE).

`control.law` in the fleet file names one; docs/plugins.md tells how to write it. It stands in the place of
the constraint force; the safety filter stands after it, whatever it gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from handfast.agent.common.quantities import Vector
from handfast.agent.fleet.model import Fleet


class Neighbour(NamedTuple):
    """A robot at the other end of an edge, carried forward to the instant for which the law is to act.

    Attributes:
        robot: its id.
        position, velocity, navigation: of its hand, m, m/s; its navigation force F_n, m/s^2; W.
        distance: that the edge is to have, m; rate: its derivative, m/s.
        weight: of the edge, in (0, 1]: lower while it fades, or while the robot is not trusted.
        age: of its last message, s.
        numbers: `Law.numbers` of its law, as it said them last; () before it has.
    """

    robot: int
    position: Vector
    velocity: Vector
    navigation: Vector
    distance: float
    rate: float
    weight: float
    age: float
    numbers: tuple[float, ...]


class Reference(NamedTuple):
    """Desired motion of the own place: m, m/s, m/s^2, W."""

    position: Vector
    velocity: Vector
    acceleration: Vector


class Moment(NamedTuple):
    """What a law acts by: all of it at the instant in the middle of the period in which its force acts.

    Attributes:
        time: fleet time, s.
        period: of the control loop, s.
        position, velocity: of the own hand, m, m/s, W.
        navigation: the own navigation force F_n, m/s^2, W: towards the place, or round what is in the way.
        reference: desired motion of the own place.
        neighbours: those that share an edge, have been heard and are trusted.
    """

    time: float
    period: float
    position: Vector
    velocity: Vector
    navigation: Vector
    reference: Reference
    neighbours: tuple[Neighbour, ...]


class Law:
    """A control law; base of all laws of others. One is made for each robot.

    A table of its own in the fleet file, `[control.NAME]`, has the name that the class attribute `section`
    gives, and the fields of the class attribute `Settings`, a frozen dataclass.

    Attributes:
        robot: id of the robot that it drives.
        fleet: the fleet file.
        settings: its table, a `Settings`; None without one.
        numbers: up to 16 numbers for the neighbours' laws, sent with every hand state; set it.
    """

    numbers: Sequence[float] = ()

    def __init__(self, robot: int, fleet: Fleet, settings: Any) -> None:
        self.robot, self.fleet, self.settings = robot, fleet, settings

    def restart(self) -> None:
        """Forgets what it knows: the robot begins to drive."""

    def acceleration(self, now: Moment) -> Vector:
        """What the hand is to be accelerated by, (x, y), m/s^2, W."""
        raise NotImplementedError

    @classmethod
    def modes(cls, fleet: Fleet, settings: Any) -> Sequence[tuple[float, float, bool]] | None:
        """The law linearised at the formation, for `handfast check`; None: it cannot predict this law.

        A mode is (k1, k2, shape): u = -k1 e - k2 edot, and whether it changes the lengths of edges. There are
        two for each robot.
        """
        return None
