"""One robot's agent, without clock, socket, thread or randomness of its own.

`Agent.receive` takes what came off the bus, `Agent.tick` says what to put on it. A process
(`agent.runtime.process`) and the virtual-time simulation drive the same object with the same bytes.
"""

from __future__ import annotations

from math import exp, hypot, isfinite
from typing import Final

from agent.common.errors import Error
from agent.common.time import NS_PER_S
from agent.control import hand
from agent.control.controller import Controller
from agent.control.prediction import BRAKING_TIME_S
from agent.fleet.loading import digest
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve
from agent.formation.mission_plan import PlanError, plan_of
from agent.links.ingress import Ingress
from agent.messages import key_expressions
from agent.messages.codec import decode, encode, newer
from agent.messages.sequence_numbers import SequenceNumbers
from agent.messages.types import (
    FLOAT_MAX,
    HEARD_ROUNDS,
    NO_FORCES,
    TOPICS,
    Ask,
    Beacon,
    Faults,
    Forces,
    HandState,
    Heartbeat,
    Mission,
    Outgoing,
    PlantState,
    Resume,
    Stop,
    Wrench,
    clipped,
)
from agent.messages.validation import Malformed
from agent.supervision.neighbour_trust import NeighbourTrust
from agent.supervision.order_relay import OrderRelay
from agent.supervision.situation import Situation
from agent.supervision.state_machine import DRIVING, State, step
from agent.supervision.status import StatusReport

LAST_PLACE_NS: Final = NS_PER_S
"""A robot whose plant is lost says for so long where it must have come to rest. Then its silence says that
this grows uncertain."""
_HAND: Final = TOPICS.index("hand")
_STATE: Final = TOPICS.index("state")
_BEACON: Final = TOPICS.index("beacon")


