"""The agent's states, the one table of transitions between them, and the status that it publishes (PURE).

Every tick the agent sums up its situation as `Conditions`; `step` reads the table from the top and takes the
first row that applies. A robot drives in the states of `DRIVING` only; in every other state it tells its
plant to brake.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple

from handfast.agent.common.models import new
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.peer import NEVER, Peer
from handfast.agent.messages.types import NeighbourStatus, Status, Total
from handfast.agent.supervision.overload import Overload

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


STATUS_HZ: Final = 5.0
"""How often an agent says its status to operators, at the full rate of a drive..."""
STATUSES_HZ: Final = 300.0
"""...where all together say no more than so many a second. One that is waited for comes at once: of another
state, or of an order that is acknowledged."""
OPENED_ANEW_NS: Final = 5 * NS_PER_S
"""For so long a status says that a link was opened anew."""
STATUS_VALUES_MAX: Final = 200
"""A status goes out early rather than hold more tick times or ages than this."""


def status_hz(robots: int) -> float:
    """How often an agent of a fleet of so many robots says its status while nothing changes, 1/s."""
    return min(STATUS_HZ, STATUSES_HZ / robots)


class StatusReport:
    """Collects what happens between two status messages, counts what happened since the start.

    Args:
        rejected: messages that were not valid, by reason.
        overload: of its own process.
        hz: how often a status is due, 1/s.

    Attributes:
        ages_us: ages of neighbours' states that the law worked with since the last status, us.
        sent_hands: hand states sent, one for each neighbour.
        corrupted: hand states whose bytes were damaged.
        digest: of its fleet file, once it has refused a mission for another one: `Status.digest`.
    """

    def __init__(
        self,
        rejected: Counter[str],
        overload: Overload,
        hz: float = STATUS_HZ,
    ) -> None:
        self._period_ns: Final = round(NS_PER_S / hz)
        self._rejected, self._overload = rejected, overload
        self._interventions: Counter[str] = Counter()
        self.ages_us: Final[list[int]] = []
        self.sent_hands = self.corrupted = 0
        self.digest: tuple[str, ...] = ()
        self._tick_us: list[int] = []
        self._overruns = 0
        self._sequence = self._due_ns = 0
        self._opened_anew: dict[str, int] = {}
        self._links_opened_anew = 0

    def timed(self, duration_ns: int, missed: int) -> None:
        """Takes how long a tick took, and how many were skipped before it."""
        self._tick_us.append(duration_ns // 1000)
        self._overruns += missed

    def intervened(self, causes: Collection[str]) -> None:
        """Counts a tick in which the safety filter changed what the law asked for, if it did, by cause."""
        if causes:
            self._interventions.update(causes)
        self._interventions["any"] += bool(causes)

    def link_opened_anew(self, now_ns: int, what: str) -> None:
        """Counts that a link was opened anew; `what` says which, and why."""
        self._links_opened_anew += 1
        self._opened_anew[what] = now_ns

    def opened_anew(self, now_ns: int) -> str:
        """Which links were of late, "" for none."""
        self._opened_anew = {
            what: then_ns for what, then_ns in self._opened_anew.items() if now_ns - then_ns < OPENED_ANEW_NS
        }
        return "; ".join(self._opened_anew)

    def hurry(self) -> None:
        """There is news that operators wait for: the next status goes out with the next tick."""
        self._due_ns = 0

    def is_due(self, now_ns: int) -> bool:
        """Whether it is time for the next status, or more has come than one can hold."""
        return now_ns >= self._due_ns or len(self.ages_us) > STATUS_VALUES_MAX

    def status(
        self,
        now_ns: int,
        robot: int,
        situation: tuple[str, str, str],
        mission_version: int,
        stop_version: int,
        neighbours: Sequence[Peer],
        known: Iterable[Peer],
    ) -> Status:
        """The next message, after which collecting begins anew.

        Args:
            situation: state, the transition that led there, and its reason.
            mission_version, stop_version: of the mission and the stop or resume that were taken last.
            neighbours: peers at the other ends of the robot's edges, in their order.
            known: all other robots, heard or not.
        """
        received = lost = delayed = duplicated = 0
        for peer in known:  # once: in a large fleet these are many
            if peer.hand_ns != NEVER:
                received, lost = received + peer.received, lost + peer.lost
                delayed, duplicated = delayed + peer.delayed, duplicated + peer.duplicated
        counters = {
            "sent": self.sent_hands,
            "received": received,
            "lost": lost,
            "delayed": delayed,
            "duplicated": duplicated,
            "corrupted": self.corrupted,
            "rejected": sum(self._rejected.values()),
            "overruns": self._overruns,
            **({"links.opened_anew": self._links_opened_anew} if self._links_opened_anew else {}),
            **self._overload.counters(),
            **{f"rejected.{reason}": count for reason, count in sorted(self._rejected.items())},
            **{f"filtered.{cause}": count for cause, count in sorted(self._interventions.items())},
        }
        status = Status(
            robot,
            self._sequence,
            now_ns,
            *situation,
            mission_version,
            stop_version,
            tuple(
                NeighbourStatus(
                    peer.robot,
                    -1 if (age := peer.age_ns(now_ns)) is None else max(age, 0) // 1000,
                    peer.received,
                    peer.lost,
                    peer.clock.offset_us,
                    peer.clock.error_us,
                )
                for peer in neighbours
            ),
            tuple(self._tick_us[:STATUS_VALUES_MAX]),
            tuple(self.ages_us[: STATUS_VALUES_MAX + len(neighbours)]),
            tuple([new(Total, each) for each in counters.items()]),
            self.digest,
        )
        self._sequence += 1
        self._due_ns = now_ns + self._period_ns
        self._tick_us.clear()
        self.ages_us.clear()
        return status
