"""One other robot, as one robot hears it: the latest message, its age, and how far to trust it."""

from __future__ import annotations

from math import inf
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.beliefs import DOUBT_AFTER_S, DOUBT_MAX, DOUBT_RATE, Belief, own_doubt
from handfast.agent.control.peers.lateness import LATE_MAX_NS, UNSURE_NS, ClockOffset, Lateness
from handfast.agent.control.peers.rolling import is_somewhere_on
from handfast.agent.messages.types import HandState

NEVER: Final = -1
"""Stamp of what has not come."""
SINCE_EVER: Final = -(1 << 62)
"""ns: before every time that there is."""


class Peer:
    """One other robot. `Peers` writes it, others read.

    Attributes:
        name: ``robot ID``, as texts have it.
        message: its latest, a hand state, or a beacon in the form of one; None when nothing has come.
        hand_ns, beacon_ns: stamps of its latest hand state and beacon, -1 while none has come.
        next_ns: within so long the next beacon comes after that one, as it says.
        listened: whether its hand states are listened to, so that beacons alone are not enough.
        clock: what is known of its clock.
        token: False while there is no connection to its agent: that has ended, is frozen, or is cut off.
        here: likewise, but True again only when it has been heard again.
        trust: 0..1, how far an edge to it is trusted.
        mark: version and tag of the mission that it has acknowledged.
        rolls_on: whether its body goes on as it went when nothing commands it
            (`agent.fleet.plants.Kind.rolls_on_s`).
        went: its latest message of a body that is measured and moves, of one that rolls on; None once it says
            that it stands, or drives again.
        deaf: whether it says that it does not hear this robot.
        unheard: how many robots it says that it does not hear.
        knows_ns: of when (own clock) what it knows of this robot is, by what it said last while it did not
            hear it.
        lateness: of its messages, as usual.
        direct_ns: stamp of the latest that has come from itself; `time_ns`: of what is known of it, which
            others may have told.
        belief: where it may be as others say, who have heard it last.
        hand_next_ns: so much after its latest hand state the next is stamped at most, 0 for the period.
        slowly, slowly_until_ns: how fast it may go as seen from its place, m/s, and until when.
        never_came: nobody has ever heard it, says who was there from the start: it began where it starts.
        gone_ns: what it has said until then counts no more: its body has been carried off.
        copy: its copy of the shared multiplier that has come since the last `Peers.take_copy`, if any.
        degree: constraints that act on it.
        ahead_ns: how far its last message was stamped ahead of the own clock if it was refused as
            ``future``, else 0.
        other_version: what its messages and this program speak, once one was refused for that; else "".
        received, lost, delayed, duplicated: hand states since the start.
        off_m: how far it may be meanwhile from where it is predicted, m, (E1).
        overdue_ns: it is not silent before then, as who looks for that has found, by the own clock;
            `SINCE_EVER` for one that may be now.
        far_until_ns: it cannot come near before then, as who looks for that has found; 0 once it is
            somewhere else than on its way.
    """

    __slots__ = (
        "ahead_ns", "beacon_ns", "belief", "clock", "copy", "deaf", "degree", "delayed", "direct_ns",
        "duplicated", "early", "far_until_ns", "gone_ns", "hand_next_ns", "hand_ns", "here", "knows_ns",
        "late_max_ns", "lateness", "listened", "lost", "mark", "message", "name", "never_came", "next_ns",
        "off_m", "other_version", "overdue_ns", "received", "robot", "rolls_on", "sequence", "slowly",
        "slowly_until_ns", "stood_until_ns", "time_ns", "token", "trust", "unheard", "went",
    )  # fmt: skip

    def __init__(self, robot: int, period_ns: int, next_ns: int, *, rolls_on: bool = False) -> None:
        self.robot, self.name, self.rolls_on = robot, f"robot {robot}", rolls_on
        self.next_ns, self.listened = next_ns, False
        self.message: HandState | None = None
        self.went: HandState | None = None
        self.early: HandState | None = None
        self.time_ns = self.hand_ns = self.beacon_ns = self.direct_ns = NEVER
        self.sequence = self.gone_ns = self.knows_ns = NEVER
        self.belief: Belief | None = None
        self.deaf = self.never_came = False
        self.mark = 0, 0
        self.lateness = Lateness()
        self.clock = ClockOffset(period_ns)
        self.here = self.token = True
        self.trust = 0.0
        self.slowly, self.slowly_until_ns = inf, 0
        self.copy: float | None = None
        self.degree = 0
        self.ahead_ns = 0
        self.other_version = ""
        self.received = self.lost = self.delayed = self.duplicated = 0
        self.far_until_ns = self.hand_next_ns = self.stood_until_ns = self.unheard = 0
        self.overdue_ns = SINCE_EVER
        self.late_max_ns = LATE_MAX_NS
        self.off_m = 0.0

    def age_ns(self, now_ns: int) -> int | None:
        """Age of its hand state by its own clock, None when none has come.

        Below 0 where its clock is further ahead than is proven.
        """
        return None if self.hand_ns == NEVER else now_ns + self.clock.used_ns - self.hand_ns

    def hand_late_ns(self, now_ns: int) -> int | None:
        """As `late_ns`, of its hand states; None when none has come."""
        if self.hand_ns == NEVER:
            return None
        if self.hand_next_ns:
            return self.promised_late_ns(now_ns)
        return now_ns + self.clock.used_ns - self.hand_ns - self.lateness.forgiven_ns

    def promised_late_ns(self, now_ns: int) -> int:
        """As `hand_late_ns`, of one that promises the next one: for so long it has been overdue, or nothing
        at all has come."""
        lateness = self.lateness
        by_ns = self.hand_ns + self.hand_next_ns + lateness.missed_ns
        return now_ns + self.clock.used_ns - min(by_ns, self.direct_ns) - lateness.forgiven_ns

    def note_way(self, message: HandState) -> None:
        """Keeps how its body goes, for when only where it may be is told of it (`OwnHand.lost`)."""
        if message.obeys and not is_somewhere_on(message):
            self.went = message
        elif message.following or message.doubt <= DOUBT_MAX:
            self.went = None

    @property
    def is_astray(self) -> bool:
        """Whether what is known of it last is that its plant is lost, and how its body went then."""
        return self.rolls_on and self.message is not None and is_somewhere_on(self.message)

    @property
    def is_gone(self) -> bool:
        """Whether its body has been carried off since it was heard last."""
        return self.gone_ns >= self.time_ns and self.gone_ns != NEVER

    def late_ns(self, now_ns: int) -> int:
        """How long what is known of it has been overdue and a little more: its age, less `forgiven_ns`."""
        return now_ns + self.clock.used_ns - self.time_ns - self.lateness.forgiven_ns

    def direct_late_ns(self, now_ns: int) -> int:
        """As `late_ns`, of what has come from itself."""
        return now_ns + self.clock.used_ns - self.direct_ns - self.lateness.forgiven_ns

    def has_told(self, now_ns: int, within_ns: int) -> bool:
        """Whether a beacon of it has come of late, which says whom it hears and by which mission it goes; one
        that never sent any has told as much as it will."""
        late_ns = now_ns + self.clock.used_ns - self.beacon_ns - self.lateness.forgiven_ns
        return late_ns <= within_ns or self.beacon_ns == NEVER

    def is_heard(self, now_ns: int) -> bool:
        """Whether what is known of it is as new as usual, so that it can be predicted."""
        if not self.here or self.message is None:
            return False
        return now_ns + self.clock.used_ns - self.time_ns - self.lateness.forgiven_ns < UNSURE_NS

    def doubt(self, now_ns: int) -> float:
        """Its position uncertainty, m: as it says itself, and by the age of that."""
        message = self.message
        said = self.off_m
        if message is not None and message.doubt:  # nearly all know where they are
            said += own_doubt(message.doubt, rolls=self.rolls_on and not message.following)
        age_s = (now_ns + self.clock.used_ns - self.time_ns) / NS_PER_S - DOUBT_AFTER_S
        if age_s <= 0.0:
            return said
        more = DOUBT_RATE * age_s
        return said + (more if more < DOUBT_MAX else DOUBT_MAX)
