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

One that is heard, and has given up this robot, is kept from as if it had been given up as well: it drives by
where it believes this one to be.

Nothing of this is looked at while nobody has been given up that may be driving.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterable, Mapping
from math import ceil, hypot
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Hand
from handfast.agent.control.limits import barrier_rate, speed_max
from handfast.agent.control.peers.beliefs import DOUBT_MAX, Lane, Run, offset, stands_after
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.safety_filter import HalfPlane, keep_clear
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.reference import Reference
from handfast.agent.messages.codec import Mark
from handfast.agent.messages.types import HandState

LANE_SHARE: Final = 2.0
"""Half the width of a lane, in safe distances: so a body that stands on it can be passed within it."""
GAINED_NS: Final = 3 * NS_PER_S
"""More than half must be there for so long before they have the right of way: whoever had it until then has
given it up, or is known."""
REMEMBERED_S: Final = 5.0
LOOKS_PER_S: Final = 10
LANES_PER_LOOK: Final = 4


class KeepOut(NamedTuple):
    """A lane to keep out of: whose, and the runs of it that are near."""

    name: str
    runs: tuple[Run, ...]


class _Parting(NamedTuple):
    """When two robots lost each other: where this one was, and, where the other one is heard still, which
    mission this one had told, and the other's message."""

    here: HandState
    mark: Mark | None = None
    message: HandState | None = None


class _Ways(NamedTuple):
    """Of one possible mover: its lane, from its last message on; the own one from where this robot was `then`
    on, as that one knows it; both by what the two follow, as far as both know. on: it stands on that."""

    message: HandState
    then: _Parting
    follows: Reference
    lane: Lane
    own: Lane
    on: bool


