"""What a robot's beacons tell of robots that it does not hear, or that others do not."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.forecast import Forecast
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.overdue import Overdue
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.whereabouts import Whereabouts
from handfast.agent.messages.types import SILENT_MAX, Silent

ELSEWHERE_NS: Final = NS_PER_S
"""For so long a robot that is heard here is told of to one that has said that it does not hear it."""
ROWS_OF_MANY: Final = 2
"""In a large fleet it is worked out for one beacon of so many silent robots where they may be; and it tells
of so many that neither are near its sender nor lacked by one that is."""
TELLS_NS: Final = 2 * NS_PER_S
"""So long before the epoch of a mission robots begin to tell of those that they do not hear: nobody drives
before that, and while a large fleet starts most are not heard yet."""
NEVER_CAME_NS: Final = 0
"""Stamp of a row about a robot that was never heard."""


class SilentRows:
    """Makes the rows.

    Args:
        known: all robots that something is known of, as it grows.
        overdue: those of them that may be silent.
        whereabouts: where those may be that are not heard.
        forecast: how all of them move, and since when.
        starts: where the hands of all others are until they are heard, m, W.
        horizon_s: a robot that hears nobody for so long stands.
        is_large: whether the fleet is so large that rows wait for their turn.

    Attributes:
        near: of which robots `at` told last that are near, or lacked by one that is.
    """

    def __init__(
        self,
        known: Mapping[int, Peer],
        overdue: Overdue,
        whereabouts: Whereabouts,
        forecast: Forecast,
        starts: Mapping[int, Vector],
        horizon_s: float,
        *,
        is_large: bool,
    ) -> None:
        self._known, self._whereabouts, self._forecast, self._starts = known, whereabouts, forecast, starts
        self._overdue = overdue
        self._horizon_ns, self._is_large = horizon_s * NS_PER_S, is_large
        self._elsewhere: dict[int, int] = {}
        self._lacked_near: dict[int, int] = {}
        """Likewise, by those that this robot listens to."""
        self._told = self._told_far = 0
        self.near: Collection[int] = ()

    def are_told(self, now_ns: int) -> bool:
        """Whether a mission is near, or has begun, so that others need to know who is not heard here."""
        epoch_ns = self._forecast.epoch_ns
        return epoch_ns > 0 and now_ns >= epoch_ns - TELLS_NS

    @property
    def rounds_to_tell(self) -> int:
        """How many beacons of one robot it takes to tell of all that others do not hear, as they say now."""
        most = max((peer.unheard for peer in self._known.values()), default=0)
        return -(-most // (ROWS_OF_MANY if self._is_large else SILENT_MAX))

    def lacks(self, robots: Sequence[int], now_ns: int, *, near: bool) -> None:
        """Takes that somebody, who is `near` if this robot listens to him, does not hear these robots, and
        says no more until `now_ns`."""
        until_ns = now_ns + ELSEWHERE_NS
        for robot in robots:
            self._elsewhere[robot] = until_ns
            if near:
                self._lacked_near[robot] = until_ns

    def at(self, now_ns: int, *, was_there: bool, missed_ns: Callable[[int], int]) -> tuple[Silent, ...]:
        """What to tell of robots that are not heard here, or elsewhere, as rows of a beacon: in turn, where
        they are too many for one, or for a tick in which to work out where all of them may be. Nothing while
        no mission is near.

        In a large fleet those tell of a robot who listen to it, or to one that lacks it, which is what
        (S2) and (S5) ask for. If all the others did, in a fleet in trouble everybody would tell everybody of
        everybody.

        Args:
            was_there: whether the own robot has listened since the drive began, so that who never came to it
                never came.
            missed_ns: for how much of the time since an instant the own process did not run: what it did not
                hear meanwhile others have heard.
        """
        self.near = ()
        if not self.are_told(now_ns):
            return ()
        epoch_ns = self._forecast.epoch_ns
        begun = now_ns > epoch_ns
        told: list[Peer] = []
        far: list[Peer] = []
        for peer in self._may_be_told(now_ns):
            if peer.is_gone:
                continue
            robot = peer.robot
            if peer.message is None:
                if not (begun and robot in self._starts and (peer.never_came or was_there)):
                    continue
            elif self._elsewhere.get(robot, 0) <= now_ns and (
                peer.is_heard(now_ns) or _is_own_doing(peer, now_ns, missed_ns)
            ):
                continue
            is_near = peer.listened or self._lacked_near.get(robot, 0) > now_ns
            (told if is_near or not self._is_large else far).append(peer)
        self.near = {peer.robot for peer in told}
        if far:
            first = self._told_far % len(far)
            some = self._in_time((far[first:] + far[:first])[:ROWS_OF_MANY], now_ns)
            self._told_far = first + len(some)
            told += some
        if len(told) > (ROWS_OF_MANY if self._is_large else SILENT_MAX):
            first = self._told % len(told)
            told = (told[first:] + told[:first])[:SILENT_MAX]
            if self._is_large:
                told = self._in_time(told, now_ns)
            self._told = first + len(told)
        return tuple(self._row(peer, now_ns) for peer in told)

    def _may_be_told(self, now_ns: int) -> list[Peer]:
        """Those of which there may be something to tell, in the order in which they came to be known: whoever
        is heard here and lacked by nobody is none."""
        late = self._overdue.at(now_ns)
        if self._elsewhere:
            self._elsewhere = {robot: ns for robot, ns in self._elsewhere.items() if ns > now_ns}
        if not self._elsewhere:
            return late
        told = {peer.robot for peer in late}.union(self._elsewhere)
        return [peer for robot, peer in self._known.items() if robot in told]

    def _in_time(self, told: list[Peer], now_ns: int) -> list[Peer]:
        """The first of these, so many that not too much is to be worked out for them."""
        most = ROWS_OF_MANY
        for count, peer in enumerate(told):
            if not (
                peer.is_heard(now_ns)
                or self._heard_lately(peer, now_ns)
                or self._whereabouts.is_worked_out(peer)
            ):
                if not most:
                    return told[:count]
                most -= 1
        return told

    def _heard_lately(self, peer: Peer, now_ns: int) -> bool:
        """Whether a robot was heard so lately that everybody works out himself where it may be."""
        if not (self._is_large and peer.message is not None and peer.message.following):
            return False
        return now_ns + peer.clock.used_ns - peer.time_ns < self._horizon_ns

    def _row(self, peer: Peer, now_ns: int) -> Silent:
        """What to tell of a robot."""
        message = peer.message
        if message is None:
            start = self._starts[peer.robot]
            return Silent(peer.robot, NEVER_CAME_NS, True, *start, 0.0, 0.0, *start, 0.0)
        time_ns = min(now_ns, peer.time_ns - peer.clock.used_ns)
        belief = (
            None
            if self._heard_lately(peer, now_ns) or peer.is_heard(now_ns)
            else self._whereabouts.belief(peer)
        )
        here = message.x, message.y
        way = (*here, message.doubt) if belief is None else belief.straight(*here)
        return Silent(peer.robot, time_ns, message.following, *message.place, *way)


def _is_own_doing(peer: Peer, now_ns: int, missed_ns: Callable[[int], int]) -> bool:
    """Whether a robot that is not heard would be, had the own process run all the time."""
    since_ns = peer.time_ns - peer.clock.used_ns
    late_ns = now_ns - since_ns - peer.lateness.forgiven_ns
    return peer.here and late_ns - missed_ns(since_ns) < UNSURE_NS
