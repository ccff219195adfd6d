"""Robots that are not heard: which may be silent, where they may be, and which vehicles roll on (PURE).

`Overdue` keeps for each robot the earliest time at which it may be silent, so that robots need not be
looked at one by one. A message mostly puts that time off, and it is computed again only once it has come;
whatever may bring it forward is noted at once.

`SilentRows` holds what a robot's beacons say of robots that it does not hear, or that others do not. For
vehicles that roll on see (S3) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from heapq import heappop, heappush
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.beliefs import Belief, stands_after, stood_between
from handfast.agent.control.peers.forecast import Forecast
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peer import NEVER, SINCE_EVER, Peer
from handfast.agent.control.peers.rolling import STEP_S
from handfast.agent.messages.types import SILENT_MAX, HandState, Silent


class Overdue:
    """The robots that may be silent, of all that something is known of.

    Args:
        known: these by their ids; it may grow, by such as are added.
        within_ns: whoever is late by less is in time; `UNSURE_NS` at most.
    """

    def __init__(self, known: Mapping[int, Peer], within_ns: int = UNSURE_NS) -> None:
        self._known = known
        self._within_ns: Final = min(within_ns, UNSURE_NS)
        self._queue: list[tuple[int, int]] = []
        """(`Peer.overdue_ns`, robot), the next one first; others of a robot do not count."""
        self._late = set(known)

    def add(self, peer: Peer) -> None:
        """From now on something is known of a robot."""
        self._late.add(peer.robot)

    def note(self, peer: Peer) -> None:
        """Something has come of a robot, or of its presence, that may have it be silent sooner: less is
        forgiven it than before, its clock is found to be further ahead, it does not hear this robot, or there
        is no connection to it."""
        from_ns = self._overdue_from_ns(peer)
        if from_ns < peer.overdue_ns:
            self._await(peer, from_ns)

    def at(self, now_ns: int) -> list[Peer]:
        """Those that may be silent, in the order in which they came to be known: with no connection, never
        heard, late by `within_ns` or more as far as they are heard themselves, or such that say that they do
        not hear this robot."""
        known, queue, late = self._known, self._queue, self._late
        if late:
            for robot in tuple(late):
                peer = known[robot]
                from_ns = self._overdue_from_ns(peer)
                if from_ns > now_ns:
                    late.remove(robot)
                    self._await(peer, from_ns)
        while queue and queue[0][0] <= now_ns:
            before_ns, robot = heappop(queue)
            peer = known[robot]
            if robot in late or peer.overdue_ns != before_ns:
                continue
            from_ns = self._overdue_from_ns(peer)
            if from_ns > now_ns:
                self._await(peer, from_ns)
            else:
                peer.overdue_ns = SINCE_EVER
                late.add(robot)
        return [peer for robot, peer in known.items() if robot in late] if late else []

    def _await(self, peer: Peer, from_ns: int) -> None:
        peer.overdue_ns = from_ns
        heappush(self._queue, (from_ns, peer.robot))

    def _overdue_from_ns(self, peer: Peer) -> int:
        """From when on a robot may be silent, by the own clock, if nothing more comes of it."""
        if peer.deaf or not peer.here or peer.message is None:
            return SINCE_EVER
        return peer.direct_ns - peer.clock.used_ns + peer.lateness.forgiven_ns + self._within_ns


class Whereabouts:
    """Works out, once for each last message of a robot, where it may have gone since.

    Args:
        forecast: how all of them move.
        starts: where the hands of all others are until they are heard, m, W.
        horizon_s: a robot that hears nobody for so long stands.
    """

    def __init__(self, forecast: Forecast, starts: Mapping[int, Vector], horizon_s: float) -> None:
        self._forecast, self._starts, self._horizon_s = forecast, starts, horizon_s
        self._beliefs: dict[int, tuple[HandState, Belief]] = {}
        self._strangers: dict[int, HandState] = {}
        self._at_starts: dict[int, Belief] = {}

    def belief(self, peer: Peer) -> Belief | None:
        """Where a robot may be that is not heard; None for one whose body has been carried off, or of which
        nothing is known."""
        message, robot = peer.message, peer.robot
        if peer.is_gone:
            return None
        if message is None:
            unheard = self._at_starts.get(robot)
            if unheard is None and (start := self._starts.get(robot)) is not None:
                unheard = self._at_starts[robot] = stood_between(*start, *start, 0.0)
            return unheard
        if peer.belief is not None:
            return peer.belief
        known = self._beliefs.get(robot)
        if known is None or known[0] is not message:
            known = self._beliefs[robot] = (
                message,
                self._forecast.stood(
                    message, stands_after(self._horizon_s, peer.lateness.forgiven_ns / NS_PER_S)
                ),
            )
        return known[1]

    def is_worked_out(self, peer: Peer) -> bool:
        """Whether `belief` knows already where a robot may be."""
        known = self._beliefs.get(peer.robot)
        if peer.message is None or peer.belief is not None or peer.is_gone:
            return True
        return known is not None and known[0] is peer.message

    def last_of(self, peer: Peer) -> HandState:
        """What is known last of a robot; of one that was never heard, that it stands where it starts."""
        if peer.message is not None:
            return peer.message
        at = *self._starts[peer.robot], 0.0, 0.0
        stranger = HandState.placed(peer.robot, 0, 0, True, 0, at)
        return self._strangers.setdefault(peer.robot, stranger)


class LostVehicles:
    """Vehicles that nothing commands, as far as one robot can tell.

    Whoever hears nobody is most likely the one to whom nothing comes, and the others are commanded; but of
    those that were lost before he knows it. Where all fell silent at once, any of them may be lost.

    Args:
        known: the other robots by their ids; it may grow.
    """

    def __init__(self, known: Mapping[int, Peer], forecast: Forecast) -> None:
        self._known, self._forecast = known, forecast
        self._sure: frozenset[int] = frozenset()
        self._looked_ns = NEVER

    def may_roll(self, peer: Peer, now_ns: int) -> bool:
        """Whether the body of a robot may go on now, as nothing commands it."""
        if not peer.rolls_on or peer.is_gone or (peer.is_heard(now_ns) and not peer.is_astray):
            return False
        return self.hand(peer, now_ns) is not None

    def is_sure(self, peer: Peer, now_ns: int) -> bool:
        """Whether a robot that is not heard is known to be lost, and its body to go on."""
        if self._looked_ns != now_ns:
            self._looked_ns = now_ns
            known = self._known.values()
            latest_ns = max(each.direct_ns - each.clock.used_ns for each in known)
            self._sure = frozenset(each.robot for each in known if self._is_lost(each, now_ns, latest_ns))
        return peer.robot in self._sure

    def hand(self, peer: Peer, now_ns: int) -> Hand | None:
        """Where the hand of a robot that is not heard is (m, m/s, W) if nothing commands its body; None where
        it stands by then, or others are the lost ones."""
        if not self.is_sure(peer, now_ns) and self._sure:
            return None
        return self._rolled(peer, now_ns)

    def way(self, peer: Peer, now_ns: int) -> list[Vector]:
        """Where the hand of a robot is every `STEP_S` from now on, until it rests, m, W, if nothing commands
        its body."""
        went = peer.went
        if went is None:
            return []
        age = (now_ns + peer.clock.used_ns - went.time_ns) / NS_PER_S
        return self._forecast.rolling_on(went, age, STEP_S)

    def _rolled(self, peer: Peer, now_ns: int) -> Hand | None:
        went = peer.went
        if went is None:
            return None
        return self._forecast.rolling(went, (now_ns + peer.clock.used_ns - went.time_ns) / NS_PER_S)

    def _is_lost(self, peer: Peer, now_ns: int, latest_ns: int) -> bool:
        """Whether it has said so, or was missed before `latest_ns`, when the last of all was heard."""
        message = peer.message
        if message is None or peer.is_gone or (peer.is_heard(now_ns) and not peer.is_astray):
            return False
        if self._rolled(peer, now_ns) is None:
            return False
        missed_ns = peer.direct_ns - peer.clock.used_ns + peer.lateness.forgiven_ns + UNSURE_NS
        return not message.obeys or peer.is_astray or missed_ns < latest_ns


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
        for robot in self._known.keys() & set(robots):
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
