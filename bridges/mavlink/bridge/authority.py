"""Decides who commands the vehicle: its operator or the bridge (PURE).

The operator always wins. Commands may flow in `Holder.BRIDGE` only. The table `TRANSITIONS` is read from the
top at every tick, and the first row that applies is taken; nothing else changes the holder but
`Authority.clear_to_drive`.

Once the fleet has clearance to drive, a vehicle that goes out of GUIDED or is disarmed is **released**: at
once, and until its operator has given it back (GUIDED, armed) *and* the fleet has then been cleared again, by
a new mission or a resume. The bridge never goes back into GUIDED by itself.

`OwnFailsafe` tells a failsafe of the vehicle's own from its operator, `Takeover` puts the vehicle into GUIDED
where the fleet file says so.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import Enum
from typing import Final, NamedTuple, Protocol

from handfast.agent.common.time import NS_PER_S
from handfast.agent.supervision.orders import AWAITED
from handfast.bridges.mavlink.ardupilot import constants

UNHEARD: Final = "nothing was heard of it"
"""How it is said of a vehicle that its operator may have had."""
REBOOTED: Final = "it has rebooted"
"""Another mode of such a vehicle is no word of its operator's."""
OWN_FAILSAFE: Final = "its own failsafe has it"
"""How it is said of a vehicle that was not taken by its operator."""


class Holder(Enum):
    """Who has the vehicle. The values are for logs."""

    NOBODY = "no vehicle"
    """It is not there, is not one that can be driven, or another bridge is at it."""
    OPERATOR = "its operator's"
    """It has not been handed over: not in GUIDED, or not armed."""
    BRIDGE = "the bridge's"
    """Armed, in GUIDED: wrenches reach it."""
    RELEASED = "released"
    """Its operator took it away. Given back or not, the bridge waits for a new mission or a resume."""


class Situation(NamedTuple):
    """What decides the holder at one tick. Each text is empty when all is well, else says what is wrong.

    vehicle: its link, what kind of vehicle it is, who else commands it.
    operator: its mode and arming: "" means GUIDED and armed, or that nothing is heard of it.
    heard: whether there are heartbeats of it, whatever else is wrong with it.
    lapse: why what is heard of it now does not tell what was before, at the tick when that is known: its
        operator may have had it and given it back meanwhile, or it has rebooted; "" as a rule.
    failsafe: what the vehicle says where a failsafe of its own did that, and not its operator.
    refusal: what makes the bridge let go of a vehicle that is its own: it does not follow its commands.
    cleared: the fleet has had clearance to drive since the bridge started.
    """

    vehicle: str
    operator: str
    refusal: str
    cleared: bool
    failsafe: str = ""
    lapse: str = ""
    heard: bool = False


class Transition(NamedTuple):
    """One row: from any of `sources` to `target` when `applies`."""

    name: str
    sources: frozenset[Holder]
    target: Holder
    applies: Callable[[Situation], bool]


_FREE: Final = frozenset({Holder.NOBODY, Holder.OPERATOR, Holder.BRIDGE})

TRANSITIONS: Final[tuple[Transition, ...]] = (
    # First, so that a vehicle that was taken while its estimate was bad does not drive off when that is good.
    Transition("lapsed", _FREE, Holder.RELEASED, lambda s: bool(s.lapse) and s.cleared),
    Transition("taken", _FREE, Holder.RELEASED, lambda s: bool(s.operator) and s.cleared),
    # A released vehicle stays released whatever happens to its link: the row for a lost one spares it.
    Transition("lost", _FREE, Holder.NOBODY, lambda s: bool(s.vehicle)),
    Transition("refused", _FREE, Holder.RELEASED, lambda s: bool(s.refusal)),
    Transition("not_handed_over", _FREE, Holder.OPERATOR, lambda s: bool(s.operator)),
    Transition("handed_over", _FREE, Holder.BRIDGE, lambda s: True),
)


def _row(holder: Holder, situation: Situation) -> Transition | None:
    """The first row of the table that applies."""
    return next((row for row in TRANSITIONS if holder in row.sources and row.applies(situation)), None)


def _given_back(operator: str) -> str:
    """What is said of a vehicle that was taken because of `operator`, and is GUIDED and armed again."""
    return f"its operator has given it back (it was: {operator})"


