"""The agent's states, and the one table of transitions between them.

Pure. Every tick the agent sums up its situation as `Conditions`; `step` reads the table from the
top and takes the first row that applies. A robot drives in `State.RUNNING` only; in every other
state it tells its plant to brake.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Final, NamedTuple

REST_SPEED: Final = 0.06
"""Below this (m/s) a robot stands: an EKF reports up to 0.05 m/s of a rover at rest."""
REST_YAW_RATE: Final = 0.1
"""rad/s, likewise."""


def at_rest(speed: float, yaw_rate: float) -> bool:
    """Whether a robot stands, by what is measured of it: m/s, rad/s."""
    return abs(speed) < REST_SPEED and abs(yaw_rate) < REST_YAW_RATE


class State(Enum):
    """What a robot is doing. The values are what status messages carry."""

    WAITING = "waiting"
    """Its plant or a neighbour is missing, or its body's operator has not handed it over."""
    READY = "ready"
    """Plant, body and neighbours are there; a mission or its epoch has not come."""
    RUNNING = "running"
    """Drives by the law."""
    HOLDING = "holding"
    """Brakes because a neighbour has been silent for longer than it can be predicted."""
    RELEASED = "released"
    """Its body's operator has taken it away. Its neighbours go on hearing where it is."""
    STOPPING = "stopping"
    """Brakes because the mission is over or a stop was ordered."""
    STOPPED = "stopped"
    """At rest after a stop; a new mission starts it again."""
    FAULT = "fault"
    """Brakes because its plant is silent or unhealthy, or its own numbers failed."""


class Conditions(NamedTuple):
    """One tick's situation. Each text is empty when all is well, else says what is wrong."""

    plant: str
    body: str
    numbers: str
    neighbours: str
    mission: str
    stop: str
    started: bool
    at_rest: bool


class Transition(NamedTuple):
    """One row: from any of `sources` to `target` when `applies`; `reason` is what status says."""

    name: str
    sources: frozenset[State]
    target: State
    applies: Callable[[Conditions], bool]
    reason: Callable[[Conditions], str]


_ALL: Final = frozenset(State)
_ACTIVE: Final = frozenset({State.RUNNING, State.HOLDING, State.RELEASED})
_BEFORE: Final = frozenset({State.WAITING, State.READY})


def _missing(c: Conditions) -> str:
    return c.plant or c.body or c.neighbours


TRANSITIONS: Final[tuple[Transition, ...]] = (
    Transition("numbers_failed", _ALL, State.FAULT, lambda c: bool(c.numbers), lambda c: c.numbers),
    Transition(
        "plant_lost",
        _ACTIVE | {State.STOPPING, State.FAULT},
        State.FAULT,
        lambda c: bool(c.plant),
        lambda c: c.plant,
    ),
    Transition("plant_back", frozenset({State.FAULT}), State.WAITING, lambda c: not c.plant, _missing),
    Transition(
        "at_rest",
        frozenset({State.STOPPING}),
        State.STOPPED,
        lambda c: bool(c.stop) and c.at_rest,
        lambda c: c.stop,
    ),
    Transition(
        "stop", _ALL - {State.STOPPED, State.FAULT}, State.STOPPING, lambda c: bool(c.stop), lambda c: c.stop
    ),
    Transition(
        "restart",
        frozenset({State.STOPPING, State.STOPPED}),
        State.WAITING,
        lambda c: not c.stop,
        _missing,
    ),
    Transition("rescheduled", _ACTIVE, State.READY, lambda c: not c.started, lambda c: "for the epoch"),
    Transition("body_released", _ACTIVE, State.RELEASED, lambda c: bool(c.body), lambda c: c.body),
    Transition(
        "neighbour_silent", _ACTIVE, State.HOLDING, lambda c: bool(c.neighbours), lambda c: c.neighbours
    ),
    Transition("neighbour_back", frozenset({State.HOLDING}), State.RUNNING, lambda c: True, lambda c: ""),
    Transition("body_back", frozenset({State.RELEASED}), State.RUNNING, lambda c: True, lambda c: ""),
    Transition("incomplete", _BEFORE, State.WAITING, lambda c: bool(_missing(c)), _missing),
    Transition("epoch", _BEFORE, State.RUNNING, lambda c: c.started, lambda c: ""),
    Transition("complete", _BEFORE, State.READY, lambda c: True, lambda c: c.mission or "for the epoch"),
)


def step(state: State, conditions: Conditions) -> tuple[State, Transition | None]:
    """The state after one tick and the row that led there; None when nothing applies.

    A row whose target is the present state keeps it and refreshes its reason.
    """
    for row in TRANSITIONS:
        if state in row.sources and row.applies(conditions):
            return row.target, row
    return state, None
