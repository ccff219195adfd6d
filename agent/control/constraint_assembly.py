"""What the law and the safety filter have to keep at one tick: constraints, and half planes (PURE).

Edges with neighbours, robots and bodies without an edge, whoever is not heard, obstacles, the geofence, and
the lanes of others: found anew at every tick. Positions in m, W; accelerations in m/s^2, W. The numbers are
those of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot
from typing import Final

from handfast.agent.common.quantities import DISTANCE_MIN, Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import hand, law, safety_filter
from handfast.agent.control.caution import TURNED
from handfast.agent.control.couplings import Constraint
from handfast.agent.control.detour import LEAVING, SPEED_MIN, Blocker
from handfast.agent.control.limits import acceleration_max, barrier_rate, gains_of, one_sided, speed_max
from handfast.agent.control.peers import rolling
from handfast.agent.control.peers.beliefs import AHEAD_S, DOUBT_MAX, growth
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.peers.prediction import Prediction, coasting
from handfast.agent.control.peers.rolling import ROLL_ERROR
from handfast.agent.control.proximity import Proximity
from handfast.agent.control.right_of_way import RightOfWay
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.reference import Edge
from handfast.agent.messages.types import HandState

MOST_OF: Final = 0.7
"""So much of what gets a robot out of a body's way has to keep all else: where that leaves less of it, who
stands between two keeps from both."""
BESIDE: Final = 0.9
"""Share of the way from a body to the own place within which it may push."""
STOP_S: Final = 0.1
"""A robot is braked no harder than this makes it stand, s: what brakes it must not drive it back."""
_AT_REST: Final[Vector] = (0.0, 0.0)


class Scene:
    """What acts on the own hand at one instant, as it is found.

    now_ns: of the tick. own: the hand then; nx, ny: its navigation force, m/s^2. place: where it is to be, if
    that is at rest. constraints, planes: what the law and the safety filter have to keep. within: that to
    which it is nearer than it may be, but must not be driven from; stops: those of the planes that let it
    only leave that.
    """

    __slots__ = "constraints", "now_ns", "nx", "ny", "own", "place", "planes", "stops", "within"

    def __init__(self, now_ns: int, own: hand.Hand, nx: float, ny: float, place: Vector | None) -> None:
        self.now_ns: Final = now_ns
        self.own: Final = own
        self.nx: Final = nx
        self.ny: Final = ny
        self.place: Final = place
        self.constraints: Final[list[Constraint]] = []
        self.planes: Final[list[safety_filter.HalfPlane]] = []
        self.within: Final[list[Blocker]] = []
        self.stops: Final[list[safety_filter.HalfPlane]] = []


class ConstraintAssembly:
    """Finds what one robot has to keep.

    Args:
        peers, proximity, right_of_way: of that robot.

    Attributes:
        evades: whose way it gets out of, in words; "" when nobody's.
    """

    def __init__(
        self, fleet: Fleet, robot: int, peers: Peers, proximity: Proximity, right_of_way: RightOfWay
    ) -> None:
        self._peers, self._proximity, self._right_of_way = peers, proximity, right_of_way
        self._gains = gains_of(fleet)
        self._pushing = one_sided(self._gains)
        self._safe_distance, self._margin = fleet.formation.safe_distance_m, fleet.avoidance.margin_m
        self._barrier_rate, self._acceleration_max = barrier_rate(fleet), acceleration_max(fleet)
        body = fleet.robot(robot)
        turns = min(body.yaw_rate_max, rolling.TURN_MAX)
        self._ability = rolling.Ability(self._acceleration_max, speed_max(fleet), turns, body.hand_offset_m)
        self._rolling: dict[Peer, float] = {}
        self.evades = ""
        self._move = rolling.STAND
        self._is_own_law = fleet.control.law is not None

    def find(self, scene: Scene, time_ns: int, edges: tuple[tuple[Edge, Peer], ...], grip: float) -> None:
        """Adds to `scene` all constraints on the own hand at the wall time `time_ns`, and all half planes.

        Args:
            edges: those that count now, with what is known of the robot at the other end.
            grip: 0..1, how far the robot holds on to them.
        """
        own = scene.own
        for edge, peer in edges:
            weight = edge.weight * peer.trust * grip
            other = None
            if weight > 0.0 and peer.message is not None:
                other = self._peers.predict(peer, time_ns)
                offset = own.x - other.position[0], own.y - other.position[1]
                constraint = self._constraint(
                    scene, other, offset, edge.distance, self._gains, edge.rate, edge.bend
                )
                if weight < 1.0:
                    constraint = law.weighted(constraint, weight)
                scene.constraints.append(Constraint(peer.robot, constraint, other, peer.degree, False))
            if self._proximity.enabled:
                known = other if self._peers.predicts else None
                self._keep_away(scene, peer, time_ns, known, pushes=weight < 1.0)
        for peer in self._proximity.close:
            self._keep_away(scene, peer, time_ns, pushes=True)
        if self._proximity.enabled:
            self._keep_clear(scene)
            if self._right_of_way.keep_out or self._right_of_way.keep_in:
                for plane in self._right_of_way.planes(own):  # others may drive there, or not
                    scene.planes.extend(_pushing_last(plane, own, self._barrier_rate))

    def dodge(self, scene: Scene, body: hand.PoseTuple) -> Vector | None:
        """What to ask of the own hand, m/s^2, W, to get out of the way of those that roll on, though nothing
        commands them; None where standing does, or something else is in the way. What keeps it from them
        otherwise is taken out of `scene`.

        Args:
            body: the own one.
        """
        lost = self._rolling
        if not lost:
            self._move, self.evades = rolling.STAND, ""
            return None
        self._rolling = {}
        ways = [(self._peers.lost.way(peer, scene.now_ns), gap) for peer, gap in lost.items()]
        self._move = rolling.out_of_the_way(body, ways, self._ability, self._move)
        if self._move == rolling.STAND:
            self.evades = ""
            return None
        names = {peer.name for peer in lost}
        self.evades = f"gets out of the way of {' and '.join(sorted(names))}, which nothing commands"
        ux, uy = rolling.acceleration(body, self._move, self._ability)
        others = [plane for plane in scene.planes if plane.cause not in names]
        if any(
            MOST_OF * (plane.nx * ux + plane.ny * uy) < plane.least
            for plane in others
            if plane.rank <= safety_filter.SEPARATION
        ):
            return None
        scene.planes[:] = others
        return ux, uy

    def _constraint(
        self,
        scene: Scene,
        other: Prediction,
        offset: Vector,
        distance: float,
        gains: law.Gains,
        rate: float = 0.0,
        bend: float = 0.0,
    ) -> law.Edge:
        """The law's constraint with a robot. Of a distance that changes, the motion relative to it counts."""
        own = scene.own
        velocity = own.vx - other.velocity[0], own.vy - other.velocity[1]
        navigation = scene.nx - other.navigation[0], scene.ny - other.navigation[1]
        if rate or bend:
            scale = 1.0 / max(hypot(*offset), DISTANCE_MIN)
            away = scale * offset[0], scale * offset[1]
            velocity = velocity[0] - rate * away[0], velocity[1] - rate * away[1]
            navigation = navigation[0] - bend * away[0], navigation[1] - bend * away[1]
        return law.edge(offset, velocity, navigation, distance, self._safe_distance, gains)

    def _keep_away(
        self, scene: Scene, peer: Peer, time_ns: int, predicted: Prediction | None = None, *, pushes: bool
    ) -> None:
        """One-sided constraint (U1) against a robot at `time_ns`, if it `pushes`, and its half plane (F3)."""
        own, now_ns = scene.own, scene.now_ns
        message = peer.message
        if message is None or not peer.is_heard(now_ns) or peer.is_astray:
            self._keep_from_belief(scene, peer)
            return
        other = predicted or self._peers.carry(peer, time_ns)
        dx, dy = own.x - other.position[0], own.y - other.position[1]
        rho, doubt = hypot(dx, dy), peer.doubt(now_ns)
        if rho > self._proximity.sensing + (doubt if peer.rolls_on else 0.0):
            return
        name = peer.name
        distance = self._proximity.distance
        if pushes and rho - doubt < distance and scene.place is not None and not message.following:
            # A body that stays beside the place must not push it off that.
            x, y = scene.place
            apart = hypot(x - other.position[0], y - other.position[1]) - doubt
            distance = min(distance, max(BESIDE * apart, self._safe_distance + self._margin))
        if pushes and rho - doubt < distance:
            scale = max(rho - doubt, DISTANCE_MIN) / max(rho, DISTANCE_MIN)
            offset = dx * scale, dy * scale
            constraint = self._constraint(scene, other, offset, distance, self._pushing)
            scene.constraints.append(Constraint(-peer.robot, constraint, other, peer.degree, True, name))
        age_ns = now_ns + peer.clock.used_ns - peer.time_ns
        gap = self._safe_distance + self._margin + doubt
        if self._is_own_law:
            gap += self._unforeseen(age_ns / NS_PER_S)
        late = age_ns >= UNSURE_NS
        # What it does meanwhile is known only while its message is new.
        pushed = _AT_REST
        if not late:
            pushed = other.navigation[0] + other.constraint[0], other.navigation[1] + other.constraint[1]
        plane = safety_filter.keep_apart(
            name,
            (dx, dy),
            (own.vx, own.vy),
            other.velocity,
            gap,
            self._barrier_rate,
            # One that hears nothing of this robot cannot do its part, nor one that may hear too late of it.
            alone=late or peer.deaf or not message.following,
            other_acceleration=pushed,
            rank=_rank(doubt, follows=message.following, rolls=peer.rolls_on),
        )
        if late and plane.rank == safety_filter.SEPARATION and not peer.deaf:
            # (F12): where it is by now is a guess, and it keeps away by itself.
            scene.planes.extend(_pushing_last(plane, own, self._barrier_rate))
        else:
            scene.planes.append(plane)
        if message.following and _may_stand(message, late=late):
            self._keep_from_where_it_was(scene, name, message, age_ns, gap, rho)

    def _keep_from_where_it_was(
        self, scene: Scene, name: str, message: HandState, age_ns: int, gap: float, rho: float
    ) -> None:
        """The half plane (F13) against a robot that stands where its message had it, and is predicted to be
        further away, at `rho` m. It only brakes."""
        own = scene.own
        x, y = coasting(message, age_ns / NS_PER_S).position
        dx, dy = own.x - x, own.y - y
        near = gap + 2.0 * hypot(own.vx, own.vy) / self._barrier_rate  # further away it asks for nothing
        if hypot(dx, dy) < min(rho, near):
            plane = safety_filter.keep_apart(
                name, (dx, dy), (own.vx, own.vy), _AT_REST, gap, self._barrier_rate, alone=True
            )
            scene.planes.append(only_braking(plane, own, 1.0 / self._barrier_rate))

    def _keep_from_belief(self, scene: Scene, peer: Peer) -> None:
        """The half planes against wherever a robot may be that is not heard.

        Maybe it cannot hear this robot either, and looks for it on its way: what is only a guess stops it, as
        hard as need be, but must not push it off. A vehicle that is known to be lost looks for nobody: it is
        got out of the way of, as of what is known.
        """
        belief = self._peers.whereabouts.belief(peer)
        if belief is None:
            return
        own, name = scene.own, peer.name
        age = (scene.now_ns + peer.clock.used_ns - peer.time_ns) / NS_PER_S + AHEAD_S
        lost = peer.went is not None and self._peers.lost.is_sure(peer, scene.now_ns)
        if peer.went is not None:
            rank = safety_filter.SEPARATION if lost else safety_filter.UNSURE
            self._keep_from_rolling(scene, peer, peer.went.doubt + ROLL_ERROR, rank)
        speed, growing = hypot(own.vx, own.vy), growth(age)
        depth, deepest = 0.0, None
        for stretch in belief.stretches:
            if stretch.after > age:
                break
            x, y, at_end = stretch.offset(own.x, own.y)
            rho, radius = hypot(x, y), stretch.radius_at(age)
            if rho > self._proximity.sensing + radius:
                continue
            gap = self._safe_distance + self._margin + radius
            rank = safety_filter.UNSURE if radius >= DOUBT_MAX else safety_filter.SEPARATION
            plane = self._off_the_way(name, (x, y), own, gap, at_end, rank, growing)
            scene.planes.append(only_braking(plane, own))
            if rank == safety_filter.UNSURE and rho < gap:
                # How far it may be off that way is a guess, which gives way where others press (F12). The way
                # itself is by what it said and the law: there a body stands, and those who press make way.
                keep = gap - radius + stretch.radius
                way = self._off_the_way(name, (x, y), own, keep, at_end, safety_filter.STANDING)
                scene.planes.append(only_braking(way, own))
            if gap - rho > depth:
                depth, deepest = gap - rho, plane
        if deepest is not None:
            scene.within.append(Blocker(deepest.nx, deepest.ny, name, True, within=True, body=True))
            if lost:
                scene.planes.append(deepest.ranked(safety_filter.SEPARATION))
            elif deepest.nx * own.vx + deepest.ny * own.vy < LEAVING * speed:
                rate = self._barrier_rate
                stop = safety_filter.limit_speed(own.vx, own.vy, 0.0, rate, name, deepest.rank)
                scene.stops.extend(stop)
                scene.planes.extend(stop)

    def _keep_from_rolling(self, scene: Scene, peer: Peer, doubt: float, rank: int) -> None:
        """The half plane against where it rolls now if nothing commands it any more: it will not brake, and
        who only brakes in front of it is run over."""
        own, there = scene.own, self._peers.lost.hand(peer, scene.now_ns)
        if there is None:
            return
        dx, dy = own.x - there.x, own.y - there.y
        gap = self._safe_distance + self._margin + doubt
        if hypot(dx, dy) < self._proximity.sensing + gap:
            if rank == safety_filter.SEPARATION:
                self._rolling[peer] = gap
            velocity, rate = (own.vx, own.vy), self._barrier_rate
            scene.planes.append(
                safety_filter.keep_apart(
                    peer.name, (dx, dy), velocity, (there.vx, there.vy), gap, rate, alone=True, rank=rank
                )
            )

    def _off_the_way(
        self,
        name: str,
        offset: Vector,
        own: hand.Hand,
        gap: float,
        at_end: bool,
        rank: int,
        growth: float = 0.0,
    ) -> safety_filter.HalfPlane:
        """Keeps `gap` away from a stretch, which is `offset` from the own hand, m."""
        return safety_filter.keep_apart(
            name,
            offset,
            (own.vx, own.vy),
            _AT_REST,
            gap,
            self._barrier_rate,
            growth=growth,
            alone=True,
            straight=not at_end,
            rank=rank,
        )

    def _unforeseen(self, age: float) -> float:
        """How much further to keep from a robot that a law of others drives, m, by the age of its message, s.

        It may have accelerated in any direction since: by a t of speed, which the barrier takes a distance of
        a t / p to brake, and by a t^2 / 2 of place. Half of that, for both keep away.
        """
        age = max(0.0, age)
        return 0.5 * self._acceleration_max * age * (1.0 / self._barrier_rate + 0.5 * age)

    def _keep_clear(self, scene: Scene) -> None:
        """The same against obstacles and the geofence, which do not move."""
        proximity, own = self._proximity, scene.own
        boundaries = [(each, proximity.clearance, proximity.obstacle_band) for each in proximity.obstacles]
        if proximity.fence is not None:
            boundaries.append((proximity.fence, 0.0, proximity.warn))
        for boundary, clearance, band in boundaries:
            for near in boundary.near(own.x, own.y, proximity.sensing):
                if near.distance < clearance + band and not near.ahead:
                    # Along the boundary no motion changes the distance: only the part across it counts.
                    closing = near.nx * own.vx + near.ny * own.vy
                    room = max(near.distance, DISTANCE_MIN)
                    constraint = law.edge(
                        (near.nx * room, near.ny * room),
                        (near.nx * closing, near.ny * closing),
                        (scene.nx, scene.ny),
                        clearance + band,
                        clearance,
                        self._pushing,
                    )
                    key = f"{near.name} {near.side}"
                    scene.constraints.append(Constraint(key, constraint, None, 0, True, near.name))
                plane = safety_filter.keep_clear(
                    near.name,
                    near.distance,
                    near.nx,
                    near.ny,
                    (own.vx, own.vy),
                    clearance + self._margin,
                    self._barrier_rate,
                )
                scene.planes.append(plane)


