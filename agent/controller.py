"""One robot's control law in time: from its plant's state and its neighbours to a force and a torque.

Pure. It knows when a wrench acts: the plant takes it at its next tick and holds it for a period. So
the law is evaluated for the middle of that interval, with the own body and every neighbour carried
forward to that instant; evaluated there, the sampled loop is of second order in the period
(docs/theory.md, S1).
"""

from __future__ import annotations

from collections import Counter
from math import ceil, hypot
from typing import Final, NamedTuple

from agent import hand, law, neighbours
from agent.clock import NS_PER_S
from agent.fleet import Fleet
from agent.formation import Geometry
from agent.messages import PlantState
from agent.neighbours import Neighbours
from agent.node import next_tick_ns
from agent.trajectory import make_trajectory


class Drive(NamedTuple):
    """What one tick of the law gives.

    force (N) and torque (N m) to ask of the plant; the hand now; the navigation force F_n and the
    constraint force F_c, m/s^2, W.
    """

    force: float
    torque: float
    here: hand.Hand
    navigation_x: float
    navigation_y: float
    constraint_x: float
    constraint_y: float


class Controller:
    """The law of robot `robot`.

    Attributes:
        neighbours: its neighbours; whoever receives their messages gives them to it.
        multipliers: own copies of lambda, in the order of ``neighbours.ids``.
    """

    def __init__(self, fleet: Fleet, geometry: Geometry, robot: int) -> None:
        body, control = fleet.robot(robot), fleet.control
        index = geometry.ids.index(robot)
        partners: dict[int, float] = {}
        degrees: Counter[int] = Counter()
        for (i, j), distance in zip(geometry.edges.tolist(), geometry.distances.tolist(), strict=True):
            degrees[i] += 1
            degrees[j] += 1
            if index in (i, j):
                partners[j if i == index else i] = distance
        columns = sorted(partners, key=lambda other: geometry.ids[other])
        self._distances = [partners[other] for other in columns]
        self._degrees = [degrees[index] + degrees[other] for other in columns]
        self.neighbours: Final = Neighbours(
            robot,
            {geometry.ids[other]: geometry.offsets[other].tolist() for other in columns},
            control.c1,
            control.c2,
            fleet.period_ns,
            decay=neighbours.constraint_decay(control.kd, control.kp),
            predict=control.prediction,
        )
        self.multipliers = [0.0] * len(columns)
        self._period_ns = fleet.period_ns
        self._offset_x, self._offset_y = geometry.offsets[index].tolist()
        self._trajectory = make_trajectory(fleet.trajectory)
        self._epoch_ns = 0
        self._references: dict[int, tuple[float, float, float, float, float, float]] = {}
        self._gains = law.Gains(control.kd, control.k2, control.kp, control.relaxation)
        self._coupling = control.coupling
        self._c1, self._c2 = control.c1, control.c2
        self._safe_distance = fleet.formation.safe_distance_m
        self._acceleration_max = control.max_acceleration
        self._mass, self._inertia, self._reach = body.mass_kg, body.inertia_kgm2, body.hand_offset_m
        # Wrenches by the plant tick that takes them: as many as the oldest state to drive by can lack.
        self._sent: dict[int, tuple[float, float]] = {}
        self._sent_max = ceil(control.plant_timeout_s * NS_PER_S / fleet.period_ns) + 2

    def plan(self, epoch_ns: int) -> None:
        """Sets when the trajectory begins, in wall time (ns)."""
        self._epoch_ns = epoch_ns
        self._references.clear()

    def restart(self) -> None:
        """Forgets the multipliers: the robot begins to drive."""
        self.multipliers = [0.0] * len(self.multipliers)

    def acts_from_ns(self, now_ns: int) -> int:
        """When a wrench that is sent now begins to act: at the plant's next tick."""
        return next_tick_ns(now_ns, self._period_ns, 0)

    def drive(self, plant: PlantState, now_ns: int) -> Drive:
        """The law at the tick `now_ns`. Its numbers may be absurd: look at them before they are sent."""
        acting_ns = self.acts_from_ns(now_ns) + self._period_ns // 2
        body = self._pose_at(plant, acting_ns)
        own = hand.hand(body, self._reach)
        x, y, vx, vy, ax, ay = self._reference(acting_ns)
        ex, ey = own.x - x - self._offset_x, own.y - y - self._offset_y
        nx = law.navigation_force(ax, ex, own.vx - vx, self._c1, self._c2)
        ny = law.navigation_force(ay, ey, own.vy - vy, self._c1, self._c2)
        cx, cy = self._constraint(acting_ns, own, nx, ny) if self._distances else (0.0, 0.0)
        ux, uy = nx + cx, ny + cy
        size = hypot(ux, uy)
        if size > self._acceleration_max:
            ux, uy = ux * self._acceleration_max / size, uy * self._acceleration_max / size
        force, torque = hand.wrench(ux, uy, body, self._mass, self._inertia, self._reach)
        return Drive(force, torque, self.hand_at(plant, now_ns), nx, ny, cx, cy)

    def hand_at(self, plant: PlantState, time_ns: int) -> hand.Hand:
        """Own hand at a wall time after the plant's state, from what acts on the body until then."""
        return hand.hand(self._pose_at(plant, time_ns), self._reach)

    def sent(self, now_ns: int, force: float, torque: float) -> None:
        """Told what was asked of the plant at the tick `now_ns` (N, N m); zero when it was told to brake."""
        self._sent[self.acts_from_ns(now_ns)] = force, torque
        if len(self._sent) > self._sent_max:
            del self._sent[next(iter(self._sent))]

    def _reference(self, time_ns: int) -> tuple[float, float, float, float, float, float]:
        """The formation's reference point at a wall time; the neighbours' stamps repeat, so it is kept."""
        known = self._references.get(time_ns)
        if known is None:
            if len(self._references) > 32:
                self._references.clear()
            known = self._trajectory.at((time_ns - self._epoch_ns) / NS_PER_S)
            self._references[time_ns] = known
        return known

    def _pose_at(self, plant: PlantState, time_ns: int) -> hand.Pose:
        """Own body at `time_ns`, from a plant state and what acts on the body since.

        A plant state that came late says nothing of the wrenches that the plant took after it:
        those are the ones that were sent.
        """
        pose = hand.Pose(plant.x, plant.y, plant.heading, plant.speed, plant.yaw_rate)
        force, torque, since_ns = plant.force, plant.torque, plant.time_ns
        boundary_ns = self.acts_from_ns(since_ns)
        while boundary_ns < time_ns:
            sent = self._sent.get(boundary_ns)
            if sent is not None:
                dt = (boundary_ns - since_ns) / NS_PER_S
                pose = hand.advance(pose, force, torque, self._mass, self._inertia, dt)
                since_ns = boundary_ns
                force, torque = sent
            boundary_ns += self._period_ns
        return hand.advance(pose, force, torque, self._mass, self._inertia, (time_ns - since_ns) / NS_PER_S)

    def _constraint(self, time_ns: int, own: hand.Hand, nx: float, ny: float) -> tuple[float, float]:
        """Own constraint force F_c (32) at `time_ns`, m/s^2; moves the multipliers on by one tick."""
        others = self.neighbours.predict(time_ns, self._reference, self._epoch_ns)
        gains = self._gains
        edges = [
            law.edges(
                (own.x - other.position[0], own.y - other.position[1]),
                (own.vx - other.velocity[0], own.vy - other.velocity[1]),
                (nx - other.navigation[0], ny - other.navigation[1]),
                distance,
                self._safe_distance,
                gains,
            )
            for other, distance in zip(others, self._distances, strict=True)
        ]
        if self._coupling == "joint":
            self.neighbours.average(self.multipliers)
            cx, cy = self._total(edges)
            self.multipliers = [
                law.multipliers_sweep(
                    edge, multiplier, (cx - other.constraint[0], cy - other.constraint[1]), degrees, gains
                )
                for edge, multiplier, other, degrees in zip(
                    edges, self.multipliers, others, self._degrees, strict=True
                )
            ]
        elif self._coupling == "edge":
            self.multipliers = [law.multipliers_edge(edge, gains) for edge in edges]
        else:
            self.multipliers = [law.multipliers_penalty(edge, gains) for edge in edges]
        return self._total(edges)

    def _total(self, edges: list[law.Edges]) -> tuple[float, float]:
        """Own constraint force (32) with the multipliers as they are, m/s^2."""
        cx = cy = 0.0
        for edge, multiplier in zip(edges, self.multipliers, strict=True):
            fx, fy = law.forces(edge, multiplier)
            cx += fx
            cy += fy
        return cx, cy
