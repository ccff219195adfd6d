"""Who goes on where robots that cannot hear each other may meet, and who waits (PURE).

A robot that has been given up and that may be driving on, since another one that it shares an edge with has
been given up as well, is taken to keep to its *lane*: the way that others know of it, from its last message
to the end of the mission, and `LANE_SHARE` safe distances to either side. Lanes are places, not times:
nobody knows how far it is along its own.

A robot has the *right of way* while it, and those that it hears and that hear it, are more than half of the
fleet; of two halves that with the lowest id has it. Two groups that both have more than half share a robot,
which tells either of the other. Who has the right of way drives on within its own lane, and only outside of
it has to keep out of the others'. Who has none keeps to its own lane and out of those of all others that may
be driving; if it is in one of them already, it stands until it hears them. Either way there is a safe
distance between the two: (S5) of docs/theory.md.

Nothing of this is looked at while nobody has been given up that may be driving.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from math import ceil, hypot
from typing import Final, NamedTuple

from agent.common.time import NS_PER_S
from agent.control.hand import Hand
from agent.control.peers.beliefs import DOUBT_MAX
from agent.control.peers.lanes import Lane, Run, offset
from agent.control.peers.peers import Peer, Peers
from agent.control.safety_distances import barrier_rate
from agent.control.safety_filter import HalfPlane, keep_clear
from agent.fleet.model import Fleet
from agent.formation.reference import Reference
from agent.messages.types import HandState

LANE_SHARE: Final = 2.0
"""Half the width of a lane, in safe distances: so a body that stands on it can be passed within it."""
GAINED_NS: Final = 3 * NS_PER_S
"""More than half must be there for so long before they have the right of way: whoever had it until then has
given it up, or is known."""
REMEMBERED_S: Final = 5.0
LOOKS_PER_S: Final = 10
LANES_PER_LOOK: Final = 4

Mark = tuple[int, int]
"""Of a mission, as beacons have it: version and tag."""


class KeepOut(NamedTuple):
    """A lane to keep out of: whose, and the runs of it that are near."""

    name: str
    runs: tuple[Run, ...]


class RightOfWay:
    """What robot `robot` has to heed of the lanes of others.

    Args:
        references: what the fleet is to do by the missions of late, by their marks.

    Attributes:
        hold: why it must stand, "" when it may drive.
        keep_out: lanes of others that it must not come into.
        keep_in: the runs near it of its own lane, empty when it may leave that.
    """

    def __init__(
        self,
        fleet: Fleet,
        robot: int,
        peers: Peers,
        reference: Reference,
        references: Mapping[Mark, Reference],
    ) -> None:
        self._robot, self._peers, self._reference, self._references = robot, peers, reference, references
        self._ids = frozenset(fleet.ids)
        safe, margin = fleet.formation.safe_distance_m, fleet.avoidance.margin_m
        self._half_width = LANE_SHARE * safe
        self._inside = self._half_width + safe
        self._apart = self._inside + margin
        self._rate, most = barrier_rate(fleet), fleet.control.max_speed_mps
        self._within = self._apart + most / self._rate + most / LOOKS_PER_S
        self._horizon_ns = round(fleet.control.prediction_horizon_s * NS_PER_S)
        horizon_s = fleet.control.prediction_horizon_s
        self._own: deque[HandState] = deque(maxlen=ceil((horizon_s + REMEMBERED_S) * LOOKS_PER_S))
        self._own_lane: Lane | None = None
        self._lanes: dict[int, tuple[HandState, Lane]] = {}
        self._gained_ns: int | None = 0  # all begin together
        self.hold = ""
        self.keep_out: tuple[KeepOut, ...] = ()
        self.keep_in: tuple[Run, ...] = ()

    def look(self, now_ns: int, here: Hand) -> None:
        """Finds out what is to be heeded from the tick `now_ns` on, at which the own hand is `here`."""
        place = here.x, here.y, here.vx, here.vy
        self._own.append(HandState.placed(self._robot, 0, now_ns, True, 0, place))
        lost = [peer for peer in self._peers.known if self._is_given_up(peer, now_ns)]
        has_way = self._has_way(now_ns, len(lost))
        movers = self._movers(lost, now_ns) if lost else []
        self.hold, self.keep_out, self.keep_in = "", (), ()
        if not movers:
            self._own_lane = None
            self._lanes.clear()
            return
        strangers = [] if self._peers.was_there else [peer.robot for peer in movers if peer.deaf]
        if strangers:  # they know it by what it said before it started, which it does not know itself
            self._own_lane = None
            self.hold = f"not heard since it started by {', '.join(f'robot {robot}' for robot in strangers)}"
            return
        own = self._find_own_lane(movers)
        if has_way:
            movers = [peer for peer in movers if not self._stands_on(own, peer)]
        made = self._make_lanes(movers)
        if made < len(movers):
            self.hold = f"works out the ways of {len(movers)} silent robots"
        out = []
        x, y = here.x, here.y
        is_in = own.distance(x, y) <= self._half_width
        must_keep_in = not has_way
        for peer in movers[:made]:
            near = self._lanes[peer.robot][1].near(x, y, self._within)
            if not near:
                continue
            if has_way and is_in and peer.direct_ns >= 0:
                must_keep_in = True
            elif min(hypot(*offset(run, x, y)) for run in near) < self._inside:
                why = "" if has_way else ", which has the right of way"
                age_s = (now_ns + peer.clock.used_ns - peer.time_ns) / NS_PER_S
                self.hold = self.hold or f"on the lane of robot {peer.robot}{why} (silent for {age_s:.1f} s)"
            else:
                out.append(KeepOut(f"lane of robot {peer.robot}", near))
        self.keep_out = tuple(out)
        if must_keep_in:
            self.keep_in = own.near(x, y, self._within)

    def planes(self, own: Hand) -> Iterable[HalfPlane]:
        """The half planes of the own hand that keep it where it may be."""
        velocity = own.vx, own.vy
        for name, runs in self.keep_out:
            for run in runs:
                dx, dy = offset(run, own.x, own.y)
                away = hypot(dx, dy)
                if away > 0.0:
                    yield keep_clear(name, away, dx / away, dy / away, velocity, self._apart, self._rate)
        if self.keep_in:
            dx, dy = min((offset(run, own.x, own.y) for run in self.keep_in), key=_length)
            away = hypot(dx, dy)
            if away > 0.0:
                room = self._half_width - away
                yield keep_clear("own lane", room, -dx / away, -dy / away, velocity, 0.0, self._rate)

    # ------------------------------------------------------------------ who

    def _is_given_up(self, peer: Peer, now_ns: int) -> bool:
        return not peer.is_gone and peer.late_ns(now_ns) > self._horizon_ns

    def _has_way(self, now_ns: int, lost: int) -> bool:
        """Whether the robot has the right of way."""
        if not lost:
            self._gained_ns = self._gained_ns if self._gained_ns is not None else now_ns
            return True
        there = {peer.robot for peer in self._peers.known if not peer.is_gone}
        there.add(self._robot)
        group = {
            peer.robot
            for peer in self._peers.known
            if peer.robot in there and not peer.deaf and peer.direct_late_ns(now_ns) <= self._horizon_ns
        }
        group.add(self._robot)
        more = 2 * len(group) - len(there)
        if more < 0 or (more == 0 and min(there) not in group):
            self._gained_ns = None
            return False
        if self._gained_ns is None:
            self._gained_ns = now_ns
        return self._gained_ns == 0 or now_ns - self._gained_ns >= GAINED_NS

    def _movers(self, lost: list[Peer], now_ns: int) -> list[Peer]:
        """Those who may drive on: they share an edge with somebody who would not tell this robot of them,
        as it does not hear it or is not heard by it, but by what others relay, or share none with anybody."""
        sharing = self._reference.sharing(min(map(_heard_ns, lost)))
        silent = {
            peer.robot
            for peer in self._peers.known
            if peer.deaf or peer.direct_late_ns(now_ns) > self._horizon_ns
        }
        found = []
        for peer in lost:
            others = sharing.get(peer.robot)
            if others is not None and (not others or others & silent):
                found.append(peer)
        return found

    # ------------------------------------------------------------------ where

    def _stands_on(self, own: Lane, peer: Peer) -> bool:
        """Whether a robot without the right of way, wherever it may be, is on the lane of this one, which has
        it: there it stands, and is a body to be gone round."""
        belief = self._peers.belief(peer)
        surely = 2.0 * self._inside - self._apart  # though the two may mean lanes that differ a little
        return (
            peer.direct_ns >= 0
            and belief is not None
            and all(own.distance(x, y) + size + DOUBT_MAX < surely for x, y, size, _ in belief.discs)
        )

    def _known_to(self, peer: Peer) -> Reference:
        """What a robot follows, as far as both know."""
        return self._references.get(peer.mark, self._reference)

    def _make_lanes(self, movers: list[Peer]) -> int:
        """Makes lanes that are not known yet, no more than a tick has time for; returns of how many, from the
        first on, they are known."""
        made = 0
        for count, peer in enumerate(movers):
            message = self._peers.last_of(peer)
            known = self._lanes.get(peer.robot)
            if known is None or known[0] is not message:
                if made == LANES_PER_LOOK:
                    return count
                made += 1
                lane = self._peers.forecast.lane(message, self._known_to(peer))
                self._lanes[peer.robot] = message, lane
        return len(movers)

    def _find_own_lane(self, movers: list[Peer]) -> Lane:
        """The own lane as those know it who heard this robot until they were given up."""
        if self._own_lane is None:
            first = min(movers, key=_heard_ns)
            heard_ns = _heard_ns(first)
            then = next((each for each in reversed(self._own) if each.time_ns <= heard_ns), self._own[0])
            self._own_lane = self._peers.forecast.lane(then, self._known_to(first))
        return self._own_lane


def _heard_ns(peer: Peer) -> int:
    return peer.time_ns - peer.clock.used_ns


def _length(vector: tuple[float, float]) -> float:
    return hypot(*vector)