class Authority:
    """The state machine of who commands the vehicle: whether the bridge's commands may flow.

    Attributes:
        holder: who has the vehicle.
        why: what keeps commands from flowing, "" while they may.
    """

    def __init__(self) -> None:
        self.holder = Holder.NOBODY
        self.why = "waiting for the vehicle"
        self._cleared = False
        self._taken = ""
        self._was_lost = self._rebooted = False
        self._settled: Holder | None = None  # whom the last situation left as the holder
        self._situation = Situation(self.why, "", "", cleared=False)

    def step(
        self,
        vehicle: str,
        operator: str,
        refusal: str = "",
        failsafe: str = "",
        lapse: str = "",
        *,
        heard: bool = False,
    ) -> Transition | None:
        """One tick: see `Situation`. Returns the row that changed the holder, None when none did."""
        situation = Situation(vehicle, operator, refusal, self._cleared, failsafe, lapse, heard)
        if situation == self._situation and self.holder is self._settled:
            return None  # what did not change the holder then does not now
        self._situation = situation
        before = self.holder
        row = _row(before, situation)
        if row is not None:
            self.holder = row.target
        if self.holder is Holder.RELEASED and before is not Holder.RELEASED:
            self._taken = refusal or lapse or _given_back(operator)
            self._was_lost, self._rebooted = before is Holder.NOBODY, lapse == REBOOTED
        elif self._was_lost and lapse == REBOOTED:  # which is known some time after its first heartbeat
            self._rebooted = True
        elif not (vehicle or operator):
            self._rebooted = False  # whoever takes it from now on is its operator
        self.why = self._reason()
        self._settled = self.holder if self.holder is before else None
        return row if self.holder is not before else None

    def _reason(self) -> str:
        situation = self._situation
        if self.holder is Holder.BRIDGE:
            return ""
        if situation.vehicle:
            return situation.vehicle
        if self.holder is Holder.RELEASED:
            if situation.operator and situation.failsafe:
                return f"{OWN_FAILSAFE}: {situation.operator} ({situation.failsafe})"
            if situation.operator and self._rebooted:
                return f"{REBOOTED}: {situation.operator}"
            if situation.operator:
                return f"its operator has it: {situation.operator}"
            return f"{self._taken}: {AWAITED}"
        return situation.operator

    @property
    def cleared(self) -> bool:
        """Whether the fleet has had clearance to drive since the bridge started. Before, no wrench counts."""
        return self._cleared

    def clear_to_drive(self) -> bool:
        """Takes the fleet's clearance to drive: a new mission or a resume.

        Returns False when this vehicle cannot drive: its operator has not given it back.
        """
        self._cleared = True
        situation = self._situation
        given_back = not situation.operator and (situation.heard or not situation.vehicle)
        if self.holder is Holder.RELEASED:
            if given_back:
                self.holder = Holder.NOBODY  # the next step finds who has it
        elif situation.operator:
            self._taken, self.holder = _given_back(situation.operator), Holder.RELEASED
        return given_back


TOGETHER_NS: Final = 2 * NS_PER_S
"""A text and a change of mode that are no further apart are one matter, whichever comes first."""
BREACHED: Final = "fence breached"
"""What is heard of FENCE_STATUS."""
_FAILSAFE: Final = re.compile(
    r"\bfailsafe\b(?! clear)|\bBattery \d+ is (low|critical)\b|\bCrash: |\bfence breach", re.IGNORECASE
)


class OwnFailsafe:
    """Tells whether a vehicle went out of GUIDED by a failsafe of its own, rather than by its operator.

    A heartbeat only says which mode it is in. ArduPilot also says what made it change: ``EKF failsafe``,
    ``Radio Failsafe``, ``GCS Failsafe``, ``Battery 1 is low ...``, ``Crash: Going to HOLD`` (Rover's
    failsafe.cpp, crash_check.cpp, AP_BattMonitor.cpp). Of its fence Rover says no text, but FENCE_STATUS
    tells: `BREACHED`.

    Attributes:
        why: the vehicle's own text, "" where no failsafe has it.
    """

    def __init__(self) -> None:
        self.why = ""
        self._text, self._said_ns, self._left_ns = "", 0, 0
        self._operator = ""

    def hear(self, now_ns: int, text: str) -> None:
        """Takes a text of the vehicle."""
        if _FAILSAFE.search(text):
            self._text, self._said_ns = text, now_ns

    def step(self, now_ns: int, operator: str) -> None:
        """Takes what keeps commands from it: another mode than GUIDED, disarmed; "" nothing."""
        if operator != self._operator:
            # From one mode into another it is its operator who brings it, whatever had it before.
            self._left_ns = 0 if self._operator or not operator else now_ns
            self._operator, self.why = operator, ""
        if self._left_ns and self._text and abs(self._said_ns - self._left_ns) <= TOGETHER_NS:
            self.why = self._text


TAKEOVER_PERIOD_NS: Final = 3 * NS_PER_S
"""Between two attempts: the vehicle's own checks may refuse the first ones."""


class Commanded(Protocol):
    """What a takeover needs of the session with the vehicle (`session.Session`)."""

    @property
    def mode(self) -> int | None: ...

    @property
    def armed(self) -> bool: ...

    def command_mode(self, mode: int) -> None: ...

    def command_arm(self, arm: bool) -> None: ...


class Takeover:
    """Takes a vehicle over once: from when it obeys, or its operator undoes a step, its operator decides.

    Args:
        wanted: whether to take it over at all (`mavlink.arm`).

    Attributes:
        armed_here: whether its being armed is the bridge's doing.
    """

    def __init__(self, link: Commanded, log: Callable[[str], None], *, wanted: bool) -> None:
        self._link, self._log, self._wanted = link, log, wanted
        self._asked_ns: int | None = None
        self._was_guided = False
        self.armed_here = False

    def begin_again(self) -> None:
        """The vehicle has begun a new life, or the connection has: no mode of before says anything."""
        self._was_guided = False

    def step(self, now_ns: int, holder: Holder, trouble: str) -> None:
        """A tick. What its operator does counts while there is `trouble`, too; then nothing is asked for."""
        link = self._link
        if holder is Holder.RELEASED and not link.armed:
            self.armed_here = False  # whoever arms it from now on is its operator
        if not self._wanted:
            return
        if holder is Holder.BRIDGE:
            self._wanted = False
            return
        if link.mode == constants.MODE_GUIDED:
            self._was_guided = True
        elif self._was_guided:
            self._wanted = False
            self._log("its operator has taken it out of GUIDED again: it is asked no more")
            return
        due = self._asked_ns is None or now_ns - self._asked_ns >= TAKEOVER_PERIOD_NS
        if trouble or holder is not Holder.OPERATOR or not due:
            return
        if link.mode == constants.MODE_GUIDED:
            self._log("arming it (mavlink.arm = true)")
            link.command_arm(True)
            self.armed_here = True
        elif not link.armed:  # else somebody drives it
            self._log("asking for GUIDED (mavlink.arm = true)")
            link.command_mode(constants.MODE_GUIDED)
        self._asked_ns = now_ns
