"""How fast a robot goes where its way meets the way of one that it knows by late messages alone (PURE).

Who makes way for another leaves the law, and for as long as its messages take, tau, everybody predicts it
where it would have gone. So before they meet both go slowly, as seen from their places, and each predicts
the other so. See (P3) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import hypot, inf
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.beliefs import said_doubt
from handfast.agent.control.peers.forecast import Course
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.formation.reference import Instant, Reference
from handfast.agent.messages.types import HandState

PACE: Final = 0.45
"""m s: speed (m/s), as seen from its place, times the square of the age (s) of what others know of it."""
MORE_M: Final = 0.1
"""Ways meet that come so much nearer to each other than the safety filter lets them."""
AHEAD_S: Final = 1.0
"""So much further ahead than messages are late it is looked for where ways meet."""
STEP_S: Final = 0.2
"""Between two instants at which it is looked for."""
TURNED: Final = 0.05
"""m/s^2: a robot whose acceleration is changed by more than this makes way for somebody."""
AT_PLACE: Final = 0.9
"""Ways do not meet where places are that near to each other: this share of their distance."""
_AHEAD_NS: Final = round(AHEAD_S * NS_PER_S)
_STEP_NS: Final = round(STEP_S * NS_PER_S)


class _Point:
    """Where a robot is on its way, and where its place is then, m, W."""

    __slots__ = "place_x", "place_y", "x", "y"

    def __init__(self, x: float, y: float, place_x: float, place_y: float) -> None:
        self.x: Final = x
        self.y: Final = y
        self.place_x: Final = place_x
        self.place_y: Final = place_y


class Caution:
    """What robot `robot` has to heed; nothing, and at no cost, where no link is late by more than matters.

    Args:
        keep_m: how far the safety filter keeps robots apart whose place is known.
        most: no robot goes faster than this, as seen from its place, m/s.

    Attributes:
        speed: how fast it may go, as seen from its place, m/s; inf where nothing limits it.
    """

    def __init__(self, robot: int, keep_m: float, peers: Peers, reference: Reference, most: float) -> None:
        self._robot, self._keep_m, self._peers, self._reference = robot, keep_m, peers, reference
        # What is late by less than this leaves everybody as fast as he is.
        self._late_ns = NS_PER_S * (PACE / most) ** 0.5
        self._until_ns = 0
        self.speed = inf

    def look(self, now_ns: int, here: Hand, near: Iterable[Peer]) -> None:
        """Finds out at the tick `now_ns`, at which the own hand is `here`, whose way meets the own one.

        Who may be slow for that, or makes way for somebody, is predicted so from now on (`Peer.slowly`).

        Args:
            near: the robots that the safety filter may have to keep it away from.
        """
        if now_ns >= self._until_ns:
            self.speed = inf
        own: Course | None = None
        way: list[_Point | None] = []
        for peer in near:
            message = peer.message
            if (
                not peer.lateness.forgiven_ns
                or peer.lateness.usual_ns <= self._late_ns
                or message is None
                or not message.following
                or not peer.is_heard(now_ns)
            ):
                continue
            late_ns = peer.lateness.usual_ns
            speed = PACE * (NS_PER_S / late_ns) ** 2
            if own is None:
                state = here.x, here.y, here.vx, here.vy
                own = self._peers.forecast.course(HandState.placed(self._robot, 0, now_ns, True, 0, state))
            meets = self._meet(own, way, peer, message, now_ns, late_ns)
            if meets or hypot(message.correction_x, message.correction_y) > TURNED:
                peer.slowly, peer.slowly_until_ns = speed, now_ns + late_ns
            if meets:
                self.speed, self._until_ns = min(speed, self.speed), now_ns + late_ns

    def _meet(
        self,
        own: Course,
        way: list[_Point | None],
        peer: Peer,
        message: HandState,
        now_ns: int,
        late_ns: int,
    ) -> bool:
        """Whether two that do as the law says, and make no way for anybody, come too near to each other.

        Args:
            way: the own one, as far as it has been asked for; it is the same beside every other.
        """
        keep = self._keep_m + said_doubt(late_ns / NS_PER_S) + MORE_M
        then_ns, until_ns = now_ns, now_ns + late_ns + _AHEAD_NS
        theirs, ahead_ns, k = self._peers.forecast.course(message), peer.clock.used_ns, 0
        while then_ns < until_ns:
            at = self._reference.instant(then_ns)
            if k == len(way):
                way.append(self._on(own, then_ns, 0, at))
            mine, other = way[k], self._on(theirs, then_ns, ahead_ns, at)
            if mine is None or other is None:
                return False
            apart = hypot(mine.place_x - other.place_x, mine.place_y - other.place_y)
            if hypot(mine.x - other.x, mine.y - other.y) < min(keep, AT_PLACE * apart):
                return True
            then_ns += _STEP_NS
            k += 1
        return False

    def _on(self, course: Course, then_ns: int, ahead_ns: int, at: Instant) -> _Point | None:
        """Where one whose clock is ahead by so much would be at a time of the own clock, at which the desired
        motion is `at`; None for one without a place."""
        robot = course.message.robot
        by_its_clock = self._reference.instant(then_ns + ahead_ns) if ahead_ns else at
        if robot not in at.offsets or robot not in by_its_clock.offsets:
            return None
        found = self._peers.forecast.on(course, then_ns + ahead_ns, by_its_clock)
        x, y = found.position
        place_x, place_y, _, _, _, _ = at.motion(robot)
        return _Point(x, y, place_x, place_y)
