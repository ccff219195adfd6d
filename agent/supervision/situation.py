"""What a robot's situation is: what the state machine decides by, in one place (PURE).

Plant, body, orders, neighbours, heartbeat, own numbers: each is watched here, and summed up once a tick as
`Conditions`, whose texts are what the status says.
"""

from __future__ import annotations

from math import hypot, inf
from typing import Final

from handfast.agent.common.models import new
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.controller import Controller
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import FUTURE_NS_MAX, Heartbeat, Mission, PlantState
from handfast.agent.supervision.neighbour_trust import NeighbourTrust
from handfast.agent.supervision.orders import AWAITED, StopLatch
from handfast.agent.supervision.overload import SAID_NS, Overload
from handfast.agent.supervision.state_machine import (
    ACTIVE,
    DRIVING,
    MISSION_OVER,
    PLANT_SILENT,
    Conditions,
    State,
    at_rest,
)

NOT_SAID: Final = "for an operator's word, or for one who drives by its mission: that is of before its start"
"""Why a robot does not drive by a mission that it has only been told of."""
UNHEEDED_S: Final = 1.0
"""A plant that brakes for so long longer than it waits for a wrench does not hear its agent."""
RUNAWAY: Final = 2.0
RUNAWAY_MORE: Final = 0.2
"""A body that is so many times as fast as it may be, and so much (m/s) more, does not do what it is told."""
SPIN_MAX: Final = 1.0
"""rad: nor does one that turns further than this between two decisions, eight times as far as it is let: what
is decided for one heading acts on another, and pushes it on."""


