"""What robot 1 knows of robots 2, 5 and 9, and messages from them, for tests."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin
from typing import Any

from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.peers.prediction import Prediction
from handfast.agent.formation.reference import Instant
from handfast.agent.formation.trajectory import Sample
from handfast.agent.messages.types import Beacon, HandState, Silent

PERIOD = 20_000_000
S = 1_000_000_000
C1, C2 = 0.4, 0.6
T0 = 1000 * S  # an epoch
OFFSETS = {5: (1.0, 0.0), 2: (0.0, -0.5), 9: (-1.0, 0.7)}


def message(
    robot: int = 2,
    sequence: int = 0,
    time_ns: int = T0,
    follows: bool = True,
    position: tuple[float, float] = (0.0, 0.0),
    velocity: tuple[float, float] = (0.0, 0.0),
    constraint: tuple[float, float] = (0.0, 0.0),
    multipliers: tuple[tuple[int, float], ...] = (),
    navigation: tuple[float, float] = (0.0, 0.0),
    heard: tuple[tuple[int, int], ...] = (),
    degree: int = 1,
) -> HandState:
    forces = (*navigation, *constraint, 0.0, 0.0, 0.0)
    return HandState(
        robot, sequence, time_ns, follows, degree, *position, *velocity, *forces, multipliers, heard
    )


def beacon(
    robot: int = 2,
    time_ns: int = T0,
    position: tuple[float, float] = (0.0, 0.0),
    velocity: tuple[float, float] = (0.0, 0.0),
    follows: bool = True,
) -> Beacon:
    return Beacon(robot, 0, time_ns, follows, *position, *velocity, 0.0, 0, 0, -1, -1)


def circling(time_ns: int) -> Sample:
    """A reference with an acceleration."""
    t = (time_ns - T0) / S
    return cos(t), 2 * sin(t), -sin(t), 2 * cos(t), -cos(t), -2 * sin(t)


def standing(_time_ns: int) -> Sample:
    return 3.0, 4.0, 0.0, 0.0, 0.0, 0.0


def peers(
    reference: Callable[[int], Sample] = circling,
    epoch_ns: int = T0,
    period_ns: int = PERIOD,
    **options: Any,
) -> Peers:
    def instant(time_ns: int) -> Instant:
        return Instant(reference(time_ns), OFFSETS)

    made = Peers(1, C1, C2, period_ns, instant, **options)
    made.forecast.epoch_ns = epoch_ns
    return made


def heard(known: Peers, *messages: HandState, now_ns: int = T0 + PERIOD) -> Peers:
    for one in messages:
        assert known.accept(one, now_ns) is None
    return known


def predicted(known: Peers, robot: int, time_ns: int) -> Prediction:
    return known.predict(known.get(robot), time_ns)


def ages(known: Peers, now_ns: int) -> list[int | None]:
    return [known.get(robot).age_ns(now_ns) for robot in sorted(OFFSETS)]


def total(known: Peers, name: str) -> int:
    return sum(getattr(peer, name) for peer in known.known)


def rows(known: Peers, now_ns: int) -> tuple[Silent, ...]:
    """What it tells of the silent."""
    return known.silent(now_ns)
