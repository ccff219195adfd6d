"""The base class `Law` for users' laws, and the adapter that runs one in place of the constraint force.

`control.law` in the fleet file names one; docs/plugins.md tells how to write it. The safety filter stands
after it, whatever it gives. Whatever is wrong with a law is one `LawError` that names it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from inspect import iscoroutinefunction
from math import inf, nan
from typing import Any, NamedTuple, NoReturn, TypeVar

from handfast.agent.common import plugins
from handfast.agent.common.errors import Error
from handfast.agent.common.plugins import blame, number, python
from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import load_law
from handfast.agent.formation.reference import Edge
from handfast.agent.formation.trajectory import Sample
from handfast.agent.messages.types import FLOAT_MAX, OWN_MAX


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


T = TypeVar("T")


class LawError(Error):
    """A law of others did what it must not: one line that names it, and where."""


class OwnLaw:
    """A law of others that drives a robot.

    Attributes:
        numbers: its numbers for its neighbours.
        period_s: how long what it gives is held.

    Raises:
        LawError: its class cannot be made.
    """

    def __init__(self, fleet: Fleet, robot: int, peers: Peers) -> None:
        self.numbers: tuple[float, ...] = ()
        self._peers = peers
        self.period_s = fleet.period_ns / NS_PER_S
        self._fresh = True
        self._heard: dict[int, tuple[float, ...]] = {}
        self._law = make(fleet, robot)

    def restart(self) -> None:
        """The robot begins to drive: so does the law, when it is asked next."""
        self._fresh = True
        self._heard.clear()

    def acceleration(
        self,
        now_ns: int,
        acting_ns: int,
        own: Hand,
        navigation: Vector,
        motion: Sample,
        edges: Sequence[tuple[Edge, Peer]],
    ) -> Vector:
        """What the law gives at the tick `now_ns` for `acting_ns`, m/s^2, W.

        Raises:
            LawError: that is nothing to drive by.
        """
        x, y, vx, vy, ax, ay = motion
        moment = Moment(
            (acting_ns - self._peers.forecast.epoch_ns) / NS_PER_S,
            self.period_s,
            (own.x, own.y),
            (own.vx, own.vy),
            navigation,
            Reference((x, y), (vx, vy), (ax, ay)),
            tuple(self._neighbours(now_ns, acting_ns, edges)),
        )
        if self._fresh:
            self._fresh = False
            restart(self._law)
        wanted, self.numbers = evaluate(self._law, moment)
        return wanted

    def _neighbours(self, now_ns: int, acting_ns: int, edges: Sequence[tuple[Edge, Peer]]) -> list[Neighbour]:
        found = []
        for edge, peer in edges:
            message, weight = peer.message, edge.weight * peer.trust
            if message is None or weight <= 0.0:
                continue
            if message.own:
                self._heard[peer.robot] = message.own
            other = self._peers.predict(peer, acting_ns)
            age_ns = max(0, now_ns + peer.clock.used_ns - peer.time_ns)
            found.append(
                Neighbour(
                    peer.robot,
                    other.position,
                    other.velocity,
                    other.navigation,
                    edge.distance,
                    edge.rate,
                    weight,
                    age_ns / NS_PER_S,
                    self._heard.get(peer.robot, ()),
                )
            )
        return found


def make(fleet: Fleet, robot: int) -> Law:
    """The law of a fleet for one robot.

    Raises:
        LawError: it cannot be made.
    """
    kind = kind_of(fleet)
    acceleration = attempt(kind, lambda: kind.acceleration)
    if acceleration is Law.acceleration:
        raise _failure(kind, "it has no method acceleration(self, now)")
    if iscoroutinefunction(acceleration):
        raise _failure(kind, "acceleration() cannot be async: write def acceleration(self, now)")
    failure = partial(_failure, kind)
    signature = "__init__(self, robot, fleet, settings)"
    return plugins.make(kind, signature, failure, robot, fleet, settings_of(fleet))


def restart(law: Law) -> None:
    """Has a law forget what it knows; raises as `attempt`."""
    attempt(law, lambda: law.restart(), "restart(self)")


def kind_of(fleet: Fleet) -> type[Law]:
    """The class of a fleet's law; there is one."""
    assert fleet.control.law is not None
    return load_law(fleet.control.law)


def settings_of(fleet: Fleet) -> Any:
    """The table of a fleet's law; None where it has none."""
    return dict(fleet.control.sections).get(getattr(kind_of(fleet), "section", ""))


def evaluate(law: Law, moment: Moment) -> tuple[Vector, tuple[float, ...]]:
    """What a law gives at a moment: its acceleration, m/s^2, W, and its numbers.

    Raises:
        LawError: it gives none, or such that cannot be driven by.
    """
    given = attempt(law, lambda: law.acceleration(moment), "acceleration(self, now)")
    wanted = _floats(given)
    if wanted is None or len(wanted) != 2:
        raise _failure(law, f"acceleration() must return two numbers (x, y) in m/s2, {_got(given)}")
    numbers = attempt(law, lambda: law.numbers)
    own = _floats(numbers)
    if own is None or len(own) > OWN_MAX:
        raise _failure(law, f"numbers must be at most {OWN_MAX} finite numbers, {_got(numbers)}")
    return (wanted[0], wanted[1]), own


def attempt(law: Law | type[Law], call: Callable[[], T], signature: str = "") -> T:
    """What a call of a law's code gives; `signature` is how that is to be written.

    Raises:
        LawError: it raises.
    """

    def failed(error: BaseException) -> NoReturn:
        raise _failure(law, blame(error, _kind(law), signature)) from None

    return plugins.attempt(call, failed)


def _kind(law: Law | type[Law]) -> type[Law]:
    kind = type(law)  # not isinstance: that asks an instance for its __class__
    return law if issubclass(kind, type) else kind  # type: ignore[return-value]


def _failure(law: Law | type[Law], what: str) -> LawError:
    kind = _kind(law)
    return LawError(f"law {kind.__module__}:{kind.__qualname__}: {what}")


def _floats(given: Any) -> tuple[float, ...] | None:
    """Finite numbers that a message can hold; None for anything else."""
    found = plugins.attempt(lambda: _numbers(python(given)), lambda _: (nan,))  # its class is of others too
    return found if all(-FLOAT_MAX <= value <= FLOAT_MAX for value in found) else None


def _numbers(given: Any) -> tuple[float, ...]:
    return tuple(map(number, given)) if isinstance(given, tuple | list) else (nan,)


def _got(given: Any) -> str:
    text = plugins.attempt(lambda: repr(given), lambda _: f"a {type(given).__name__}")
    found = plugins.attempt(lambda: _numbers(given), lambda _: ())
    limit = f" (at most {FLOAT_MAX:g})" if any(FLOAT_MAX < abs(value) < inf for value in found) else ""
    return f"got {printable(text[:60])}{limit}"
