"""One robot's agent, without clock, socket, thread or randomness of its own.

`Agent.receive` takes what came off the bus, `Agent.tick` says what to put on it. A process
(`process.py`) and the virtual-time simulation drive the same object with the same bytes.
"""

from __future__ import annotations

from collections import Counter
from math import hypot, isfinite
from typing import Final

from agent import hand, keys, law
from agent.clock import NS_PER_S
from agent.fleet import Fleet, digest
from agent.formation import resolve
from agent.messages import (
    FLOAT_MAX,
    HandState,
    Malformed,
    Mission,
    PlantState,
    Status,
    Stop,
    Wrench,
    clipped,
    decode,
    encode,
)
from agent.neighbours import FUTURE_NS_MAX, Neighbours
from agent.node import Outgoing, next_tick_ns
from agent.supervision import Conditions, State, step
from agent.trajectory import make_trajectory

STATUS_PERIOD_NS: Final = NS_PER_S // 5
STATUS_VALUES_MAX: Final = 200
"""A status goes out early rather than hold more tick times or ages than this."""
REST_SPEED: Final = 0.06
"""Below this (m/s) a robot stands: an EKF reports up to 0.05 m/s of a rover at rest."""
REST_YAW_RATE: Final = 0.1
SENT_MAX: Final = 16
"""Wrenches that are remembered: those that a late plant state does not know of yet."""


