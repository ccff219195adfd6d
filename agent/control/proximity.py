"""What a robot must keep away from without sharing an edge with it: other robots, obstacles, the geofence.

Pure. Of robots, those within the sensing region are listened to in every tick; the others' beacons say when
they come near. Distances in m, positions in W.
"""

from __future__ import annotations

from collections.abc import Collection
from math import hypot, inf
from typing import Final

from handfast.agent.common.quantities import DISTANCE_MIN
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.boundaries import Boundary, fence_of, obstacles_of
from handfast.agent.control.hand import Hand
from handfast.agent.control.limits import (
    acceleration_max,
    avoidance_distance,
    barrier_rate,
    clearance,
    sensing_distance,
    speed_max,
)
from handfast.agent.control.peers.beliefs import DOUBT_RATE, Stretch
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import FENCE_WARN_M
from handfast.agent.formation.mission_plan import Plan

AHEAD_S: Final = 0.5
"""A robot that comes closer is listened to so much earlier: beacons and looks take about as long."""
STAY_M: Final = 0.15
"""A robot is listened to until it is so much further away than the sensing distance."""
FASTER: Final = 1.2
"""No body is so many times as fast as robots may be."""
SILENT_PER_LOOK: Final = 2
"""Of so many that have fallen silent it is worked out at one look where they may be."""
REST_MAX_NS: Final = 3 * NS_PER_S
"""Whoever is far away is looked at again after so long at the latest."""
LOOK_MANY_NS: Final = 3 * NS_PER_S // 20
"""In a large fleet whoever is not near is looked at again at the second look after this at the soonest: that
and the time between two beacons are still less than `AHEAD_S`."""


