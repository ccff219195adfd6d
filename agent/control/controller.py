"""One robot's control law in time: from its plant's state and the other robots to a force and a torque.

Pure. It knows when a wrench acts: the plant takes it at its next tick and holds it for a period. So
the law is evaluated for the middle of that interval, with the own body and every other robot carried
forward to that instant; evaluated there, the sampled loop is of second order in the period
(docs/theory.md, P2).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from math import ceil, hypot, inf
from typing import TYPE_CHECKING, Final

from handfast.agent.common.models import new
from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import hand, law, safety_filter
from handfast.agent.control.caution import Caution
from handfast.agent.control.constraint_assembly import ConstraintAssembly, Scene
from handfast.agent.control.couplings import COUPLINGS
from handfast.agent.control.detour import NOTHING, SPEED_MIN, Blocker, Detour, Hold
from handfast.agent.control.limits import (
    RATE_SHARE,
    SPEED_SHARE,
    TURN_MAX,
    TURN_SHARE,
    acceleration_max,
    barrier_rate,
    gains_of,
    speed_max,
    speeding_rate,
)
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.peers.prediction import BRAKING_TIME_S, constraint_decay
from handfast.agent.control.peers.rolling import asked, rolls_of, setpoint
from handfast.agent.control.proximity import Proximity
from handfast.agent.control.right_of_way import RightOfWay
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import SEND_BOUND_M
from handfast.agent.formation.geometry import Geometry, start_hand
from handfast.agent.formation.mission_plan import Plan
from handfast.agent.formation.reference import Edge, Reference
from handfast.agent.formation.trajectory import Sample
from handfast.agent.links.ticks import next_tick_ns
from handfast.agent.messages.codec import Mark, mark_of
from handfast.agent.messages.types import ACTS_PERIODS, Forces, HandState, PlantState, Setpoint

if TYPE_CHECKING:
    from handfast.agent.control.own_law import OwnLaw

LOOK_AHEAD_NS: Final = NS_PER_S
"""So long before the epoch a robot begins to look whose way it may be in."""
LOOK_PERIOD_NS: Final = NS_PER_S // 10
"""How often robots that are near are looked for, ns."""
REST_PERIOD_NS: Final = NS_PER_S // 2
"""As `LOOK_PERIOD_NS`, in a large fleet while no mission is near."""
REFERENCES_MAX: Final = 8
"""So many missions are remembered, for those who have not heard the latest."""
AT_REST: Final[Vector] = (0.0, 0.0)
COASTING: Final = 0.0, 0.0
"""N, N m: what acts on a body whose last wrench is too old to act on."""
STANDS_NS: Final = 2 * NS_PER_S
"""Whoever is silent for so long longer than usual is gone round as what stands still."""
KEEPING_AWAY: Final = (safety_filter.STANDING, safety_filter.SEPARATION, safety_filter.UNSURE)
ACTIVE: Final = 1e-3
"""m/s^2: a half plane that leaves no more than this is what stops a robot."""
SLOW_SPEED: Final = 0.2
"""One that has to be careful drives at a share of the speed of its place and this (m/s) together."""


class Drive:
    """What one tick of the law gives.

    force (N) and torque (N m) to ask of the plant; forces: as a `HandState` has them, the navigation force
    F_n, the constraint force F_c and the correction that make up the acceleration, m/s^2, W; degree: how
    many constraints acted; causes: what the last stage changed it for; own: numbers that a law of others has
    for its neighbours.
    """

    __slots__ = "causes", "degree", "force", "forces", "own", "torque"

    def __init__(
        self,
        force: float,
        torque: float,
        forces: Forces,
        degree: int,
        causes: tuple[str, ...],
        own: tuple[float, ...],
    ) -> None:
        self.force: Final = force
        self.torque: Final = torque
        self.forces: Final[Forces] = forces
        self.degree: Final = degree
        self.causes: Final = causes
        self.own: Final = own


class Controller:
    """The law of robot `robot`.

    Attributes:
        reference: where every robot is to be, and who shares an edge.
        mark: of the mission that it goes by, as beacons have it.
        peers: what is known of the others; whoever receives their messages gives them to it.
        proximity: what must be kept away from besides.
        rests: whether it has not worked out where those may be that it does not hear: it need not know.
        coupling: its multipliers.
        detour: its way round what blocks it.
        taken: which body its place is taken by, in words; "" when by none.
        edges: the own edges that count now, with what is known of the robot at the other end.
    """

    def __init__(self, fleet: Fleet, geometry: Geometry, robot: int) -> None:
        body, control = fleet.robot(robot), fleet.control
        self._robot = robot
        self._period_ns = self._held_ns = fleet.period_ns
        self.reference: Final = Reference(fleet, geometry)
        self.peers: Final = Peers(
            robot,
            control.c1,
            control.c2,
            fleet.period_ns,
            self.reference.instant,
            # What a law of others asks for next, nobody can say: it counts for no longer than a period.
            decay=constraint_decay(control.kd, control.kp) if control.law is None else fleet.fleet.rate_hz,
            predict=control.prediction,
            most=speed_max(fleet) if fleet.avoidance.enabled else None,
            speeding=speeding_rate(fleet),
            starts={other.id: start_hand(other) for other in fleet.robots if other.id != robot},
            rolls_on={each.id: rolls for each in fleet.robots if (rolls := rolls_of(each))},
            horizon_s=control.prediction_horizon_s,
            beacon_ns=fleet.beacon_rounds * fleet.period_ns,
            beacon_max_ns=fleet.beacon_rounds_max * fleet.period_ns,
            bound_m=SEND_BOUND_M if control.send == "event" else 0.0,
        )
        self.proximity: Final = Proximity(fleet, robot, self.peers)
        self._references: dict[Mark, Reference] = {}
        self.mark: Mark = 0, 0
        self._told_mark: Mark = 0, 0
        self.right_of_way: Final = RightOfWay(fleet, robot, self.peers, self.reference, self._references)
        keep_m = fleet.formation.safe_distance_m + fleet.avoidance.margin_m
        # As seen from a place that moves as fast as robots may.
        self.caution: Final = Caution(robot, keep_m, self.peers, self.reference, 2.0 * speed_max(fleet))
        self.edges: tuple[tuple[Edge, Peer], ...] = ()
        self._course_edges: tuple[Edge, ...] = ()
        # Who lets go of its edges needs something else that keeps it off the others.
        bound = fleet.avoidance.enabled and control.law is None
        self.detour: Final = Detour(fleet.period_ns / NS_PER_S, control.c2, bound=bound)
        self._hold = NOTHING
        self._assembly = ConstraintAssembly(fleet, robot, self.peers, self.proximity, self.right_of_way)
        self.coupling: Final = COUPLINGS[control.coupling](gains_of(fleet), self.peers)
        self._own_law: OwnLaw | None = None
        if control.law is not None:
            from handfast.agent.control.own_law import OwnLaw  # here: others do not need it

            self._own_law = OwnLaw(fleet, robot, self.peers)
        self._c1, self._c2 = control.c1, control.c2
        self._safe_distance = fleet.formation.safe_distance_m
        self._acceleration_max = self._push_max = acceleration_max(fleet)
        self._speed_max = self._fastest = speed_max(fleet)
        self._barrier_rate, self._margin = barrier_rate(fleet), fleet.avoidance.margin_m
        self._speeding_rate = self._quickest = speeding_rate(fleet)
        self._mass, self._inertia, self._reach = body.mass_kg, body.inertia_kgm2, body.hand_offset_m
        self._yaw_rate_max = TURN_MAX * NS_PER_S / fleet.period_ns
        self._turn_quickest = TURN_SHARE * NS_PER_S / fleet.period_ns
        self._force_max, self._torque_max = body.max_force_n, body.max_torque_nm
        # Wrenches by the plant tick that takes them: as many as the oldest state to drive by can lack.
        self._sent: dict[int, tuple[float, float] | None] = {}
        self._sent_max = ceil(control.plant_timeout_s * NS_PER_S / fleet.period_ns) + 2
        self._planned: Plan | None = None
        self.taken = ""
        self._due_ns = 0
        self.rests = True

    @property
    def evades(self) -> str:
        """Whose way it gets out of, in words; "" when nobody's."""
        return self._assembly.evades

    def plan(self, plan: Plan) -> None:
        """Takes what the fleet is to do."""
        self.reference.take(plan)
        self.mark = mark_of(plan.mission)
        self._references[self.mark] = self.reference.frozen()
        while len(self._references) > REFERENCES_MAX:
            del self._references[next(iter(self._references))]
        self.peers.forecast.epoch_ns = plan.mission.epoch_ns
        self.peers.remove(plan.mission.removed)

    def told(self, now_ns: int, here: hand.Hand, mark: Mark) -> None:
        """A beacon is on its way that tells this mission: what others do by it they do from now on."""
        if mark != self._told_mark:
            self._told_mark = mark
            self.right_of_way.told(now_ns, here, mark)

    def keep_pace(self, period_ns: int, share: float) -> None:
        """From now on what it asks for is held for `period_ns`, the plant's period or a multiple of it, and
        robots drive at this share of their speed limit (R1), (R2)."""
        self._held_ns = period_ns
        self._speed_max = share * self._fastest
        if self.proximity.enabled:
            self.peers.forecast.most = self._speed_max
            self._acceleration_max = min(self._push_max, SPEED_SHARE * self._speed_max * NS_PER_S / period_ns)
        carried = min(self._quickest, RATE_SHARE * NS_PER_S / period_ns)
        self._speeding_rate = self.peers.forecast.speeding = max(self._barrier_rate, carried)
        self._yaw_rate_max = TURN_MAX * NS_PER_S / period_ns
        self._turn_quickest = TURN_SHARE * NS_PER_S / period_ns
        self.detour.period_s = period_ns / NS_PER_S
        if self._own_law is not None:
            self._own_law.period_s = period_ns / NS_PER_S
            self.peers.forecast.decay = NS_PER_S / period_ns

    def restart(self) -> None:
        """Forgets the multipliers: the robot begins to drive."""
        self.coupling.restart()
        if self._own_law is not None:
            self._own_law.restart()
        self._hold = NOTHING
        self.detour.reset()

    @property
    def held_s(self) -> float:
        """For how long what it asks for is held, s."""
        return self._held_ns / NS_PER_S

    def acts_from_ns(self, now_ns: int) -> int:
        """When a wrench that is sent now begins to act: at the plant's next tick."""
        return next_tick_ns(now_ns, self._period_ns, 0)

    def acting_ns(self, now_ns: int) -> int:
        """The middle of the time in which a wrench acts that is sent now: what the law is evaluated for."""
        return self.acts_from_ns(now_ns) + self._held_ns // 2

    def look(self, now_ns: int) -> None:
        """Finds who shares an edge at the tick `now_ns`."""
        time_ns = self.acting_ns(now_ns)
        active = self.reference.active(time_ns)
        if active is not self._planned:
            self._planned = active
            self.proximity.plan(active)
        edges = self.reference.edges(self._robot, time_ns)
        if edges is not self._course_edges:
            self._course_edges = edges
            self.edges = tuple((edge, self.peers.get(edge.other)) for edge in edges)

    def look_round(
        self, now_ns: int, here: hand.Hand, neighbours: Collection[int], *, held: bool = False
    ) -> bool:
        """Finds who is near the own hand, and whose way it may be in; True when others are to be listened to.

        A few times a second only; but at once when one that stood, and that it goes round, drives again.

        Args:
            neighbours: robots that are listened to anyway.
            held: it stands, and has other reasons to.
        """
        detour = self.detour
        if detour.fixed and any(detour.round == peer.name for peer, _ in self._driving(now_ns)):
            detour.free()
        epoch_ns = self.peers.forecast.epoch_ns
        before = self.rests
        self.rests = not epoch_ns or now_ns < epoch_ns - LOOK_AHEAD_NS or (held and self.proximity.is_large)
        begins = before and not self.rests and now_ns > epoch_ns - LOOK_PERIOD_NS
        if (now_ns < self._due_ns and not begins) or not self.proximity.enabled:
            return False
        waits = self.rests and self.proximity.is_large
        self._due_ns = now_ns + (REST_PERIOD_NS if waits else LOOK_PERIOD_NS)
        # While a large fleet starts, or its machines have too much to do, many are not heard: where they
        # might drive is worked out once it matters.
        passing = bool(detour.round)
        self.right_of_way.look(now_ns, here, rests=self.rests, passing=passing)
        self.caution.look(now_ns, here, (*(peer for _, peer in self.edges), *self.proximity.close))
        return self.proximity.look(now_ns, here, neighbours, rests=self.rests)

    def drive(self, plant: PlantState, now_ns: int, slower: float = 1.0) -> Drive:
        """The law at the tick `now_ns`. Its numbers may be absurd: look at them before they are sent.

        Args:
            slower: share of the speed that it would have, for one that has to be careful.

        Raises:
            handfast.agent.control.own_law.LawError: a law of others gives nothing to drive by.
        """
        acting_ns = self.acting_ns(now_ns)
        body = self._pose_at(plant, acting_ns)
        own = hand.hand(body, self._reach)
        motion = self.reference.motion(self._robot, acting_ns)
        assert motion is not None  # a robot without a place does not drive
        x, y, vx, vy, ax, ay = motion
        ex, ey = error = own.x - x, own.y - y
        c1, c2 = self._c1, self._c2
        if self.proximity.enabled:
            most = self._speed_max
            ex, ey = acting = law.acting_error(error, (vx, vy), c1, c2, most)
            firm = law.firmness(error, acting, (vx, vy), c1, c2, most, self._speeding_rate)
            c1, c2 = firm * c1, firm * c2
        nx = law.navigation_force(ax, ex, own.vx - vx, c1, c2)
        ny = law.navigation_force(ay, ey, own.vy - vy, c1, c2)
        # (21) aims at this velocity: F_n = rddot_d + c_2 (wanted - v).
        pull = self._c1 / self._c2
        wanted = vx - pull * ex, vy - pull * ey
        before, turned = self.taken, None
        self.taken = self._taken(now_ns, own, motion) if before or self.detour.looks else ""
        if not self.taken:
            turned = self.detour.velocity(wanted, (own.vx, own.vy), self._hold, (vx, vy), self.caution.speed)
        elif not before:
            self.detour.reset()
        gx, gy = nx, ny
        if turned is not None:
            # Round corners c_2 would be too slow: the wall is lost, and with it the way.
            gain = max(self._c2, self._barrier_rate) if self.detour.fixed else self._c2
            gx, gy = gain * (turned[0] - own.vx), gain * (turned[1] - own.vy)
        place = (x, y) if hypot(vx, vy) <= SPEED_MIN else None
        scene = Scene(now_ns, own, gx, gy, place)
        self._assembly.find(scene, acting_ns, self.edges, self.detour.grip)
        numbers: tuple[float, ...] = ()
        if self._own_law is None:
            cx, cy = self.coupling.force(scene.constraints)
        else:
            ux, uy = self._own_law.acceleration(now_ns, acting_ns, own, (gx, gy), motion, self.edges)
            cx, cy = ux - gx, uy - gy
            numbers = self._own_law.numbers
        ux, uy = gx + cx, gy + cy
        causes: tuple[str, ...] = ()
        if (dodge := self._assembly.dodge(scene, body)) is not None:
            ux, uy = dodge
        if self.proximity.enabled:
            ux, uy, causes = self._last_stage(ux, uy, scene.planes, body, own, (vx, vy), slower)
        else:
            size = hypot(ux, uy)
            if size > self._acceleration_max:
                ux, uy = ux * self._acceleration_max / size, uy * self._acceleration_max / size
        self._hold = self._held(scene, ux, uy, causes) if self.detour.looks else NOTHING
        force, torque = hand.wrench(ux, uy, body, self._mass, self._inertia, self._reach)
        force, torque = _within(force, self._force_max), _within(torque, self._torque_max)
        forces = nx, ny, cx, cy, ux - nx - cx, uy - ny - cy
        return Drive(force, torque, forces, len(scene.constraints), causes, numbers)

    def evasion(self, plant: PlantState, now_ns: int) -> tuple[float, float] | None:
        """Force (N) and torque (N m) that get a robot that is to stand out of the way of vehicles that roll
        on, though nothing commands them (S3); None where braking does as well. Its numbers may be absurd."""
        rolling = {peer.name for peer in self.peers.known if self.peers.lost.may_roll(peer, now_ns)}
        if not rolling or not self.proximity.enabled:
            return None
        acting_ns = self.acting_ns(now_ns)
        body = self._pose_at(plant, acting_ns)
        own = hand.hand(body, self._reach)
        scene = Scene(now_ns, own, 0.0, 0.0, (own.x, own.y))
        self._assembly.find(scene, acting_ns, self.edges, 0.0)
        ux, uy = -own.vx / BRAKING_TIME_S, -own.vy / BRAKING_TIME_S
        if (dodge := self._assembly.dodge(scene, body)) is not None:
            ux, uy = dodge
        ux, uy, causes = self._last_stage(ux, uy, scene.planes, body, own, AT_REST, 1.0)
        if dodge is None and rolling.isdisjoint(causes):
            return None
        force, torque = hand.wrench(ux, uy, body, self._mass, self._inertia, self._reach)
        return _within(force, self._force_max), _within(torque, self._torque_max)

    def hand_at(self, plant: PlantState, time_ns: int) -> hand.Hand:
        """Own hand at a wall time after the plant's state, from what acts on the body until then."""
        return hand.hand(self._pose_at(plant, time_ns), self._reach)

    def obeys(self, plant: PlantState, now_ns: int) -> Setpoint:
        """What the own body goes on by when nothing commands it any more from `now_ns` on."""
        _, _, heading, speed, yaw_rate = self._pose_at(plant, now_ns)
        if plant.asked:
            return asked(heading, speed, *plant.asked[0])
        along, spin = plant.force / self._mass, plant.torque / self._inertia
        return setpoint(heading, speed, yaw_rate, along, spin)

    def sent(self, now_ns: int, wrench: tuple[float, float] | None) -> None:
        """Notes what the plant was asked for at the tick `now_ns` (N, N m); None when it is to brake."""
        self._sent[self.acts_from_ns(now_ns)] = wrench
        if len(self._sent) > self._sent_max:
            del self._sent[next(iter(self._sent))]

    def _pose_at(self, plant: PlantState, time_ns: int) -> hand.PoseTuple:
        """Own body at `time_ns`, from a plant state and what acts on the body since.

        A plant state that came late says nothing of the wrenches that the plant took after it:
        those are the ones that were sent. How hard a plant brakes is its own affair, and the force that it
        states then is that of one of its periods: held on it would drive a body backwards that stands then.
        """
        pose: hand.PoseTuple = plant.x, plant.y, plant.heading, plant.speed, plant.yaw_rate
        acts: tuple[float, float] | None = (plant.force, plant.torque)
        since_ns = plant.time_ns
        boundary_ns = self.acts_from_ns(since_ns)
        brakes_on = not plant.driving
        acts_ns = ACTS_PERIODS * self._held_ns
        taken_ns = since_ns
        if since_ns not in self._sent:  # as it is mostly: the plant took a wrench then
            taken_ns = next((sent_ns for sent_ns in reversed(self._sent) if sent_ns <= since_ns), since_ns)
        while boundary_ns < time_ns:
            if brakes_on or boundary_ns in self._sent:
                pose = self._moved(pose, acts, (boundary_ns - since_ns) / NS_PER_S)
                since_ns, acts = boundary_ns, self._sent.get(boundary_ns)
                taken_ns, brakes_on = boundary_ns, False
            elif boundary_ns - taken_ns >= acts_ns and acts:
                pose = self._moved(pose, acts, (boundary_ns - since_ns) / NS_PER_S)
                since_ns, acts = boundary_ns, COASTING
            boundary_ns += self._period_ns
        return self._moved(pose, acts, (time_ns - since_ns) / NS_PER_S)

    def _moved(self, pose: hand.PoseTuple, acts: tuple[float, float] | None, dt: float) -> hand.PoseTuple:
        """The own body after `dt` seconds in which this force and torque act, None: in which it brakes."""
        if acts is None:
            return hand.braked(pose, BRAKING_TIME_S, dt)
        force, torque = acts
        return hand.advance(pose, force, torque, self._mass, self._inertia, dt)

    def _taken(self, now_ns: int, own: hand.Hand, motion: Sample) -> str:
        """Which body lies where the own place is, if that stands and is near: no way round leads there."""
        x, y, vx, vy, _, _ = motion
        if hypot(vx, vy) > SPEED_MIN:
            return ""
        keep = self._safe_distance + self._margin
        for peer in self._about():
            if self.peers.lost.may_roll(peer, now_ns):
                continue  # where it rests is not there yet
            if peer.is_heard(now_ns):
                message = peer.message
                room = keep + peer.doubt(now_ns)
                if (
                    message is not None
                    and not message.following
                    and hypot(message.vx, message.vy) <= SPEED_MIN
                    and hypot(message.x - x, message.y - y) < room
                    and hypot(own.x - x, own.y - y) < 2.0 * room
                ):
                    return f"its place is taken by {peer.name} (does not follow)"
                continue
            belief = self.peers.whereabouts.belief(peer)
            if belief is None or hypot(belief.x - x, belief.y - y) > keep + belief.reach:
                continue
            age = (now_ns + peer.clock.used_ns - peer.time_ns) / NS_PER_S
            left = hypot(own.x - x, own.y - y)
            for stretch in belief.stretches:
                room = keep + stretch.radius_at(age)
                if left < 2.0 * room and stretch.distance(x, y) < room:
                    since = "never heard" if peer.message is None else f"silent for {age:.0f} s"
                    return f"its place is taken by {peer.name} ({since})"
        return ""

    def _about(self) -> Iterator[Peer]:
        """The robots that it shares an edge with, and those that are near."""
        for _, peer in self.edges:
            yield peer
        yield from self.proximity.close

    def _driving(self, now_ns: int) -> Iterator[tuple[Peer, HandState]]:
        """The robots about that follow the law, and go away themselves."""
        for peer in self._about():
            message = peer.message
            if message is not None and message.following and peer.here and peer.late_ns(now_ns) < STANDS_NS:
                yield peer, message

    def _held(self, scene: Scene, ux: float, uy: float, causes: tuple[str, ...]) -> Hold:
        """What keeps the own hand from what it wants, where (ux, uy) is what came of it."""
        now_ns = scene.now_ns
        moving, astray = set(), set()
        near = SPEED_MIN * self._c2 / self._c1
        for peer, message in self._driving(now_ns):
            moving.add(peer.name)
            if self.detour.is_loose:
                place = self.reference.motion(peer.robot, now_ns)
                if place and hypot(message.x - place[0], message.y - place[1]) > near:
                    astray.add(peer.robot)
        lanes = {"own lane", *(each.name for each in self.right_of_way.keep_out)}
        blockers = [each for each in scene.within if each.name not in moving]
        waits: list[Blocker] = []
        robots: list[tuple[int, Vector]] = []
        x = y = 0.0
        for each in scene.constraints:
            nx, ny = each.edge.normal
            if each.one_sided:
                blockers.append(self._blocker(nx, ny, each.name, moving))
            else:
                size = each.edge.slope * self.coupling.multiplier(each.key)
                x, y = x + size * nx, y + size * ny
                robots.append((int(each.key), (size * nx, size * ny)))
        names = set()
        for plane in scene.planes:
            if plane.rank in KEEPING_AWAY:
                names.add(plane.cause)
                if plane in scene.stops:  # whichever way it drives, that is not what keeps it
                    continue
                if plane.nx * ux + plane.ny * uy < plane.least + ACTIVE and (plane.nx or plane.ny):
                    blocker = self._blocker(plane.nx, plane.ny, plane.cause, moving)
                    (waits if plane.cause in lanes else blockers).append(blocker)
        limits = tuple(cause for cause in causes if cause not in names)
        return new(Hold, (blockers, waits, (x, y), robots, frozenset(astray), limits))

    def _blocker(self, nx: float, ny: float, name: str, moving: Collection[str]) -> Blocker:
        body = any(peer.name == name for peer in self._about())
        return Blocker(nx, ny, name, name not in moving, body=body)

    def _last_stage(
        self,
        ux: float,
        uy: float,
        planes: list[safety_filter.HalfPlane],
        body: hand.PoseTuple,
        own: hand.Hand,
        reference: Vector,
        slower: float,
    ) -> tuple[float, float, tuple[str, ...]]:
        """What the law asks for, within the limits of motion and of distance (F1)."""
        most = self._speed_max
        if slower < 1.0:
            most = min(most, slower * (hypot(*reference) + SLOW_SPEED))
        planes += safety_filter.limit_speed(own.vx, own.vy, most, self._speeding_rate)
        if self.caution.speed < inf:
            vx, vy = own.vx - reference[0], own.vy - reference[1]
            planes += safety_filter.limit_speed(vx, vy, self.caution.speed, self._barrier_rate, "late links")
        planes += safety_filter.limit_actuators(
            body, self._mass, self._inertia, self._reach, self._force_max, self._torque_max
        )
        planes += safety_filter.limit_turning(
            body, self._reach, self._yaw_rate_max, self._barrier_rate, quickest=self._turn_quickest
        )
        ux, uy, causes, _ = safety_filter.project(ux, uy, planes, self._acceleration_max)
        return ux, uy, causes


def _within(value: float, most: float | None) -> float:
    """What the actuator can give of it: contradicting limits are beyond the safety filter."""
    return value if most is None else max(-most, min(most, value))
