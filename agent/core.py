"""One robot's agent, without clock, socket, thread or randomness of its own.

`Agent.receive` takes what came off the bus, `Agent.tick` says what to put on it. A process
(`process.py`) and the virtual-time simulation drive the same object with the same bytes.
"""

from __future__ import annotations

from collections import Counter
from math import isfinite
from typing import Final

from agent import hand, keys
from agent.clock import NS_PER_S
from agent.controller import Controller
from agent.fleet import Fleet, digest
from agent.formation import resolve
from agent.leave import AWAITED, Leave
from agent.messages import (
    FLOAT_MAX,
    TOPICS,
    Faults,
    HandState,
    Malformed,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    Wrench,
    clipped,
    decode,
    encode,
)
from agent.neighbours import FUTURE_NS_MAX
from agent.node import Numbers, Outgoing
from agent.reception import Reception
from agent.supervision import Conditions, State, at_rest, step

STATUS_PERIOD_NS: Final = NS_PER_S // 5
HEARD_ROUNDS: Final = 7
"""Each robot's hand states echo once in so many what it heard of its neighbours: clocks part slowly."""
STATUS_VALUES_MAX: Final = 200
"""A status goes out early rather than hold more tick times or ages than this."""
_HAND: Final = TOPICS.index("hand")
_STATE: Final = TOPICS.index("state")