class Proximity:
    """What is near robot `robot`, and must be kept away from.

    Attributes:
        close: the other robots within the sensing region, neighbours left out.
        distance: d_a, m.
        obstacle_band: width of the band outside `clearance` in which obstacles push, m.
        clearance: how near the hand may come to an obstacle, m.
        obstacles, fence: of the fleet file; the fence None without one.
        is_large: see `agent.fleet.model.Fleet.is_large`.
    """

    def __init__(self, fleet: Fleet, robot: int, peers: Peers) -> None:
        self._fleet = fleet
        self._safe = fleet.formation.safe_distance_m
        self._robot, self._peers = robot, peers
        self.enabled: Final = fleet.avoidance.enabled
        self.clearance: Final = clearance(fleet.avoidance.clearance_m, self._safe)
        self.obstacles: Final[tuple[Boundary, ...]] = obstacles_of(fleet) if self.enabled else ()
        self.fence: Final[Boundary | None] = fence_of(fleet)
        self.warn: Final = FENCE_WARN_M if fleet.geofence is not None else 0.0
        self.close: tuple[Peer, ...] = ()
        self.distance = self.obstacle_band = self.sensing = self._staying = 0.0
        self._keep = self._safe + fleet.avoidance.margin_m
        self._until_seen_s = AHEAD_S + 1.0 / barrier_rate(fleet)  # then the filter begins to brake
        self._soon = self._keep + self._until_seen_s * speed_max(fleet)
        self.is_large: Final = fleet.is_large
        self._closing = 2.0 * FASTER * speed_max(fleet)  # two that make for each other, m/s
        # Of one that goes as it said only the own velocity changes: by a t. What that makes of the way in t,
        # and in `AHEAD_S`, is at most so much times t, up to `AHEAD_S`.
        self._turning = FASTER * acceleration_max(fleet) * 1.5 * AHEAD_S + DOUBT_RATE

    def plan(self, plan: Plan) -> None:
        """Takes the formation that holds from now on."""
        self.distance = avoidance_distance(
            self._fleet.avoidance.distance_m, self._safe, plan.edges, plan.offsets
        )
        self.obstacle_band = self.distance - self._safe
        if self._fleet.avoidance.distance_m is None:
            # A wide band would close gaps that a robot fits through, and pushing earlier gains nothing
            # against an obstacle that does not move.
            self.obstacle_band = min(self.obstacle_band, self._safe)
        self.sensing = sensing_distance(self._fleet, self.distance)
        self._staying = self.sensing + STAY_M
        for peer in self._peers.known:
            peer.far_until_ns = 0

    def look(self, now_ns: int, here: Hand, neighbours: Collection[int], *, rests: bool = False) -> bool:
        """Finds who is close to the own hand; True when these are others than before.

        Args:
            neighbours: robots that are listened to anyway.
            rests: it does not drive for a while, and need not know yet where silent ones may be.
        """
        near, silent = [], []
        # Most of a large fleet is too far away to come near until a while from now.
        for peer in [peer for peer in self._peers.known if peer.far_until_ns <= now_ns]:
            if peer.robot in neighbours:
                continue
            if peer.is_heard(now_ns):
                if self._is_near(peer, now_ns, here):
                    near.append(peer)
            elif self.is_large and not self._peers.whereabouts.is_worked_out(peer):
                silent.append(peer)
            elif self._is_silent_near(peer, now_ns, here):
                near.append(peer)
        if silent:
            near += self._near_of(silent, now_ns, here, 0 if rests else SILENT_PER_LOOK)
        near.sort(key=_by_id)
        before, self.close = self.close, tuple(near)
        if before == self.close:
            return False
        for peer in before:
            if peer not in self.close:
                self._peers.ignore(peer.robot)
        return True

    def _near_of(self, silent: list[Peer], now_ns: int, here: Hand, most: int) -> list[Peer]:
        """Those that are near, of robots of which is to be worked out where they may be: the nearest first,
        and no more than `most`, when many fall silent together. Others are as at the last look.
        """

        def away(peer: Peer) -> float:
            message = peer.message
            return 0.0 if message is None else hypot(message.x - here.x, message.y - here.y)

        silent.sort(key=away)
        near = [peer for peer in silent[most:] if peer in self.close]
        return near + [peer for peer in silent[:most] if self._is_silent_near(peer, now_ns, here)]

    def _is_near(self, peer: Peer, now_ns: int, here: Hand) -> bool:
        """Whether a robot that is heard is within the sensing region, or will be at the next look; wherever
        it may be. One that is far away rests: it is not asked for again before it could be."""
        message = peer.message
        assert message is not None
        vx, vy = message.vx, message.vy
        age_ns = now_ns + peer.clock.used_ns - peer.time_ns
        ahead_s = age_ns / NS_PER_S if message.following and age_ns > 0 else 0.0
        dx, dy = message.x + ahead_s * vx - here.x, message.y + ahead_s * vy - here.y
        away = hypot(dx, dy)
        nearest = away
        stood = inf
        if age_ns > UNSURE_NS:
            if self._peers.is_seldom(peer):
                stood = away - ahead_s * hypot(vx, vy)
                if stood < self._soon:
                    way = Stretch(message.x, message.y, ahead_s * vx, ahead_s * vy, 0.0, 0.0)
                    stood = way.distance(here.x, here.y)
                if stood < away:
                    nearest = stood
            elif hypot(message.x - here.x, message.y - here.y) < self.sensing:
                return True  # silent a little longer, it may have stood there: beacons alone would not do
        reach = peer.doubt(now_ns) + (self._staying if peer in self.close else self.sensing)
        room = nearest - reach
        rest_s = room / self._closing - AHEAD_S
        if rest_s < AHEAD_S:  # else it rests for longer than what it says it will do could let it
            speed = hypot(vx - here.vx, vy - here.vy)
            if self._peers.is_seldom(peer):  # it may come to a stand anywhere
                speed = max(speed, hypot(vx, vy), hypot(here.vx, here.vy))
            as_said_s = (room - speed * AHEAD_S) / (speed + self._turning)
            if as_said_s > rest_s:
                # After so long it may be anywhere.
                lasts_s = (UNSURE_NS + peer.lateness.forgiven_ns - age_ns) / NS_PER_S
                rest_s = max(rest_s, min(AHEAD_S, lasts_s, as_said_s))
        if rest_s > 0.0:
            self._rest(peer, now_ns, rest_s)
            return False
        if stood < self._keep + self._until_seen_s * hypot(here.vx, here.vy):
            # It says seldom where it is, and may have come to a stand anywhere on its way. Whoever is
            # listened to and silent is noticed in time to brake for it.
            return True
        parting = (dx * (vx - here.vx) + dy * (vy - here.vy)) / max(away, DISTANCE_MIN)
        return self._is_within(peer, now_ns, away, parting, reach)

    def _is_silent_near(self, peer: Peer, now_ns: int, here: Hand) -> bool:
        """As `_is_near`, of one that is not heard."""
        message = peer.message
        if message is not None and self.is_large:
            # Where it may be takes a while to find out, and of most it is enough how far it can be.
            age_s = max(0.0, (now_ns + peer.clock.used_ns - peer.time_ns) / NS_PER_S)
            away = hypot(message.x - here.x, message.y - here.y) - peer.doubt(now_ns)
            rest_s = (away - self.sensing - STAY_M) / self._closing - 0.5 * age_s - AHEAD_S
            if rest_s > 0.0:
                peer.far_until_ns = now_ns + min(REST_MAX_NS, int(rest_s * NS_PER_S))
                return False
        belief = self._peers.whereabouts.belief(peer)
        if belief is None:
            return False
        dx, dy = belief.x - here.x, belief.y - here.y
        away = hypot(dx, dy)
        reach = belief.reach + (self._staying if peer in self.close else self.sensing)
        room = away - reach
        as_said_s = min(AHEAD_S, (room - self._closing * AHEAD_S) / (self._closing + self._turning))
        rest_s = max(room / self._closing - AHEAD_S, as_said_s)
        if rest_s > 0.0:
            self._rest(peer, now_ns, rest_s)
            return False
        parting = (dx * (0.0 - here.vx) + dy * (0.0 - here.vy)) / max(away, DISTANCE_MIN)
        return self._is_within(peer, now_ns, away, parting, reach)

    def _rest(self, peer: Peer, now_ns: int, rest_s: float) -> None:
        """Has a robot rest for so long at most."""
        rest_ns = int(rest_s * NS_PER_S)
        if rest_ns > REST_MAX_NS:
            rest_ns = REST_MAX_NS
        elif rest_ns < LOOK_MANY_NS and self.is_large:
            rest_ns = LOOK_MANY_NS
        peer.far_until_ns = now_ns + rest_ns

    def _is_within(self, peer: Peer, now_ns: int, away: float, parting: float, reach: float) -> bool:
        """Whether a robot that may not rest is near: so far `away` (m) it is, and goes off so fast (m/s)."""
        if away + min(0.0, parting) * AHEAD_S < reach:
            return True
        if self.is_large:
            peer.far_until_ns = now_ns + LOOK_MANY_NS
        return False

    def fence_distance(self, x: float, y: float) -> float:
        """How far inside the geofence a point is, m, below 0 outside; inf further in than it warns."""
        if self.fence is None:
            return inf
        near = self.fence.near(x, y, self.warn)
        return near[0].distance if near else inf


def _by_id(peer: Peer) -> int:
    return peer.robot