def _may_stand(message: HandState, *, late: bool) -> bool:
    """Whether a robot that follows the law may be held where it is: it stood, or made way for somebody."""
    vx, vy = message.vx, message.vy
    if -SPEED_MIN < vx < SPEED_MIN and hypot(vx, vy) < SPEED_MIN:  # of most the first says it
        return True
    return late and hypot(message.correction_x, message.correction_y) > TURNED


def _rank(doubt: float, *, follows: bool, rolls: bool) -> int:
    """Of the half plane against a robot that is heard, whose place is so uncertain (m)."""
    if not follows and not (rolls and doubt > DOUBT_MAX):
        return safety_filter.STANDING
    # Where it is, nobody knows: those that are known come first.
    return safety_filter.UNSURE if doubt >= DOUBT_MAX else safety_filter.SEPARATION


def _pushing_last(
    plane: safety_filter.HalfPlane, own: hand.Hand, rate: float
) -> Iterator[safety_filter.HalfPlane]:
    """The two parts of a half plane against what is not sure, (F12): what would drive the robot off, after
    all that is known; and what braking at `rate` (1/s) gives, with it, for both can be met, (F4)."""
    brakes = only_braking(plane, own, 1.0 / rate)
    if brakes.least < plane.least:
        yield plane.ranked(safety_filter.UNSURE)
    yield brakes


def only_braking(
    plane: safety_filter.HalfPlane, own: hand.Hand, stop_s: float = STOP_S
) -> safety_filter.HalfPlane:
    """The half plane, as far as it brakes the own hand, no harder than this makes it stand (s): it does not
    drive it back."""
    closing = plane.nx * own.vx + plane.ny * own.vy
    return plane.asking(min(plane.least, -closing / stop_s))