class Agent:
    """The agent of robot `robot` of `fleet`.

    Raises:
        agent.fleet.FleetError: the fleet has no such robot, or its formation cannot be resolved.
    """

    def __init__(self, fleet: Fleet, robot: int) -> None:
        fleet.robot(robot)  # says which there are, when there is none of that id
        control = fleet.control
        name = fleet.fleet.name
        self.robot: Final = robot
        self.period_ns: Final = fleet.period_ns
        self.phase_ns: Final = fleet.period_ns // 2
        """Agents tick half a period after plants: a plant's state has come by then, and the
        wrench is there before the plant's next tick."""
        self.state = State.WAITING
        self.reason = ""

        self._controller = Controller(fleet, resolve(fleet), robot)
        self._neighbours = self._controller.neighbours
        self._horizon_ns = round(control.prediction_horizon_s * NS_PER_S)
        self._plant_timeout_ns = round(control.plant_timeout_s * NS_PER_S)
        self._digest = digest(fleet)

        self._plant: PlantState | None = None
        self._plant_trouble = "for its plant"
        self._mission: Mission | None = None
        self._stop: Stop | None = None
        self._refused_mission = ""
        self._leaving = False
        self._taken = ""
        self._leave = Leave(robot, self._forget_taking)
        self._numbers = ""
        self._hand_numbers = Numbers(self.period_ns, self.phase_ns)
        self._wrench_numbers = Numbers(self.period_ns, self.phase_ns)
        self._status_sequence = self._status_due_ns = 0
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
        self._key_resume = keys.resume(name)
        self._hands = {keys.hand(name, other): other for other in self._neighbours.ids}
        self.alive_key: Final = keys.alive(name, robot, "agent")
        self._reception = Reception(fleet, robot, "agent", {"hand": self._neighbours.ids, "state": (robot,)})
        self.plan: Final = self._reception.plan
        self._position: tuple[float, float] | None = None
        self.subscriptions: Final = (
            self._key_plant,
            *self._hands,
            self._key_mission,
            self._key_stop,
            self._key_resume,
            *self._reception.subscriptions,
        )
        self.publications: Final = (
            self._key_wrench,
            self._key_hand,
            self._key_status,
            *self._reception.publications,
        )

    # ------------------------------------------------------------------ in

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes one message off the bus. What is not valid is counted by its reason and changes nothing."""
        try:
            message = decode(payload)
        except Malformed as error:
            self._refuse(key, error)
            return
        reason: str | None = "wrong_key"
        if type(message) is HandState:
            if self._hands.get(key) == message.robot:
                reception = self._reception
                if reception.idle or reception.take(now_ns, key, payload, _HAND, message, self._position):
                    reason = self._neighbours.accept(message, now_ns)
                else:
                    reason = None
        elif type(message) is PlantState:
            if key == self._key_plant and message.robot == self.robot:
                reception = self._reception
                if reception.idle or reception.take(now_ns, key, payload, _STATE, message):
                    reason = self._accept_plant(message, now_ns)
                else:
                    reason = None
        elif type(message) is Mission:
            if key == self._key_mission:
                reason = self._accept_mission(message)
        elif type(message) is Stop:
            if key == self._key_stop:
                reason = self._accept_stop(message)
        elif type(message) is Resume:
            if key == self._key_resume:
                reason = self._leave.accept(message)
        elif type(message) is Faults and key == self._reception.key_faults:
            reason = self._reception.accept(message, now_ns)
        if reason is not None:
            self._reject(reason)

    def _arrive(self, now_ns: int) -> None:
        """Takes the messages that failing links let through at this tick."""
        for key, payload, whole in self._reception.arrivals(now_ns):
            try:
                message = whole or decode(payload)  # damaged bytes are what the codec must find
            except Malformed as error:
                self._refuse(key, error)
                continue
            reason = None
            if type(message) is HandState:
                reason = self._neighbours.accept(message, now_ns)
            elif type(message) is PlantState:
                reason = self._accept_plant(message, now_ns)
            if reason is not None:
                self._reject(reason)

    def _refuse(self, key: str, error: Malformed) -> None:
        if key in self._hands:
            self._corrupted += 1
        self._reject(error.reason)

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
            self._refused_mission = self._taken = ""
            self._controller.plan(mission.epoch_ns)
            self._reception.begin(mission.epoch_ns)
            self._hand_numbers.begin(mission.epoch_ns)
            self._wrench_numbers.begin(mission.epoch_ns)
            if self._stop is not None and self._stop.version < mission.version:
                self._stop = None
        return None

    def _forget_taking(self) -> None:
        self._taken = ""

    def _accept_stop(self, stop: Stop) -> str | None:
        # A stop is for all missions up to its version: only a later one ends it, whichever comes first.
        if self._mission is not None and stop.version < self._mission.version:
            return "out_of_order"
        if self._stop is not None and stop.version < self._stop.version:
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
        """True when a leaving robot stands, does not obey, or nothing is known of it that could say so."""
        return self._leaving and (bool(self._plant_trouble or self._body_trouble) or self._at_rest)

    def tick(self, now_ns: int) -> list[Outgoing]:
        """One control tick at `now_ns`: decides the state, runs the law, returns what to publish."""
        self._neighbours.begin(now_ns)
        if not self._reception.idle:
            self._arrive(now_ns)
        ages_ns = self._neighbours.ages_ns(now_ns)
        self._ages_us.extend([age // 1000 for age in ages_ns if age is not None])
        self._plant_trouble = self._check_plant(now_ns)
        was = self.state
        if was is State.RELEASED and self._plant_trouble:
            # A plant that starts again cannot know that its operator had the body: this agent does.
            self._taken = f"its plant was lost while its operator had the body: {AWAITED}"
        if not (was is State.RUNNING and self._all_well(now_ns, ages_ns)):
            conditions = self._conditions(now_ns, ages_ns)
            self.state, row = step(was, conditions)
            if row is not None:
                self.reason = row.reason(conditions)
        if self.state is State.RUNNING and was is not State.RUNNING:
            self._controller.restart()
        out = self._drive(now_ns) if self.state is State.RUNNING else self._brake(now_ns)
        if now_ns >= self._status_due_ns or len(self._ages_us) > STATUS_VALUES_MAX or self.state is not was:
            out.append(self._status(now_ns, ages_ns))
        stopping = self._leaving or self.state in (State.STOPPING, State.STOPPED)
        out += self._reception.outgoing(now_ns, flush=stopping)
        return out

    def _check_plant(self, now_ns: int) -> str:
        plant = self._plant
        if plant is None:
            return "for its plant"
        age_ns = now_ns - plant.time_ns
        if age_ns > self._plant_timeout_ns:
            return f"plant silent for {age_ns / NS_PER_S:.2f} s"
        return "" if plant.healthy else f"plant unhealthy: {plant.note or 'no reason given'}"

    @property
    def _body_trouble(self) -> str:
        """Why a body whose pose is good does not do what it is asked; "" when it does."""
        plant = self._plant
        if plant is not None and not plant.obeying:
            return plant.note or "its body does not obey"
        return self._taken

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
            or self._body_trouble
            or mission is None
            or now_ns >= mission.epoch_ns + mission.duration_ns
            or self._controller.acts_from_ns(now_ns) < mission.epoch_ns
        )

    def _conditions(self, now_ns: int, ages_ns: list[int | None]) -> Conditions:
        mission = self._mission
        silent = [
            self._silence(column, age)
            for column, age in enumerate(ages_ns)
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
            body=self._body_trouble,
            numbers=self._numbers,
            neighbours=f"silent neighbours: {', '.join(silent)}" if silent else "",
            mission="" if mission is not None else self._refused_mission or "for a mission",
            stop=stop,
            # The wrench of this tick acts from the plant's next tick on: that one starts the drive.
            started=mission is not None and self._controller.acts_from_ns(now_ns) >= mission.epoch_ns,
            at_rest=self._at_rest,
        )

    def _silence(self, column: int, age: int | None) -> str:
        """A silent neighbour in words: its id, and for how long or why nothing is known of it."""
        other, ahead_ns = self._neighbours.ids[column], self._neighbours.ahead_ns[column]
        if ahead_ns:
            return f"{other} (its clock is {ahead_ns / NS_PER_S:.2f} s ahead)"
        return str(other) if age is None else f"{other} ({age / NS_PER_S:.1f} s)"

    @property
    def _at_rest(self) -> bool:
        plant = self._plant
        return plant is not None and at_rest(plant.speed, plant.yaw_rate)

    def _drive(self, now_ns: int) -> list[Outgoing]:
        assert self._plant is not None
        force, torque, here, nx, ny, cx, cy = self._controller.drive(self._plant, now_ns)
        numbers = (force, torque, *here, nx, ny, cx, cy, *self._controller.multipliers)
        if not isfinite(sum(numbers)) or max(numbers) > FLOAT_MAX or min(numbers) < -FLOAT_MAX:
            # Never sent, never hidden: this tick brakes, and the next finds the fault.
            self._numbers = f"the law gave force {force} N and torque {torque} N m"
            return self._brake(now_ns)
        self._controller.sent(now_ns, force, torque)
        return [
            self._wrench(now_ns, force, torque, brake=False),
            self._hand(now_ns, here, True, nx, ny, cx, cy),
        ]

    def _brake(self, now_ns: int) -> list[Outgoing]:
        self._controller.sent(now_ns, 0.0, 0.0)  # how hard the plant brakes is its own affair
        out = [self._wrench(now_ns, 0.0, 0.0, brake=True)]
        if self._plant is not None and not self._plant_trouble:
            here = self._controller.hand_at(self._plant, now_ns)
            if max(map(abs, here)) <= FLOAT_MAX:
                follows = self.state is State.READY and self._mission is not None
                out.append(self._hand(now_ns, here, follows, 0.0, 0.0, 0.0, 0.0))
        return out

    def _wrench(self, now_ns: int, force: float, torque: float, *, brake: bool) -> Outgoing:
        sequence = self._wrench_numbers.next(now_ns)
        message = Wrench(self.robot, sequence, now_ns, force, torque, brake)
        return self._key_wrench, encode(message)

    def _hand(
        self, now_ns: int, here: hand.Hand, following: bool, nx: float, ny: float, cx: float, cy: float
    ) -> Outgoing:
        # In the tick in which the numbers fail the state is RUNNING still, and they must not go out.
        driven = following and self.state is State.RUNNING
        pairs = zip(self._neighbours.ids, self._controller.multipliers, strict=True)
        multipliers = tuple(pairs) if driven else ()
        self._position = here.x, here.y
        sequence = self._hand_numbers.next(now_ns)
        heard = self._neighbours.heard() if (sequence + self.robot) % HEARD_ROUNDS == 0 else ()
        message = HandState(
            self.robot,
            sequence,
            now_ns,
            following,
            *here,
            nx,
            ny,
            cx,
            cy,
            multipliers,
            heard,
        )
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
                (
                    other,
                    -1 if age is None else max(age, 0) // 1000,
                    neighbours.received_by[column],
                    neighbours.lost_by[column],
                    clock.offset_us,
                    clock.error_us,
                )
                for column, (other, age, clock) in enumerate(
                    zip(neighbours.ids, ages_ns, neighbours.clocks, strict=True)
                )
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