class RightOfWay:
    """What robot `robot` has to heed of the lanes of others.

    Args:
        references: what the fleet is to do by the missions of late, by their marks.

    Attributes:
        hold: why it must stand, "" when it may drive.
        keep_out: lanes of others that it must not come into.
        keep_in: the runs near it of its own lane, as each of those knows it for whom it has to keep to it;
            empty when it may leave that.
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
        self._tube = self._half_width - margin
        self._inside = self._half_width + safe
        self._apart = self._inside + margin
        self._rate, most = barrier_rate(fleet), speed_max(fleet)
        self._within = self._apart + most / self._rate + most / LOOKS_PER_S
        self._horizon_ns = round(fleet.control.prediction_horizon_s * NS_PER_S)
        horizon_s = fleet.control.prediction_horizon_s
        rest_ns = (
            3 * (fleet.beacon_rounds_max - fleet.beacon_rounds) * fleet.period_ns
        )  # and so much is forgiven
        remembered_s = horizon_s + REMEMBERED_S + rest_ns / NS_PER_S
        self._mark: Mark = 0, 0
        self._own: deque[_Parting] = deque(maxlen=ceil(remembered_s * LOOKS_PER_S))
        self._gaining_ns = GAINED_NS + rest_ns
        self._then: dict[int, _Parting] = {}  # by robot: when it was heard last, or heard this one
        self._lanes_per_look = LANES_PER_LOOK if not rest_ns else 1
        self._ways: dict[int, _Ways] = {}
        self._gained_ns: int | None = 0  # all begin together
        self._stands: dict[int, int] = {}  # by robot: since when it can only stand, or is about to
        self._stood_ns = round((stands_after(horizon_s, 0.0) - horizon_s) * NS_PER_S)
        self.hold = ""
        self.keep_out: tuple[KeepOut, ...] = ()
        self.keep_in: tuple[tuple[Run, ...], ...] = ()

    def told(self, now_ns: int, here: Hand, mark: Mark) -> None:
        """From now on others have a beacon that tells this mission, and go by that."""
        self._mark = mark
        self._own.append(self._parting(now_ns, here))

    def _parting(self, now_ns: int, here: Hand) -> _Parting:
        place = here.x, here.y, here.vx, here.vy
        return _Parting(HandState.placed(self._robot, 0, now_ns, True, 0, place), self._mark)

    def look(self, now_ns: int, here: Hand, *, rests: bool = False, passing: bool = False) -> None:
        """Find out which lanes to heed from the tick `now_ns` on, at which the own hand is `here`.

        Args:
            rests: it does not drive for a while, and need not know yet.
            passing: it goes round something, and so leaves its own lane where nobody may be for whom it has
                to keep to that.
        """
        self._own.append(self._parting(now_ns, here))
        overdue = self._peers.overdue(now_ns)
        lost = [peer for peer in overdue if peer.late_ns(now_ns) > self._horizon_ns and not peer.is_gone]
        blind = [peer for peer in overdue if peer.deaf and self._is_blind(peer, now_ns)]
        self._remember_partings(lost, blind)
        has_way = self._has_way(now_ns, lost, blind)
        self.hold, self.keep_out, self.keep_in = "", (), ()
        if rests or not lost:
            self._stands.clear()
        if rests:
            return
        movers = self._movers(lost, blind, now_ns)
        strangers = [] if self._peers.was_there else [peer.name for peer in movers if peer.deaf]
        if strangers:  # they know it by what it said before it started, which it does not know itself
            self.hold = f"not heard since it started by {', '.join(strangers)}"
        if strangers or not movers:
            self._ways.clear()
            return
        if not self._make_lanes(movers):
            self.hold = f"works out the ways of {len(movers)} silent robots"
        self._heed(now_ns, here, movers, blind, has_way=has_way, passing=passing)

    def _remember_partings(self, lost: list[Peer], blind: list[Peer]) -> None:
        """Keep where this robot was when it and each of these lost each other."""
        then = self._then
        if not lost and not blind and not then:
            return
        self._then = {
            peer.robot: then.get(peer.robot) or _Parting(self._at(_heard_ns(peer)).here) for peer in lost
        }
        for peer in blind:
            parted = then.get(peer.robot) or self._at(peer.knows_ns)
            self._then[peer.robot] = parted if parted.message else parted._replace(message=peer.message)

    def _heed(
        self, now_ns: int, here: Hand, movers: list[Peer], blind: list[Peer], *, has_way: bool, passing: bool
    ) -> None:
        """Set which lanes to keep out of and in, and `hold` if the robot is on a lane already."""
        out: list[KeepOut] = []
        tubes: dict[int, Lane] = {}
        for peer in movers:
            ways = self._ways.get(peer.robot)
            if ways is None or (has_way and ways.on):
                continue
            near = ways.lane.near(here.x, here.y, self._within)
            if not has_way:  # wherever the other is by now: out of this lane, if it has left its own
                tubes[id(ways.own)] = ways.own
            if not near:
                continue
            if has_way and peer.direct_ns >= 0 and self._keeps_within(ways.own, near, here, passing):
                tubes[id(ways.own)] = ways.own
            elif _length(_nearest(near, here)) >= self._inside:
                out.append(KeepOut(f"lane of {peer.name}", near))
            elif not self.hold:
                described = self._described(peer, now_ns, is_heard=peer in blind, has_way=has_way)
                self.hold = f"on the lane of {described}"
        self.keep_out = tuple(out)
        nearby = (own.near(here.x, here.y, self._within) for own in tubes.values())
        self.keep_in = tuple(runs for runs in nearby if runs)

    def _described(self, peer: Peer, now_ns: int, *, is_heard: bool, has_way: bool) -> str:
        """Return the name of a robot with its right of way and why the two do not hear each other."""
        why = "" if has_way else ", which has the right of way"
        age_s = (now_ns + peer.clock.used_ns - peer.time_ns) / NS_PER_S
        return f"{peer.name}{why} ({'does not hear this one' if is_heard else f'silent for {age_s:.1f} s'})"

    def planes(self, own: Hand) -> Iterable[HalfPlane]:
        """The half planes of the own hand that keep it where it may be."""
        velocity = own.vx, own.vy
        for name, runs in self.keep_out:
            for run in runs:
                dx, dy = offset(run, own.x, own.y)
                away = hypot(dx, dy)
                if away > 0.0:
                    yield keep_clear(name, away, dx / away, dy / away, velocity, self._apart, self._rate)
        for runs in self.keep_in:
            dx, dy = _nearest(runs, own)
            away = hypot(dx, dy)
            if away > 0.0:
                room = self._tube - away
                yield keep_clear("own lane", room, -dx / away, -dy / away, velocity, 0.0, self._rate)

    def _at(self, time_ns: int) -> _Parting:
        """Where the robot was at a time, or the first that it remembers."""
        return next((each for each in reversed(self._own) if each.here.time_ns <= time_ns), self._own[0])

    # ------------------------------------------------------------------ who

    def _is_blind(self, peer: Peer, now_ns: int) -> bool:
        """Whether a robot that does not hear this one, but is heard, has given it up: nobody tells it."""
        heard = not peer.is_gone and peer.late_ns(now_ns) <= self._horizon_ns
        return heard and now_ns - peer.knows_ns > self._horizon_ns

    def _has_way(self, now_ns: int, lost: list[Peer], blind: list[Peer]) -> bool:
        """Whether the robot has the right of way.

        Whoever cut it off from those that are lost may have cut it off from others at the same time, who say
        so seldom where they are that they are not missed yet: they count once they have been heard since.
        """
        if not lost and not blind:
            self._gained_ns = self._gained_ns if self._gained_ns is not None else now_ns
            return True
        lost_ns = max(map(_heard_ns, lost), default=0)
        there = {peer.robot for peer in self._peers.known if not peer.is_gone}
        there.add(self._robot)
        group = {
            peer.robot
            for peer in self._peers.known
            if peer.robot in there
            and not peer.deaf
            and peer.direct_late_ns(now_ns) <= self._horizon_ns
            and (not self._peers.is_seldom(peer) or _direct_ns(peer) > lost_ns)
        }
        group.add(self._robot)
        more = 2 * len(group) - len(there)
        if more < 0 or (more == 0 and min(there) not in group):
            self._gained_ns = None
            return False
        if self._gained_ns is None:
            self._gained_ns = now_ns
        return self._gained_ns == 0 or now_ns - self._gained_ns >= self._gaining_ns

    def _movers(self, lost: list[Peer], blind: list[Peer], now_ns: int) -> list[Peer]:
        """Return the robots that may drive on.

        A lost one may if it shares an edge with a robot that would not tell this one of it, or shares none.
        That robot does not hear this one or is not heard by it, except by what others relay.
        """
        found: list[Peer] = []
        if lost:
            known = {peer.robot: peer for peer in self._peers.known}
            silent = {
                robot
                for robot, peer in known.items()
                if peer.deaf or peer.direct_late_ns(now_ns) > self._horizon_ns
            }
            stood = {}
            for peer in lost:
                since_ns = self._stands.get(peer.robot, now_ns)
                if self._may_drive(peer, known, silent, stands=now_ns - since_ns >= self._stood_ns):
                    found.append(peer)
                else:
                    stood[peer.robot] = since_ns
            self._stands = stood
        return found + [peer for peer in blind if peer.message is not None and peer.message.following]

    def _may_drive(
        self, peer: Peer, known: Mapping[int, Peer], silent: Container[int], *, stands: bool
    ) -> bool:
        """Whether a robot that has been given up has a place and somebody who keeps it driving: by a mission
        that neither of the two has left.

        Args:
            stands: it has stood, by (S2): with somebody who falls silent later it drives by what holds then.
        """
        heard_ns = _heard_ns(peer)
        for number, edges in self._reference.sharing(peer.robot, self._reference.since(peer.mark, heard_ns)):
            if not edges:
                return True
            for edge in edges:
                other = known.get(edge.other)
                if other is None:
                    continue
                # Who speaks seldom may have been lost with it, and be missed later: until heard since.
                if edge.other in silent or (self._peers.is_seldom(other) and not _heard_since(other, peer)):
                    since_ns = max(heard_ns, _heard_ns(other)) if stands else heard_ns
                    if number >= self._reference.since(other.mark, since_ns):
                        return True
        return False

    # ------------------------------------------------------------------ where

    def _keeps_within(self, own: Lane, near: tuple[Run, ...], here: Hand, passing: bool) -> bool:
        """Whether a robot that has the right of way has to keep within its own lane for a robot whose lane is
        `near`: it is in it, and not out of that one, or not by as much as it is within (F1). If it is out of
        its own and in that one, it goes back, as long as the other may not be where it is."""
        ox, oy = own.offset(here.x, here.y)
        off = hypot(ox, oy)
        dx, dy = _nearest(near, here)
        away = hypot(dx, dy)
        if off > self._half_width:
            return away < self._inside and off < self._apart
        if away < self._apart:
            return True
        leaving = (ox * here.vx + oy * here.vy) / off if off > 0.0 else 0.0
        within = self._rate * (self._tube - off) - leaving
        out = self._rate * (away - self._apart) + (dx * here.vx + dy * here.vy) / away
        return within >= (out if passing else min(out, 0.0))

    def _stands_on(self, own: Lane, peer: Peer) -> bool:
        """Whether a robot without the right of way, wherever it may be, is on the lane of this one, which has
        it: there it stands, and is a body to be gone round."""
        belief = self._peers.whereabouts.belief(peer)
        if peer.direct_ns < 0 or belief is None:
            return False
        surely = 2.0 * self._inside - self._apart  # though the two may mean lanes that differ a little
        off = surely - belief.doubt - DOUBT_MAX
        return all(own.reaches(x, y, off) for x, y in belief.way)

    def _known_to(self, peer: Peer) -> Reference:
        """What a robot follows, as far as both know."""
        own = self._then[peer.robot].mark  # the other goes by what it heard of this one last
        return self._references.get(peer.mark if own is None else own, self._reference)

    def _make_lanes(self, movers: list[Peer]) -> bool:
        """Makes the lanes of movers, and the own one as they know it, that are not known yet, no more than a
        tick has time for; whether all are known."""
        made = 0
        for peer in movers:
            then = self._then[peer.robot]
            message = then.message or self._peers.whereabouts.last_of(peer)
            known = self._ways.get(peer.robot)
            if known is not None and known.message is message and known.then is then:
                continue
            if made == self._lanes_per_look:
                return False
            made += 1
            follows = self._known_to(peer)
            same = (each.own for each in self._ways.values() if each.then is then and each.follows is follows)
            own = next(same, None) or self._peers.forecast.lane(then.here, follows)
            lane = self._peers.forecast.lane(message, follows)
            self._ways[peer.robot] = _Ways(message, then, follows, lane, own, self._stands_on(own, peer))
        return True


def _heard_ns(peer: Peer) -> int:
    return peer.time_ns - peer.clock.used_ns


def _direct_ns(peer: Peer) -> int:
    return peer.direct_ns - peer.clock.used_ns


def _heard_since(peer: Peer, lost: Peer) -> bool:
    """Whether a robot has been heard, itself, since another one was last."""
    return _direct_ns(peer) > _heard_ns(lost)


def _nearest(runs: tuple[Run, ...], here: Hand) -> Vector:
    """From the nearest point of the runs to the hand."""
    return min((offset(run, here.x, here.y) for run in runs), key=_length)


def _length(vector: Vector) -> float:
    return hypot(*vector)