class Situation:
    """What is known of one robot's own situation, for its supervision.

    Args:
        fleet, robot: whose it is.
        controller, trust, overload: the robot's own; asked, not changed.

    Attributes:
        plant: the newest state of the plant, None before the first.
        plant_trouble: why its pose cannot be used, "" when it can; set by `check_plant`.
        mission: the one in force, None before the first.
        refused_mission: why the newest mission was refused, "" when it was not.
        numbers: why the robot's own numbers failed, "" while they have not. Nothing mends it.
        ending: whether the process is to end.
        heartbeat_ns: when the operator's last heartbeat came, 0 before the first.
        latch: the last stop and resume.
        unkept: why the orders that it has are not on its disk, "" when they are.
        may_go_on: whether it may drive by the mission that it knows. That is not enough: orders outlive
            processes, and are relayed. Since this one started an operator has said the mission or a resume,
            or somebody was heard who drives by that mission. Then it stays so.
        unmoved_ns: how long the plant has braked though the robot drives; 0 while it does what it is asked.
    """

    def __init__(
        self, fleet: Fleet, robot: int, controller: Controller, trust: NeighbourTrust, overload: Overload
    ) -> None:
        self._fleet, self._robot, self._controller, self._trust = fleet, robot, controller, trust
        self._overload = overload
        self._stood = ""
        self.latch: Final = StopLatch(robot, self.give_back)
        self.plant: PlantState | None = None
        self.plant_trouble = "for its plant"
        self.mission: Mission | None = None
        self.refused_mission = self.numbers = ""
        self.unkept = ""
        self.ending = self.may_go_on = False
        self.heartbeat_ns = 0
        self._taken = ""
        self._plant_timeout_ns = round(fleet.control.plant_timeout_s * NS_PER_S)
        deadman_s = fleet.supervision.deadman_s
        self._deadman_ns = None if deadman_s is None else round(deadman_s * NS_PER_S)
        self._alone = not controller.proximity.enabled or len(fleet.ids) == 1
        self._listening_ns = fleet.listening_rounds * fleet.period_ns
        self._beacon_ns = fleet.beacon_rounds_max * fleet.period_ns
        self._listened_ns: int | None = None
        self._plant_came_ns = self._plant_ahead_ns = 0
        self._moved_ns = 0
        self._has_driven = False
        self.unmoved_ns = 0
        self._unheeded_s = UNHEEDED_S + fleet.control.wrench_timeout_s
        self._reach = fleet.robot(robot).hand_offset_m
        self._speed_max = fleet.control.max_speed_mps
        is_limited = controller.proximity.enabled
        self._runaway = RUNAWAY * self._speed_max + RUNAWAY_MORE if is_limited else inf
        self._spin_max = SPIN_MAX if is_limited else inf

    # ------------------------------------------------------------------ what happens

    def accept_plant(self, state: PlantState, now_ns: int) -> str | None:
        """Takes a state of the plant; returns why it is refused, None when it is not."""
        if state.time_ns > now_ns + FUTURE_NS_MAX:
            self._plant_ahead_ns = state.time_ns - now_ns
            return "future"
        if self.plant is not None and state.time_ns <= self.plant.time_ns:
            return "duplicate" if state.time_ns == self.plant.time_ns else "out_of_order"
        self.plant, self._plant_came_ns, self._plant_ahead_ns = state, now_ns, 0
        return None

    def accept_heartbeat(self, heartbeat: Heartbeat, now_ns: int) -> None:
        """Takes an operator's heartbeat."""
        self.heartbeat_ns = now_ns

    def check_plant(self, now_ns: int) -> None:
        """Finds `plant_trouble` at a tick; the first of them begins the time in which a robot listens."""
        if self._listened_ns is None:
            self._listened_ns = now_ns + self._listening_ns
        self.plant_trouble = self._plant_trouble(now_ns)

    def lost_plant(self, state: State) -> None:
        """After `plant_trouble` is found: a plant that starts again cannot know that its operator had the
        body; this robot does, and waits for a resume."""
        if state is State.RELEASED and self.plant_trouble and not self._stood:
            self._taken = f"its plant was lost while its operator had the body: {AWAITED}"

    def give_back(self) -> None:
        """A resume, or a mission of another epoch: the body is the robot's again, if it obeys."""
        self._taken = ""

    # ------------------------------------------------------------------ what it is

    @property
    def body_trouble(self) -> str:
        """Why a body whose pose is good does not do what it is asked; "" when it does."""
        plant = self.plant
        if plant is not None and not plant.obeying:
            return plant.note or "its body does not obey"
        return self._taken

    @property
    def is_let_down(self) -> bool:
        """Whether the plant brakes, which has driven since the robot does: it lacks wrenches."""
        return self._has_driven and self.plant is not None and not self.plant.driving

    @property
    def at_rest(self) -> bool:
        plant = self.plant
        return plant is not None and at_rest(plant.speed, plant.yaw_rate)

    @property
    def ended(self) -> bool:
        """True when a robot that is to end stands, does not obey, or nothing is known that could say so."""
        return self.ending and (bool(self.plant_trouble or self.body_trouble) or self.at_rest)

    def conditions(self, now_ns: int, state: State) -> Conditions:
        """The situation at a tick that begins in `state`."""
        mission, controller, trust = self.mission, self._controller, self._trust
        self._look_at_body(now_ns, state)
        # The wrench of this tick acts from the plant's next tick on: that one starts the drive.
        begun = mission is not None and controller.acts_from_ns(now_ns) >= mission.epoch_ns
        # It cannot know where it is, so it brakes; but nothing says that its plant is lost.
        stood = self._stood if state in ACTIVE else ""
        neighbours = ""
        if state not in DRIVING:  # a robot that drives has begun
            neighbours = trust.missing(now_ns, started=begun) or (self._listening(now_ns) if begun else "")
        degraded = self._degraded() if self.unmoved_ns else trust.degraded
        if self._overload.level and not self._overload.stands:
            degraded = "; ".join(filter(None, (self._overload.text(now_ns), degraded)))
        lacks = "" if mission is not None else self.refused_mission or "for a mission"
        plant = "" if stood else self.plant_trouble
        lacks = lacks or ("" if self.may_go_on else NOT_SAID)
        hold = stood or self._deadman(now_ns) or trust.hold
        values = (
            plant, self.body_trouble, self.numbers, self._no_place(now_ns), neighbours, lacks,
            self._stop(now_ns), hold, degraded,
            begun and self.may_go_on, self.at_rest,
        )  # fmt: skip
        return new(Conditions, values)

    def _stop(self, now_ns: int) -> str:
        """Return why the robot must stop, "" if it need not."""
        mission, stopped = self.mission, self.latch.stopped
        if self.ending:
            return "the agent was told to end"
        if stopped:
            return f"{stopped}; {self.unkept}" if self.unkept else stopped
        over = mission is not None and now_ns >= mission.epoch_ns + mission.duration_ns
        return MISSION_OVER if over else ""

    def _no_place(self, now_ns: int) -> str:
        """Return why the robot has no place in the formation, "" if it has one."""
        if self._controller.reference.is_member(self._robot, self._controller.acting_ns(now_ns)):
            return ""
        return "in reserve" if self._fleet.robot(self._robot).reserve else "it has left the formation"

    def _look_at_body(self, now_ns: int, state: State) -> None:
        """Finds for how long the plant has braked though the robot drives."""
        plant, drives = self.plant, state in DRIVING
        if not drives or plant is None or plant.driving or not plant.obeying:
            self._moved_ns = now_ns
            self._has_driven = drives and (self._has_driven or (plant is not None and plant.driving))
        self.unmoved_ns = now_ns - self._moved_ns

    def _degraded(self) -> str:
        """Why a robot drives other than the law says, and what is wrong with a body that goes on standing."""
        degraded, late_s = self._trust.degraded, self.unmoved_ns / NS_PER_S
        if late_s <= self._unheeded_s:
            return degraded
        return "; ".join(filter(None, (degraded, f"its plant has taken no wrench for {late_s:.1f} s")))

    def _plant_trouble(self, now_ns: int) -> str:
        plant, self._stood = self.plant, ""
        if plant is None:
            ahead_s = self._plant_ahead_ns / NS_PER_S
            return f"for its plant, whose clock is {ahead_s:.2f} s ahead" if ahead_s else "for its plant"
        age_ns = now_ns - plant.time_ns
        if age_ns > self._plant_timeout_ns:
            missed_ns = self._overload.missed_ns(plant.time_ns)
            if age_ns - missed_ns <= self._plant_timeout_ns:
                self._stood = self._overload.stall(now_ns)
                return self._stood
            came_ns = self._plant_came_ns
            if came_ns - plant.time_ns > self._plant_timeout_ns >= now_ns - came_ns:
                if 2 * missed_ns > age_ns:  # it waited for this process most of the time
                    return self._overload.stall(now_ns)
                return f"plant late by {age_ns / NS_PER_S:.2f} s, or its clock is behind"
            silent = f"{PLANT_SILENT} for {age_ns / NS_PER_S:.2f} s"
            # Most plants are on the computer of their agents, and may have no more of it than those.
            # One that is silent for no longer than this process stood lately may stand for the same reason.
            is_late = self._overload.wanted or age_ns <= self._overload.missed_ns(now_ns - SAID_NS)
            return f"{silent}, {self._overload.stall(now_ns)}" if is_late else silent
        if not plant.healthy:
            return f"plant unhealthy: {plant.note or 'no reason given'}"
        speed = hypot(plant.speed, self._reach * plant.yaw_rate)
        if speed > self._runaway and plant.obeying:
            return f"its body runs away: {speed:.2f} m/s, control.max_speed_mps is {self._speed_max:g}"
        held_s, spin = self._controller.held_s, abs(plant.yaw_rate)
        if spin * held_s > self._spin_max and plant.obeying:
            return f"its body spins: {spin:.1f} rad/s are too fast to be steered at {1.0 / held_s:g} Hz"
        return ""

    def _listening(self, now_ns: int) -> str:
        """Why a robot that comes into a drive must wait: it cannot know yet who is near, or where those went
        that are silent now."""
        if self._alone:
            return ""
        peers = self._controller.peers
        told_ns = max(0, peers.rows.rounds_to_tell - 1) * self._beacon_ns
        if now_ns < (self._listened_ns or 0) + told_ns:
            return "hears who is near"
        unknown = ", ".join(f"robot {robot}" for robot in peers.unknown)
        return f"nobody heard tells where to look for {unknown}" if unknown else ""

    def _deadman(self, now_ns: int) -> str:
        """Why the dead-man's switch holds the robot, "" when it does not."""
        if self._deadman_ns is None or now_ns - self.heartbeat_ns <= self._deadman_ns:
            return ""
        if not self.heartbeat_ns:
            return "no operator's heartbeat"
        age_ns, missed_ns = now_ns - self.heartbeat_ns, self._overload.missed_ns(self.heartbeat_ns)
        if age_ns - missed_ns <= self._deadman_ns and 2 * missed_ns > age_ns:  # else it is not for that
            return self._overload.stall(now_ns)
        return f"no operator's heartbeat for {(now_ns - self.heartbeat_ns) / NS_PER_S:.1f} s"
