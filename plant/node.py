"""Hosts a body on the bus, sans-IO: takes wrenches, measures, publishes states, and is the watchdog (PURE).

The body obeys a fresh wrench and brakes in any other case. Sensors have noise, and the faults of the rules.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin
from typing import Final

from handfast.agent.common import random_streams
from handfast.agent.common.models import new
from handfast.agent.common.time import NS_PER_S, MachineClock
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.fault_rules import SENSOR_FIELDS
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import Robot
from handfast.agent.formation.mission_plan import MissionChoice, MissionRefused
from handfast.agent.links.fault_plan import FaultPlan, SensorFaults
from handfast.agent.links.ingress import Ingress
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import can_be, decode, encode
from handfast.agent.messages.trickle_timer import SequenceNumbers
from handfast.agent.messages.types import (
    ACTS_PERIODS,
    BYTES_MAX,
    CHECK_TEXT_MIN,
    CHECKS_MAX,
    FUTURE_NS_MAX,
    LEVELS,
    TEXT_MAX,
    CheckLine,
    Checks,
    Mission,
    Outgoing,
    PlantState,
    Resume,
    StatusText,
    Stop,
    Wrench,
    clipped,
)
from handfast.agent.supervision.orders import LastingOrders, StopLatch
from handfast.agent.supervision.state_machine import at_rest
from handfast.plant.backend import COAST, Check, Command, PlantBackend, Reading

_NONE: Final = SensorFaults()
JUMP_SHARE: Final = 0.01
"""Share of measurements that a rule's `jump_m` strikes."""


class Measurement:
    """The sensors of one robot: measured = pose + bias + noise, and now and then a jump.

    Noise is normal. That of the body and that of a fault are independent: their variances add. Each draw is a
    function of the seed, the robot, the quantity and the sequence number of the plant's state.

    Args:
        seed: of every draw.
        body: with its own noise: m, rad.
        plan: the rules; they may change.
    """

    def __init__(self, seed: int, body: Robot, plan: FaultPlan) -> None:
        self._robot = body.id
        self._plan = plan
        self._changes = -1
        self._noise = (body.position_noise_m, body.position_noise_m, body.heading_noise_rad)
        self._streams = [
            random_streams.stream(seed, "plant", body.id, quantity) for quantity in ("x", "y", "heading")
        ]
        self._jump, self._direction = (
            random_streams.stream(seed, "plant", body.id, purpose) for purpose in ("jump", "direction")
        )
        self._ruled = False

    @property
    def exact(self) -> bool:
        """Whether no measurement differs from the pose: no noise, and no sensor rule at any time."""
        if self._changes != self._plan.changes:
            self._changes = self._plan.changes
            rules = self._plan.rules()
            self._ruled = any(
                rule.given(SENSOR_FIELDS) and (rule.robots is None or self._robot in rule.robots)
                for rule in rules
            )
        return not (self._ruled or any(self._noise))

    def measured(self, pose: Pose, time_ns: int, sequence: int) -> Pose | None:
        """The pose (W) as measured, None for a dropout.

        Args:
            pose: the true one (W) at `time_ns`, as the backend has it.
            time_ns: ns of the wall clock: which rules hold.
            sequence: number of the plant's state that will carry it.
        """
        if self.exact:
            return pose
        faults = (self._plan.sensor(self._robot, time_ns) if self._ruled else None) or _NONE
        bias_x, bias_y = faults.position_bias_m
        if faults.jump_m and random_streams.uniform(self._jump, sequence) < JUMP_SHARE:
            angle = 2.0 * pi * random_streams.uniform(self._direction, sequence)
            bias_x, bias_y = bias_x + faults.jump_m * cos(angle), bias_y + faults.jump_m * sin(angle)
        x, y, heading = (
            deviation * random_streams.normal(stream, sequence) if deviation else 0.0
            for deviation, stream in zip(self._noise, self._streams, strict=True)
        )
        return pose._replace(
            x=pose.x + bias_x + x,
            y=pose.y + bias_y + y,
            heading=pose.heading + faults.heading_bias_rad + heading,
        )


CHECKS_PERIOD_NS: Final = NS_PER_S
CLOCK_STEP_NS: Final = NS_PER_S // 1000
"""Clocks of two processes that differ by less were read at starts of their own, and not set between them."""