class Agent:
    """The agent of robot `robot` of `fleet`.

    Raises:
        agent.fleet.FleetError: the fleet has no such robot, or its formation cannot be resolved.
    """

    def __init__(self, fleet: Fleet, robot: int) -> None:
        me = fleet.robot(robot)
        geometry = resolve(fleet)
        index = geometry.ids.index(robot)
        control = fleet.control
        name = fleet.fleet.name
        self.robot: Final = robot
        self.period_ns: Final = fleet.period_ns
        self.phase_ns: Final = fleet.period_ns // 2
        """Agents tick half a period after plants: a plant's state has come by then, and the
        wrench is there before the plant's next tick."""
        self.state = State.WAITING
        self.reason = ""

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
        self._neighbours = Neighbours(
            robot,
            {geometry.ids[other]: geometry.offsets[other].tolist() for other in columns},
            control.c1,
            control.c2,
            self.period_ns,
        )
        self._offset_x, self._offset_y = geometry.offsets[index].tolist()
        self._trajectory = make_trajectory(fleet.trajectory)
        self._references: dict[int, tuple[float, float, float, float, float, float]] = {}
        self._gains = law.Gains(control.kd, control.k2, control.kp)
        self._coupling = control.coupling
        self._c1, self._c2 = control.c1, control.c2
        self._safe_distance = fleet.formation.safe_distance_m
        self._acceleration_max = control.max_acceleration
        self._mass, self._inertia, self._reach = me.mass_kg, me.inertia_kgm2, me.hand_offset_m
        self._horizon_ns = round(control.prediction_horizon_s * NS_PER_S)
        self._plant_timeout_ns = round(control.plant_timeout_s * NS_PER_S)
        self._digest = digest(fleet)

        self._plant: PlantState | None = None
        self._plant_trouble = "for its plant"
        self._mission: Mission | None = None
        self._stop: Stop | None = None
        self._refused_mission = ""
        self._sent: dict[int, tuple[float, float]] = {}  # by the plant tick that takes it
        self._leaving = False
        self._numbers = ""
        self._multipliers = [0.0] * len(columns)
        self._hand_sequence = self._wrench_sequence = self._status_sequence = 0
        self._status_due_ns = 0
        self._sent_hands = self._corrupted = 0
        self.rejected: Counter[str] = Counter()
        self._tick_us: list[int] = []
        self._ages_us: list[int] = []
        self._overruns = 0

        self._key_hand = keys.hand(name, robot)
        self._key_wrench = keys.wrench(name, robot)
        self._key_status = keys.status(name, robot)
        self._key_plant = keys.plant_state(name, robot)
        self._key_mission = keys.mission(name)
        self._key_stop = keys.stop(name)
        self._hands = {keys.hand(name, other): other for other in self._neighbours.ids}
        self.alive_key: Final = keys.alive(name, robot, "agent")
        self.subscriptions: Final = (self._key_plant, *self._hands, self._key_mission, self._key_stop)
        self.publications: Final = (self._key_wrench, self._key_hand, self._key_status)

    # ------------------------------------------------------------------ in

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes one message off the bus. What is not valid is counted by its reason and changes nothing."""
        try:
            message = decode(payload)
        except Malformed as error:
            if key in self._hands:
                self._corrupted += 1
            self._reject(error.reason)
            return
        reason: str | None = "wrong_key"
        if type(message) is HandState:
            if self._hands.get(key) == message.robot:
                reason = self._neighbours.accept(message, now_ns)
        elif type(message) is PlantState:
            if key == self._key_plant and message.robot == self.robot:
                reason = self._accept_plant(message, now_ns)
        elif type(message) is Mission:
            if key == self._key_mission:
                reason = self._accept_mission(message)
        elif type(message) is Stop and key == self._key_stop:
            reason = self._accept_stop(message)
        if reason is not None:
            self._reject(reason)

    def _reject(self, reason: str) -> None:
        self.rejected[reason] += 1

    def _accept_plant(self, state: PlantState, now_ns: int) -> str | None:
        if state.time_ns > now_ns + FUTURE_NS_MAX:
            return "future"
        if self._plant is not None and state.time_ns <= self._plant.time_ns:
            return "duplicate" if state.time_ns == self._plant.time_ns else "out_of_order"
        self._plant = state
        return None

    def _accept_mission(self, mission: Mission) -> str | None:
        if mission.digest != self._digest:
            self._refused_mission = (
                f"the mission is for another fleet file: its digest is {mission.digest[:16]}, "
                f"this agent's is {self._digest}"
            )
            return "digest"
        if self._mission is None or mission.version > self._mission.version:
            self._mission = mission
            self._refused_mission = ""
            self._references.clear()
            if self._stop is not None and self._stop.version < mission.version:
                self._stop = None
        return None

    def _accept_stop(self, stop: Stop) -> str | None:
        # A stop is for all missions up to its version: only a later one ends it, whichever comes first.
        if self._mission is not None and stop.version < self._mission.version:
            return "out_of_order"
        self._stop = stop
        return None

    def leave(self) -> None:
        """The process is about to end: from the next tick on the robot brakes."""
        self._leaving = True

    def timed(self, duration_ns: int, missed: int) -> None:
        """Told by the loop after each tick: how long it took, and how many ticks were skipped before it."""
        self._tick_us.append(duration_ns // 1000)
        self._overruns += missed

    # ------------------------------------------------------------------ out

    @property
    def condition(self) -> tuple[str, str]:
        return self.state.value, self.reason

    @property
    def done(self) -> bool:
        """True when a leaving robot stands, or nothing is known of it that could say so."""
        return self._leaving and (bool(self._plant_trouble) or self._at_rest)

    def tick(self, now_ns: int) -> list[Outgoing]:
        """One control tick at `now_ns`: decides the state, runs the law, returns what to publish."""
        self._neighbours.begin(now_ns)
        ages_ns = self._neighbours.ages_ns(now_ns)
        self._ages_us.extend([age // 1000 for age in ages_ns if age is not None])
        self._plant_trouble = self._check_plant(now_ns)
        was = self.state
        if not (was is State.RUNNING and self._all_well(now_ns, ages_ns)):
            conditions = self._conditions(now_ns, ages_ns)
            self.state, row = step(was, conditions)
            if row is not None:
                self.reason = row.reason(conditions)
        if self.state is State.RUNNING and was is not State.RUNNING:
            self._multipliers = [0.0] * len(self._multipliers)
        out = self._drive(now_ns) if self.state is State.RUNNING else self._brake(now_ns)
        if now_ns >= self._status_due_ns or len(self._ages_us) > STATUS_VALUES_MAX or self.state is not was:
            out.append(self._status(now_ns, ages_ns))
        return out

    def _check_plant(self, now_ns: int) -> str:
        plant = self._plant
        if plant is None:
            return "for its plant"
        age_ns = now_ns - plant.time_ns
        if age_ns > self._plant_timeout_ns:
            return f"plant silent for {age_ns / NS_PER_S:.2f} s"
        return "" if plant.healthy else f"plant unhealthy: {plant.note or 'no reason given'}"

    def _all_well(self, now_ns: int, ages_ns: list[int | None]) -> bool:
        """True when a running robot has nothing to worry about: the table has no row for that."""
        mission, horizon_ns = self._mission, self._horizon_ns
        for age in ages_ns:
            if age is None or age > horizon_ns:
                return False
        return not (
            self._plant_trouble
            or self._leaving
            or self._stop is not None
            or self._numbers
            or mission is None
            or now_ns >= mission.epoch_ns + mission.duration_ns
            or self._next_plant_tick_ns(now_ns) < mission.epoch_ns
        )

    def _conditions(self, now_ns: int, ages_ns: list[int | None]) -> Conditions:
        mission = self._mission
        silent = [
            str(other) if age is None else f"{other} ({age / NS_PER_S:.1f} s)"
            for other, age in zip(self._neighbours.ids, ages_ns, strict=True)
            if age is None or age > self._horizon_ns
        ]
        stop = ""
        if self._leaving:
            stop = "the agent was told to end"
        elif self._stop is not None:
            stop = f"stop: {self._stop.reason}"
        elif mission is not None and now_ns >= mission.epoch_ns + mission.duration_ns:
            stop = "the mission is over"
        return Conditions(
            plant=self._plant_trouble,
            numbers=self._numbers,
            neighbours=f"silent neighbours: {', '.join(silent)}" if silent else "",
            mission="" if mission is not None else self._refused_mission or "for a mission",
            stop=stop,
            # The wrench of this tick acts from the plant's next tick on: that one starts the drive.
            started=mission is not None and self._next_plant_tick_ns(now_ns) >= mission.epoch_ns,
            at_rest=self._at_rest,
        )

    def _next_plant_tick_ns(self, now_ns: int) -> int:
        return next_tick_ns(now_ns, self.period_ns, 0)

    @property
    def _at_rest(self) -> bool:
        plant = self._plant
        return plant is not None and abs(plant.speed) < REST_SPEED and abs(plant.yaw_rate) < REST_YAW_RATE

    def _reference(self, time_ns: int) -> tuple[float, float, float, float, float, float]:
        """The formation's reference point at a wall time; the neighbours' stamps repeat, so it is kept."""
        known = self._references.get(time_ns)
        if known is None:
            assert self._mission is not None
            if len(self._references) > 32:
                self._references.clear()
            known = self._trajectory.at((time_ns - self._mission.epoch_ns) / NS_PER_S)
            self._references[time_ns] = known
        return known

    def _pose_at(self, time_ns: int) -> hand.Pose:
        """Own body at `time_ns`, from the last plant state and what acts on the body since.

        A plant state that came late says nothing of the wrenches that the plant took after it:
        those are the ones that were sent.
        """
        plant = self._plant
        assert plant is not None
        pose = hand.Pose(plant.x, plant.y, plant.heading, plant.speed, plant.yaw_rate)
        force, torque, since_ns = plant.force, plant.torque, plant.time_ns
        boundary_ns = self._next_plant_tick_ns(since_ns)
        while boundary_ns < time_ns:
            sent = self._sent.get(boundary_ns)
            if sent is not None:
                dt = (boundary_ns - since_ns) / NS_PER_S
                pose = hand.advance(pose, force, torque, self._mass, self._inertia, dt)
                since_ns = boundary_ns
                force, torque = sent
            boundary_ns += self.period_ns
        return hand.advance(pose, force, torque, self._mass, self._inertia, (time_ns - since_ns) / NS_PER_S)

    def _drive(self, now_ns: int) -> list[Outgoing]:
        """The law, for the middle of the interval in which the plant will hold this tick's wrench.

        The plant takes the wrench at its next tick and holds it for a period. Evaluated there, and
        with every neighbour carried forward to the same instant, the sampled loop is of second
        order in the period instead of lagging by 1.5 of them.
        """
        acting_ns = self._next_plant_tick_ns(now_ns) + self.period_ns // 2
        body = self._pose_at(acting_ns)
        own = hand.hand(body, self._reach)
        x, y, vx, vy, ax, ay = self._reference(acting_ns)
        ex, ey = own.x - x - self._offset_x, own.y - y - self._offset_y
        nx = law.navigation_force(ax, ex, own.vx - vx, self._c1, self._c2)
        ny = law.navigation_force(ay, ey, own.vy - vy, self._c1, self._c2)
        cx, cy = self._constraint(acting_ns, own, nx, ny) if self._neighbours.ids else (0.0, 0.0)
        ux, uy = nx + cx, ny + cy
        size = hypot(ux, uy)
        if size > self._acceleration_max:
            ux, uy = ux * self._acceleration_max / size, uy * self._acceleration_max / size
        force, torque = hand.wrench(ux, uy, body, self._mass, self._inertia, self._reach)
        here = hand.hand(self._pose_at(now_ns), self._reach)
        sent = (force, torque, *here, nx, ny, cx, cy, *self._multipliers)
        if not isfinite(sum(sent)) or max(sent) > FLOAT_MAX or min(sent) < -FLOAT_MAX:
            # Never sent, never hidden: this tick brakes, and the next finds the fault.
            self._numbers = f"the law gave force {force} N and torque {torque} N m at speed {body.speed} m/s"
            return self._brake(now_ns)
        self._remember(now_ns, force, torque)
        return [
            self._wrench(now_ns, force, torque, brake=False),
            self._hand(now_ns, here, True, nx, ny, cx, cy),
        ]

    def _constraint(self, time_ns: int, own: hand.Hand, nx: float, ny: float) -> tuple[float, float]:
        """Own constraint force F_c (32) at `time_ns`, m/s^2; moves the multipliers on by one tick."""
        assert self._mission is not None
        others = self._neighbours.predict(time_ns, self._reference, self._mission.epoch_ns)
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
            self._neighbours.average(self._multipliers)
            cx, cy = self._total(edges)
            self._multipliers = [
                law.multipliers_sweep(
                    edge, multiplier, (cx - other.constraint[0], cy - other.constraint[1]), degrees, gains
                )
                for edge, multiplier, other, degrees in zip(
                    edges, self._multipliers, others, self._degrees, strict=True
                )
            ]
        elif self._coupling == "edge":
            self._multipliers = [law.multipliers_edge(edge, gains) for edge in edges]
        else:
            self._multipliers = [law.multipliers_penalty(edge, gains) for edge in edges]
        return self._total(edges)

    def _total(self, edges: list[law.Edges]) -> tuple[float, float]:
        """Own constraint force (32) with the multipliers as they are, m/s^2."""
        cx = cy = 0.0
        for edge, multiplier in zip(edges, self._multipliers, strict=True):
            fx, fy = law.forces(edge, multiplier)
            cx += fx
            cy += fy
        return cx, cy

    def _remember(self, now_ns: int, force: float, torque: float) -> None:
        """Keeps what the plant will be given at its next tick (N, N m)."""
        if len(self._sent) >= SENT_MAX:
            del self._sent[next(iter(self._sent))]
        self._sent[self._next_plant_tick_ns(now_ns)] = force, torque

    def _brake(self, now_ns: int) -> list[Outgoing]:
        self._remember(now_ns, 0.0, 0.0)  # how hard the plant brakes is its own affair
        out = [self._wrench(now_ns, 0.0, 0.0, brake=True)]
        if not self._plant_trouble:
            here = hand.hand(self._pose_at(now_ns), self._reach)
            if max(map(abs, here)) <= FLOAT_MAX:
                follows = self.state is State.READY and self._mission is not None
                out.append(self._hand(now_ns, here, follows, 0.0, 0.0, 0.0, 0.0))
        return out

    def _wrench(self, now_ns: int, force: float, torque: float, *, brake: bool) -> Outgoing:
        message = Wrench(self.robot, self._wrench_sequence, now_ns, force, torque, brake)
        self._wrench_sequence += 1
        return self._key_wrench, encode(message)

    def _hand(
        self, now_ns: int, here: hand.Hand, following: bool, nx: float, ny: float, cx: float, cy: float
    ) -> Outgoing:
        multipliers = (
            tuple(zip(self._neighbours.ids, self._multipliers, strict=True))
            if self.state is State.RUNNING
            else ()
        )
        message = HandState(
            self.robot, self._hand_sequence, now_ns, following, *here, nx, ny, cx, cy, multipliers
        )
        self._hand_sequence += 1
        self._sent_hands += len(self._neighbours.ids)
        return self._key_hand, encode(message)

    def _status(self, now_ns: int, ages_ns: list[int | None]) -> Outgoing:
        neighbours = self._neighbours
        counters = {
            "sent": self._sent_hands,
            "received": neighbours.received,
            "lost": neighbours.lost,
            "delayed": neighbours.delayed,
            "duplicated": neighbours.duplicated,
            "corrupted": self._corrupted,
            "rejected": sum(self.rejected.values()),
            "overruns": self._overruns,
            **{f"rejected.{reason}": count for reason, count in sorted(self.rejected.items())},
        }
        status = Status(
            self.robot,
            self._status_sequence,
            now_ns,
            self.state.value,
            clipped(self.reason),
            self._mission.version if self._mission is not None else 0,
            tuple(
                (other, -1 if age is None else max(age, 0) // 1000)
                for other, age in zip(neighbours.ids, ages_ns, strict=True)
            ),
            tuple(self._tick_us[:STATUS_VALUES_MAX]),
            tuple(self._ages_us[: STATUS_VALUES_MAX + len(neighbours.ids)]),
            tuple(counters.items()),
        )
        self._status_sequence += 1
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        self._tick_us.clear()
        self._ages_us.clear()
        return self._key_status, encode(status)