class Agent:
    """The agent of robot `robot` of `fleet`.

    Raises:
        agent.fleet.model.FleetError: the fleet has no such robot, or its formation cannot be resolved.
    """

    def __init__(self, fleet: Fleet, robot: int) -> None:
        fleet.robot(robot)  # says which there are, when there is none of that id
        name = fleet.fleet.name
        self.robot: Final = robot
        self.period_ns: Final = fleet.period_ns
        self.phase_ns: Final = fleet.period_ns // 2
        """Agents tick half a period after plants: a plant's state has come by then, and the
        wrench is there before the plant's next tick."""
        self.state = State.WAITING
        self.transition = ""
        self.reason = ""

        self._fleet, self._geometry = fleet, resolve(fleet)
        self._controller = Controller(fleet, self._geometry, robot)
        self._peers, self._reference = self._controller.peers, self._controller.reference
        self._proximity = self._controller.proximity
        self._trust = NeighbourTrust(fleet, self._controller)
        self._situation = Situation(fleet, robot, self._controller, self._trust)
        self._digest = digest(fleet)

        self._latch = self._situation.latch
        self._relay = OrderRelay(fleet, robot, self._latch)
        self._hand_numbers = SequenceNumbers(self.period_ns, self.phase_ns)
        self._wrench_numbers = SequenceNumbers(self.period_ns, self.phase_ns)
        self._report = StatusReport()
        self._beacon_rounds = max(1, round(fleet.fleet.rate_hz / fleet.avoidance.beacon_hz))
        self.rejected: Final = self._report.rejected
        self._position: tuple[float, float] | None = None
        self._seen: tuple[int, hand.Hand, PlantState] | None = None
        self._doubt = 0.0
        self._degree = 0

        self._key_hand = key_expressions.hand(name, robot)
        self._key_beacon = key_expressions.beacon(name, robot)
        self._key_wrench = key_expressions.wrench(name, robot)
        self._key_status = key_expressions.status(name, robot)
        self._key_plant = key_expressions.plant_state(name, robot)
        self._key_heartbeat = key_expressions.heartbeat(name)
        self._key_ask = key_expressions.ask(name)
        others = [other for other in fleet.ids if other != robot]
        self._hands = {key_expressions.hand(name, other): other for other in others}
        self._beacons = {key_expressions.beacon(name, other): other for other in others}
        self._hand_of = {other: key for key, other in self._hands.items()}
        self.alive_key: Final = key_expressions.alive(name, robot, "agent")
        self.watched: Final = key_expressions.alive(name, "*", "agent")
        sources = {"hand": others, "beacon": others, "state": (robot,)}
        self._ingress = Ingress(fleet, robot, "agent", sources)
        self.plan: Final = self._ingress.plan
        self._always = (
            # A stop is taken before a mission: who catches up must not drive first. What robots relay comes
            # on one key, and so in the order in which it is said: there too the stop first.
            key_expressions.stop(name),
            key_expressions.resume(name),
            self._relay.subscription,
            self._key_plant,
            key_expressions.mission(name),
            self._key_heartbeat,
            self._key_ask,
            key_expressions.beacon(name, "*"),
            *self._ingress.subscriptions,
        )
        self.subscriptions: tuple[str, ...] = self._always
        self.publications: Final = (
            self._key_wrench,
            self._key_hand,
            self._key_status,
            self._key_beacon,
            self._relay.key,
            *self._ingress.publications,
        )
        self._controller.look(0)
        self._listen()

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
                reason = self._through(now_ns, key, payload, _HAND, message)
        elif type(message) is PlantState:
            if key == self._key_plant and message.robot == self.robot:
                reason = self._through(now_ns, key, payload, _STATE, message)
        elif type(message) is Beacon:
            if key == self._key_beacon:
                reason = None  # its own
            elif self._beacons.get(key) == message.robot:
                reason = self._through(now_ns, key, payload, _BEACON, message)
        elif type(message) is Mission or type(message) is Stop or type(message) is Resume:
            if key == self._relay.key:
                reason = None  # its own
            elif self._relay.is_source(key, message):
                reason = self._accept_order(message, now_ns)
        elif type(message) is Heartbeat:
            if key == self._key_heartbeat:
                self._situation.heartbeat_ns, reason = now_ns, None
        elif type(message) is Ask:
            if key == self._key_ask:
                self._relay.asked(now_ns)
                reason = None
        elif type(message) is Faults and key == self._ingress.key_faults:
            reason = self._ingress.accept(message, now_ns)
        if reason is not None:
            self._reject(reason)

    def present(self, key: str, here: bool) -> None:
        """See `agent.node.Node`: another agent's process came or went."""
        found = key_expressions.robot_of_alive(key)
        if found is not None and found[0] != self.robot:
            self._peers.present(found[0], here)

    def _through(
        self, now_ns: int, key: str, payload: bytes, topic: int, message: HandState | PlantState | Beacon
    ) -> str | None:
        """Takes what came over a link that may fail."""
        ingress = self._ingress
        if ingress.idle or ingress.take(now_ns, key, payload, topic, message, self._position):
            return self._accept(message, now_ns)
        return None

    def _accept(self, message: HandState | PlantState | Beacon, now_ns: int) -> str | None:
        if type(message) is HandState:
            return self._peers.accept(message, now_ns)
        if type(message) is Beacon:
            self._relay.compare(now_ns, message)
            if message.silent:
                self._peers.accept_silent(message, now_ns)
            return self._peers.accept_beacon(message, now_ns)
        assert type(message) is PlantState
        return self._situation.accept_plant(message, now_ns)

    def _arrive(self, now_ns: int) -> None:
        """Takes the messages that failing links let through at this tick."""
        for key, payload, whole in self._ingress.arrivals(now_ns):
            try:
                message = whole or decode(payload)  # damaged bytes are what the codec must find
            except Malformed as error:
                self._refuse(key, error)
                continue
            if isinstance(message, HandState | PlantState | Beacon):
                reason = self._accept(message, now_ns)
                if reason is not None:
                    self._reject(reason)

    def _refuse(self, key: str, error: Malformed) -> None:
        if key in self._hands:
            self._report.corrupted += 1
            if error.reason == "version":
                self._peers.get(self._hands[key]).other_version = error.detail
        self._reject(error.reason)

    def _reject(self, reason: str) -> None:
        self.rejected[reason] += 1

    def _accept_order(self, order: Mission | Stop | Resume, now_ns: int) -> str | None:
        if isinstance(order, Mission):
            return self._accept_mission(order, now_ns)
        return self._relay.accept(now_ns, order)

    def _accept_mission(self, mission: Mission, now_ns: int) -> str | None:
        if mission.digest != self._digest:
            self._situation.refused_mission = (
                f"the mission is for another fleet file: its digest is {mission.digest[:16]}, "
                f"this agent's is {self._digest}"
            )
            return "digest"
        self._relay.heard(now_ns, mission)
        before = self._situation.mission
        if not newer(mission, before):
            return None
        try:
            plan = plan_of(mission, self._fleet, self._geometry)
        except PlanError as error:
            self._situation.refused_mission = f"the mission cannot be driven: {error}"
            return "mission"
        self._situation.mission = mission
        self._relay.take(mission)
        self._situation.refused_mission = ""
        self._controller.plan(plan)
        if before is None or before.epoch_ns != mission.epoch_ns:
            self._situation.give_back()
            self._ingress.begin(mission.epoch_ns)
            self._hand_numbers.begin(mission.epoch_ns)
            self._wrench_numbers.begin(mission.epoch_ns)
        return None

    def end(self) -> None:
        """The process is about to end: from the next tick on the robot brakes."""
        self._situation.ending = True

    def timed(self, duration_ns: int, missed: int) -> None:
        """Takes from the loop, after each tick, how long it took and how many were skipped before it."""
        self._report.timed(duration_ns, missed)

    # ------------------------------------------------------------------ out

    @property
    def condition(self) -> tuple[str, str]:
        return self.state.value, self.reason

    @property
    def done(self) -> bool:
        return self._situation.ended

    def tick(self, now_ns: int) -> list[Outgoing]:
        """One control tick at `now_ns`: decides the state, runs the law, returns what to publish."""
        self._peers.begin(now_ns)
        if not self._ingress.idle:
            self._arrive(now_ns)
        self._controller.look(now_ns)
        here = self._here(now_ns)
        self._report.ages_us.extend(self._trust.update(now_ns, self.state, here))
        self._listen()
        was = self.state
        self._situation.lost_plant(was)
        conditions = self._situation.conditions(now_ns, was)
        if not (was is State.RUNNING and conditions.all_well):
            self.state, row = step(was, conditions)
            if row is not None:
                self.reason = row.reason(conditions)
                if self.state is not was:
                    self.transition = row.name
        drives = self.state in DRIVING
        if drives and was not in DRIVING:
            self._controller.restart()
        shown = self._last_known(now_ns) if here is None else here
        out = self._drive(now_ns, here) if drives and here is not None else self._brake(now_ns, shown)
        if self.state is not was or self._report.is_due(now_ns):
            out.append(self._status(now_ns))
        if shown is not None:
            self._beacon(now_ns, shown, out)
        self._relay.look(now_ns, self._situation.plant, drives=drives)
        out += self._relay.due(now_ns)
        stopping = self._situation.ending or self.state in (State.STOPPING, State.STOPPED)
        out += self._ingress.outgoing(now_ns, flush=stopping)
        return out

    def _here(self, now_ns: int) -> hand.Hand | None:
        """Where the own hand is; None when the plant does not tell."""
        situation = self._situation
        situation.check_plant(now_ns)
        plant = situation.plant
        if plant is None or situation.plant_trouble:
            return None
        here = self._controller.hand_at(plant, now_ns)
        if not max(map(abs, here)) <= FLOAT_MAX:
            situation.plant_trouble = "plant unhealthy: it tells an impossible place"
            return None
        self._position = here.x, here.y
        self._seen = now_ns, here, plant
        self._doubt = 0.0
        return here

    def _last_known(self, now_ns: int) -> hand.Hand | None:
        """Where the own hand is since its plant was lost; None when that is long ago.

        The others must not go on taking it for a robot that drives. It may have stopped where it was measured
        last, or have driven on until it was missed and braked since: it is somewhere on this way.
        """
        if self._seen is None or now_ns - self._seen[0] > LAST_PLACE_NS:
            return None
        since_ns, here, measured = self._seen
        near = self._controller.hand_at(measured, measured.time_ns)
        remains = exp(-(now_ns - since_ns) / NS_PER_S / BRAKING_TIME_S)
        way = BRAKING_TIME_S * (1.0 - remains)
        x, y = here.x + way * here.vx, here.y + way * here.vy
        self._doubt = 0.5 * hypot(x - near.x, y - near.y)
        return hand.Hand(0.5 * (x + near.x), 0.5 * (y + near.y), remains * here.vx, remains * here.vy)

    def _listen(self) -> None:
        """Changes the subscriptions when other robots are to be listened to."""
        if self._trust.changed:
            self._trust.changed = False
            wanted = sorted({peer.robot for _, peer in self._controller.edges} | set(self._close()))
            self.subscriptions = (*self._always, *(self._hand_of[other] for other in wanted))

    def _close(self) -> tuple[int, ...]:
        return tuple(peer.robot for peer in self._proximity.close)

    def _drive(self, now_ns: int, here: hand.Hand) -> list[Outgoing]:
        plant = self._situation.plant
        assert plant is not None
        try:
            drive = self._controller.drive(plant, now_ns, self._trust.slower)
        except Error as error:  # of a law of others: it is not asked again
            self._situation.numbers = str(error)
            return self._brake(now_ns, here)
        multipliers = self._controller.coupling.shared()
        numbers = (drive.force, drive.torque, *drive.forces, *(value for _, value in multipliers))
        if not isfinite(sum(numbers)) or max(numbers) > FLOAT_MAX or min(numbers) < -FLOAT_MAX:
            # Never sent, never hidden: this tick brakes, and the next finds the fault.
            self._situation.numbers = f"the law gave force {drive.force} N and torque {drive.torque} N m"
            return self._brake(now_ns, here)
        self._controller.sent(now_ns, drive.force, drive.torque)
        self._degree = drive.degree
        for cause in drive.causes:
            self._report.interventions[cause] += 1
        self._report.interventions["any"] += bool(drive.causes)
        return [
            self._wrench(now_ns, drive.force, drive.torque, brake=False),
            self._hand(now_ns, here, True, drive.forces, multipliers),
        ]

    def _brake(self, now_ns: int, here: hand.Hand | None) -> list[Outgoing]:
        self._controller.sent(now_ns, 0.0, 0.0)  # how hard the plant brakes is its own affair
        self._degree = 0
        out = [self._wrench(now_ns, 0.0, 0.0, brake=True)]
        if here is not None:
            out.append(self._hand(now_ns, here, self._follows, NO_FORCES, ()))
        return out

    @property
    def _follows(self) -> bool:
        """Whether the robot obeys the law, or stands ready to from the epoch on."""
        return self.state in DRIVING or (self.state is State.READY and self._situation.mission is not None)

    def _wrench(self, now_ns: int, force: float, torque: float, *, brake: bool) -> Outgoing:
        sequence = self._wrench_numbers.next(now_ns)
        message = Wrench(self.robot, sequence, now_ns, force, torque, brake)
        return self._key_wrench, encode(message)

    def _hand(
        self,
        now_ns: int,
        here: hand.Hand,
        following: bool,
        forces: Forces,
        multipliers: tuple[tuple[int, float], ...],
    ) -> Outgoing:
        sequence = self._hand_numbers.next(now_ns)
        heard = self._peers.heard() if (sequence + self.robot) % HEARD_ROUNDS == 0 else ()
        message = HandState(
            self.robot,
            sequence,
            now_ns,
            following,
            self._degree,
            *here,
            *forces,
            self._doubt,
            multipliers,
            heard,
        )
        self._report.sent_hands += len(self._controller.edges)
        return self._key_hand, encode(message)

    def _beacon(self, now_ns: int, here: hand.Hand, out: list[Outgoing]) -> None:
        """Tells all where the robot is; robots take turns, so that these do not come all at once."""
        round_number = (now_ns - self.phase_ns) // self.period_ns
        if (round_number + self.robot) % self._beacon_rounds:
            return
        beacon = Beacon(
            self.robot,
            self._hand_numbers.at(now_ns),
            now_ns,
            self._follows,
            *here,
            self._doubt,
            *self._relay.mission_mark,
            *self._latch.mark,
            self._peers.silent(now_ns, here.x, here.y),
        )
        out.append((self._key_beacon, encode(beacon)))

    def _status(self, now_ns: int) -> Outgoing:
        mission = self._situation.mission
        mission_version = 0 if mission is None else mission.version
        situation = (self.state.value, self.transition, clipped(self.reason))
        neighbours = [peer for _, peer in self._controller.edges]
        status = self._report.status(
            now_ns, self.robot, situation, mission_version, self._latch.version, neighbours, self._peers.known
        )
        return self._key_status, encode(status)