class PlantNode:
    """The plant of robot `robot`, whose body is `backend`; an `agent.node.Node`.

    Attributes:
        rejected: messages that were refused, by reason.
        condition: what it does, driving or braking, or that its body is released, and why.

    Raises:
        handfast.agent.fleet.model.FleetError: the fleet has no such robot, or its formation cannot be
        resolved.
    """

    def __init__(self, fleet: Fleet, robot: int, backend: PlantBackend) -> None:
        name = fleet.fleet.name
        self.robot: Final = robot
        self.period_ns: Final = fleet.period_ns
        self.phase_ns = 0
        self._backend = backend
        self._timeout_ns = round(fleet.control.wrench_timeout_s * NS_PER_S)
        self._key_state = key_expressions.plant_state(name, robot)
        self._key_truth = key_expressions.plant_truth(name, robot)
        self._key_wrench = key_expressions.wrench(name, robot)
        self.alive_keys: Final[tuple[str, ...]] = (key_expressions.alive(name, robot, "plant"),)
        self._key_checks = key_expressions.checks(name, robot)
        self._key_texts = key_expressions.status_texts(name, robot)
        geometry = None
        if not fleet.is_resolved:  # else without numpy, which takes its time
            from handfast.agent.formation.geometry import resolve

            geometry = resolve(fleet)
        self._missions = MissionChoice(fleet, geometry)
        self._epoch_ns = -1
        self._latch = StopLatch(robot, backend.clear_to_drive)
        self._is_vehicle = fleet.robot(robot).kind.vehicle
        self._begun_ns = 0
        self._lasting = LastingOrders(self._latch)
        self._checks: Sequence[Check] = ()
        self._levels: list[tuple[str, str]] = []
        self._checks_due_ns = self._checks_sequence = self._texts_sequence = 0
        self._ingress = Ingress(fleet, robot, "plant", {"wrench": (robot,)})
        self.plan: Final = self._ingress.plan
        self.rejected: Final = self._ingress.rejected
        self._ingress.on(self._key_wrench, Wrench, self._accept, robot=robot, topic="wrench")
        # Its agent passes on what operators order; that of another robot has no say here.
        relayed = key_expressions.relayed(name, robot)
        for key in (key_expressions.mission(name), relayed):
            self._ingress.on(key, Mission, self._accept_mission)
        for key in (key_expressions.stop(name), relayed):
            self._ingress.on(key, Stop, self._accept_stop)
        for key in (key_expressions.resume(name), relayed):
            self._ingress.on(key, Resume, self._accept_resume)
        self._measurement = Measurement(fleet.fleet.seed, fleet.robot(robot), self.plan)
        self._has_checks = getattr(type(backend), "checks", None) is not PlantBackend.checks
        self._speaks = getattr(type(backend), "status_texts", None) is not PlantBackend.status_texts
        # Of no certain length: in C a tuple of one is no object, and whoever asks for it gets a new one.
        self.subscriptions: Final[tuple[str, ...]] = (
            key_expressions.stop(name),
            key_expressions.resume(name),
            relayed,
            self._key_wrench,
            key_expressions.mission(name),
            *self._ingress.subscriptions,
        )
        self.watched: Final[tuple[str, ...]] = ()
        self.publications: Final[tuple[str, ...]] = (
            self._key_state,
            self._key_truth,
            self._key_checks,
            self._key_texts,
            *self._ingress.publications,
        )
        self._clock: MachineClock | None = None
        self._now_ns = self._ahead_ns = self._late_ns = 0
        self._wrench: Wrench | None = None
        self._taken_ns: int | None = None
        """Since when the wrench acts, None before it does."""
        self._followed: tuple[int, ...] = ()
        """By whose clock it goes, as the last wrench told."""
        self._ending = False
        self._at_rest = self._obeying = True
        self.healthy = False
        self._numbers = SequenceNumbers(self.period_ns)
        self.condition = ("braking", "no wrench yet")

    @property
    def done(self) -> bool:
        """Whether the process may end: it was asked to, and the body is at rest or is its operator's."""
        return self._ending and (self._at_rest or not self._obeying)

    def end(self) -> None:
        """Brakes from now on, whatever the agent says: the process is about to end."""
        self._ending = True

    def present(self, key: str, here: bool) -> None:
        """Nothing: it watches nobody's presence, and goes by the age of the last wrench."""

    def deaf_to(self, now_ns: int) -> Sequence[int]:
        """Nobody: it brakes when it does not hear its agent."""
        return ()

    def link_opened_anew(self, now_ns: int, what: str) -> None:
        """Nothing: its log says it."""

    def timed(self, duration_ns: int, missed: int) -> None:
        """Nothing: the loop counts what is missed, and says it at the end."""

    def late(self, now_ns: int, late_ns: int) -> None:
        """See `agent.node.Node`: it has not heard its agent for that time."""
        self._late_ns = late_ns

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes a message: a wrench of its agent, a mission, a stop, a resume, live faults.

        A stop makes it brake until a resume. The mission and live faults say which faults hold on the way
        from the agent. A mission of another drive, and a resume, also let a body obey again that its operator
        has given back; a vehicle only those of after this process began: what its operator did before, it
        cannot know. A message that is malformed, not for it or older than the last is counted and ignored.
        """
        self._now_ns = now_ns
        if not self._begun_ns:
            self._begun_ns = now_ns
        self._ingress.receive(now_ns - self._ahead_ns, key, payload)

    @property
    def lasting(self) -> tuple[bytes, ...]:
        """See `agent.node.Node`: the last stop and resume. A mission is its agent's to keep: a bridge that
        starts again has to hear it anew."""
        return self._lasting.current

    def recall(self, now_ns: int, orders: Sequence[bytes]) -> None:
        """See `agent.node.Node`. A stop holds on; what a resume gave back then is not given back again."""
        self._lasting.has_disk()
        for payload in orders:
            order = decode(payload)
            if isinstance(order, Stop | Resume):
                self._latch.recall(order)

    def kept(self, orders: tuple[bytes, ...], trouble: str) -> None:
        """Nothing: a plant acknowledges no orders but by what it does."""

    def runs_by(self, clock: MachineClock) -> None:
        """See `agent.node.Node`. Its agent's wrenches tell that one's clock, which it follows."""
        self._clock, self._followed = clock, ()

    def _follow(self, theirs: tuple[int, ...]) -> None:
        """Goes by the agent's wall clock from now on, if both come from one monotonic clock.

        A machine's clock may be set between the starts of an agent and its plant: each then maps it to the
        monotonic clock in its own way, for as long as it lives. On the bus a robot has one clock, the
        agent's; only the body is stepped by the plant's own, which never jumps.
        """
        own = self._clock
        if own is None or len(theirs) != len(own) or theirs[0] != own.boot:
            return
        ahead_ns = own.offset_ns - theirs[1]
        if abs(ahead_ns - self._ahead_ns) < CLOCK_STEP_NS:
            return
        self._ingress.moved(self._ahead_ns - ahead_ns)
        self._ahead_ns, self.phase_ns = ahead_ns, ahead_ns % self.period_ns
        self._wrench = None  # another agent's, by another clock: no measure of what is new

    def _accept_stop(self, stop: Stop, now_ns: int) -> str | None:
        if not can_be(stop.version, now_ns):
            return self._latch.accept_ahead(stop, now_ns)
        return self._latch.accept_stop(stop)

    def _accept_resume(self, resume: Resume, now_ns: int) -> str | None:
        if not can_be(resume.version, now_ns):
            return self._latch.accept_ahead(resume, now_ns)
        if not self._is_since(resume.time_ns):  # said again, by its operator or by others
            self._latch.recall(resume)
            return None
        return self._latch.accept_resume(resume)

    def _is_since(self, time_ns: int) -> bool:
        """Whether what is of that time (fleet's clock) lets this process drive its body."""
        return not self._is_vehicle or time_ns >= self._begun_ns - self._ahead_ns

    def _accept(self, wrench: Wrench, now_ns: int) -> str | None:
        """Takes a wrench; returns why it is refused, None when it is not."""
        if wrench.clock != self._followed:
            self._followed = wrench.clock
            if wrench.clock:
                self._follow(wrench.clock)
                now_ns = self._now_ns - self._ahead_ns
        if wrench.time_ns > now_ns + FUTURE_NS_MAX:
            return "future"
        if self._wrench is not None and wrench.time_ns <= self._wrench.time_ns:
            return "out_of_order"
        self._wrench, self._taken_ns = wrench, None
        return None

    def _accept_mission(self, mission: Mission, now_ns: int) -> str | None:
        """Takes a mission; returns why it is refused, None when it is not."""
        if not can_be(mission.version, now_ns):
            return "future"
        try:
            plan = self._missions.take(mission)
        except MissionRefused as error:
            return error.reason
        # A change of a drive that goes on is no clearance for a body that its operator has taken.
        if plan is not None and mission.epoch_ns != self._epoch_ns:
            self._epoch_ns = mission.epoch_ns
            self._numbers.begin(mission.epoch_ns)
            self._ingress.begin(mission.epoch_ns)
            if self._is_since(min(mission.time_ns, mission.epoch_ns)):
                self._backend.clear_to_drive()
        return None

    def _command(self, now_ns: int) -> Command | None:
        """What the body is to do now, None to brake; sets `condition`."""
        wrench = self._wrench
        if self._ending:
            self.condition = "braking", "the plant was told to end"
        elif self._latch.stopped:
            # Its agent brakes as well: a stop must not hang on one process.
            self.condition = "braking", self._latch.stopped
        elif wrench is None:
            self.condition = "braking", "no wrench yet"
        elif now_ns - wrench.time_ns > self._timeout_ns:
            self.condition = "braking", f"no fresh wrench for {(now_ns - wrench.time_ns) / NS_PER_S:.2f} s"
            if now_ns - wrench.time_ns - self._late_ns <= self._timeout_ns:
                late = f"overloaded: this machine ran late by {self._late_ns / NS_PER_S:.2g} s"
                self.condition = "braking", late
        elif wrench.brake:
            self.condition = "braking", "its agent brakes"
        else:
            self.condition = "driving", ""
            if self._taken_ns is None:
                self._taken_ns = now_ns
            # It does not act on for longer: see `ACTS_PERIODS`.
            acts = now_ns - self._taken_ns < ACTS_PERIODS * self.period_ns << wrench.step
            return new(Command, (wrench.force, wrench.torque)) if acts else COAST
        return None

    def tick(self, now_ns: int) -> list[Outgoing]:
        """Steps the body to `now_ns` (ns of the own wall clock) with the command that holds now.

        Returns what to publish: its state as measured, the true one where that may differ, its checks.
        """
        self._now_ns = now_ns
        if not self._begun_ns:
            self._begun_ns = now_ns
        fleet_ns = now_ns - self._ahead_ns
        self._ingress.arrive(fleet_ns)
        self._lasting.look(None)
        command = self._command(fleet_ns)
        self._late_ns = 0
        reading = self._backend.step(now_ns, command)
        if self._ahead_ns:
            reading = reading._replace(time_ns=reading.time_ns - self._ahead_ns)
        pose, self._obeying, self.healthy = reading.pose, reading.obeying, reading.healthy
        if reading.healthy and not (reading.obeying or self._ending or self._latch.stopped):
            self.condition = "released", reading.note  # whatever its agent says
        self._at_rest = at_rest(pose.speed, pose.yaw_rate)
        sequence = self._numbers.next(reading.time_ns)
        out = []
        if self._measurement.exact:
            out.append((self._key_state, encode(self._state(sequence, reading, pose, command))))
        else:
            measured = self._measurement.measured(pose, reading.time_ns, sequence)
            if measured is not None:
                out.append((self._key_state, encode(self._state(sequence, reading, measured, command))))
            out.append((self._key_truth, encode(self._state(sequence, reading, pose, command))))
        if self._has_checks:
            checks = self._backend.checks(now_ns)
            if checks and (self._changed(checks) or now_ns >= self._checks_due_ns):
                out.append((self._key_checks, self._checks_message(checks, now_ns)))
        if self._speaks:
            for severity, text in self._backend.status_texts():
                said = StatusText(self.robot, self._texts_sequence, fleet_ns, severity, clipped(text))
                self._texts_sequence += 1
                out.append((self._key_texts, encode(said)))
        out += self._ingress.outgoing(fleet_ns, flush=command is None)
        return out

    def _changed(self, checks: Sequence[Check]) -> bool:
        """Whether they are other lines, or at other levels, than those published last. Their texts may hold
        figures that change with every tick: those wait for their second.
        """
        if checks is self._checks:  # as mostly: a backend makes them less often than it ticks
            return False
        self._checks, levels = checks, self._levels
        self._levels = [(check.name, check.level) for check in checks]
        return self._levels != levels

    def _checks_message(self, checks: Sequence[Check], now_ns: int) -> bytes:
        """The checks as a message that fits: of too many lines the worst, of too much text the beginnings."""
        self._checks_due_ns = now_ns + CHECKS_PERIOD_NS
        self._checks_sequence += 1
        if len(checks) > CHECKS_MAX:
            checks = sorted(checks, key=lambda check: -LEVELS.index(check.level))[:CHECKS_MAX]
        payload = b""
        for most in (TEXT_MAX, CHECK_TEXT_MIN):
            lines = tuple(
                CheckLine(clipped(name, most), level, clipped(found, most), clipped(advice, most))
                for name, level, found, advice in checks
            )
            payload = encode(Checks(self.robot, self._checks_sequence - 1, now_ns - self._ahead_ns, lines))
            if len(payload) <= BYTES_MAX:
                break
        return payload

    def _state(self, sequence: int, reading: Reading, pose: Pose, command: Command | None) -> PlantState:
        x, y, heading, speed, yaw_rate = pose
        time_ns, _, force, torque, healthy, note, obeying, asked = reading
        driving = command is not None and healthy and obeying
        goes_by = () if asked is None else (asked,)
        values = (
            self.robot, sequence, time_ns, x, y, heading, speed, yaw_rate, force, torque,
            driving, healthy, obeying, clipped(note) if note else "", goes_by,
        )  # fmt: skip
        return new(PlantState, values)
