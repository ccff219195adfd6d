"""The agent's states, and the one table of transitions between them.

Pure. Every tick the agent sums up its situation as `Conditions`; `step` reads the table from the
top and takes the first row that applies. A robot drives in the states of `DRIVING` only; in every other
state it tells its plant to brake.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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

    __hash__ = object.__hash__  # that of an `Enum` is no function in C, and each tick asks for several

    WAITING = "waiting"
    READY = "ready"
    STANDBY = "standby"
    RUNNING = "running"
    DEGRADED = "degraded"
    HOLDING = "holding"
    RELEASED = "released"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FAULT = "fault"


DOES: Final[Mapping[State, str]] = {
    State.WAITING: "Brakes. Its plant or a neighbour is missing, or its body's operator has not handed it "
    "over.",
    State.READY: "Brakes. Plant, body and neighbours are there; a mission or its epoch has not come.",
    State.STANDBY: "Brakes. It has no place in the formation: it is in reserve, or has left.",
    State.RUNNING: "Drives by the law.",
    State.DEGRADED: "Drives by the law, but slower, without an edge, or pushed back from the geofence.",
    State.HOLDING: "Brakes until it may drive again: it hears no neighbour, no operator, or is outside the "
    "geofence.",
    State.RELEASED: "Brakes. Its body's operator has taken it away, or may have; the others go on hearing "
    "where it is.",
    State.STOPPING: "Brakes, because the mission is over or a stop was ordered.",
    State.STOPPED: "Brakes, and stands. After a stop only a resume ends it, after a mission a new one.",
    State.FAULT: "Brakes. Its plant is silent or unhealthy, or its own numbers failed.",
}
"""What a robot does in each state, and why."""

DRIVING: Final = frozenset({State.RUNNING, State.DEGRADED})
"""States in which it drives."""
DRIVING_NAMES: Final = frozenset(state.value for state in DRIVING)
"""As statuses say them."""


class Conditions(NamedTuple):
    """One tick's situation. Each text is empty when all is well, else says what is wrong.

    plant, body, numbers: of its own. place: why it has no place in the formation. neighbours: whom it lacks
    to begin. mission: what it lacks of one. stop: why it has to stop. hold: why it must not drive now.
    degraded: why it drives other than the law says. started: whether the mission's epoch has come.
    """

    plant: str
    body: str
    numbers: str
    place: str
    neighbours: str
    mission: str
    stop: str
    hold: str
    degraded: str
    started: bool
    at_rest: bool

    @property
    def all_well(self) -> bool:
        """True when the table has no row for a running robot: `step` need not be asked, tick by tick."""
        return self.started and not (
            self.plant or self.body or self.numbers or self.place or self.stop or self.hold or self.degraded
        )


class Transition(NamedTuple):
    """One row: from any of `sources` to `target` when `applies`; `reason` is what status says."""

    name: str
    sources: frozenset[State]
    target: State
    applies: Callable[[Conditions], bool]
    reason: Callable[[Conditions], str]


_ALL: Final = frozenset(State)
ACTIVE: Final = DRIVING | {State.HOLDING, State.RELEASED}
"""States in which it takes part in a drive."""
_BEFORE: Final = frozenset({State.WAITING, State.READY})
MISSION_OVER: Final = "the mission is over"
"""Why a robot stands that nobody has stopped."""
PLANT_SILENT: Final = "plant silent"
"""How the reason begins of one whose body tells nothing."""
_AT_END: Final = frozenset({State.STOPPING, State.STOPPED})


def _missing(c: Conditions) -> str:
    return c.plant or c.body or c.neighbours


def _nothing(_: Conditions) -> str:
    return ""


def _missing_or(what: str) -> Callable[[Conditions], str]:
    """The reason to wait for one tick at least: what is missing, else `what` has just changed."""
    return lambda c: _missing(c) or what


TRANSITIONS: Final[tuple[Transition, ...]] = (
    Transition("numbers_failed", _ALL, State.FAULT, lambda c: bool(c.numbers), lambda c: c.numbers),
    Transition(
        "plant_lost",
        ACTIVE | {State.STOPPING, State.FAULT},
        State.FAULT,
        lambda c: bool(c.plant),
        lambda c: c.plant,
    ),
    Transition(
        "plant_back",
        frozenset({State.FAULT}),
        State.WAITING,
        lambda c: not c.plant,
        _missing_or("its plant is back"),
    ),
    Transition(
        "at_rest",  # and while it stands, for another reason than at first
        _AT_END,
        State.STOPPED,
        lambda c: bool(c.stop) and c.at_rest,
        lambda c: c.stop,
    ),
    Transition(
        "stop", _ALL - {State.STOPPED, State.FAULT}, State.STOPPING, lambda c: bool(c.stop), lambda c: c.stop
    ),
    Transition(
        "stop_ended", _AT_END, State.WAITING, lambda c: not c.stop, _missing_or("nothing stops it any more")
    ),
    Transition(
        "without_place",
        ACTIVE | _BEFORE | {State.STANDBY},
        State.STANDBY,
        lambda c: bool(c.place) and not c.plant,
        lambda c: c.place,
    ),
    Transition(
        "standby_ended",
        frozenset({State.STANDBY}),
        State.WAITING,
        lambda c: True,
        _missing_or("it has been given a place"),
    ),
    Transition("rescheduled", ACTIVE, State.READY, lambda c: not c.started, lambda c: "for the epoch"),
    Transition("body_released", ACTIVE, State.RELEASED, lambda c: bool(c.body), lambda c: c.body),
    Transition("hold", ACTIVE, State.HOLDING, lambda c: bool(c.hold), lambda c: c.hold),
    Transition("degraded", ACTIVE, State.DEGRADED, lambda c: bool(c.degraded), lambda c: c.degraded),
    Transition("hold_ended", frozenset({State.HOLDING}), State.RUNNING, lambda c: True, _nothing),
    Transition("body_back", frozenset({State.RELEASED}), State.RUNNING, lambda c: True, _nothing),
    Transition("well_again", frozenset({State.DEGRADED}), State.RUNNING, lambda c: True, _nothing),
    Transition(  # all that it lacks in a drive that goes on: after a stop, a fault, a start of its process
        "body_not_given_back",
        _BEFORE,
        State.RELEASED,
        lambda c: c.started and bool(c.body) and not (c.plant or c.neighbours),
        lambda c: c.body,
    ),
    Transition("incomplete", _BEFORE, State.WAITING, lambda c: bool(_missing(c)), _missing),
    Transition(
        "hold_at_start", _BEFORE, State.HOLDING, lambda c: c.started and bool(c.hold), lambda c: c.hold
    ),
    Transition("epoch", _BEFORE, State.RUNNING, lambda c: c.started, _nothing),
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
