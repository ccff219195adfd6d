"""One robot's agent, without clock, socket, thread or randomness of its own.

`Agent.receive` takes what came off the bus, `Agent.tick` says what to put on it. A process
(`agent.runtime.loop`) and the virtual-time simulation drive the same object with the same bytes.
Here is the order of things; what they are is in the rooms below.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from handfast.agent.common.errors import Error
from handfast.agent.common.time import NS_PER_MS, NS_PER_S, MachineClock
from handfast.agent.control import limits
from handfast.agent.control.controller import Controller, Drive
from handfast.agent.control.event_trigger import EventTrigger
from handfast.agent.control.hand import Hand
from handfast.agent.control.own_hand import OwnHand
from handfast.agent.control.peers.lateness import IN_TIME_NS, OUTAGE_NS, STOOD_KEPT_NS
from handfast.agent.control.peers.rolling import rolls_of
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import SEND_BOUND_M
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import MissionChoice, MissionRefused
from handfast.agent.links.ingress import Decode, Ingress
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import can_be, decode, encode
from handfast.agent.messages.types import (
    FLOAT_MAX,
    Ask,
    Beacon,
    HandState,
    Heartbeat,
    Mission,
    Outgoing,
    PlantState,
    Resume,
    Stop,
    clipped,
)
from handfast.agent.messages.validation import Malformed
from handfast.agent.supervision.deafness import Deafness
from handfast.agent.supervision.neighbour_trust import NeighbourTrust
from handfast.agent.supervision.orders import LastingOrders, OrderRelay
from handfast.agent.supervision.outbox import Outbox
from handfast.agent.supervision.overload import Overload
from handfast.agent.supervision.situation import Situation
from handfast.agent.supervision.state_machine import ACTIVE, DRIVING, State, StatusReport, status_hz, step

STOOD_NS: Final = 2 * OUTAGE_NS
"""It is told for how much of the time since then the own process did not run: whoever hears it looks no
further back for what may be lost."""
LATELY_NS: Final = 3 * NS_PER_S
STOOD_MOST_NS: Final = NS_PER_S // 5
"""A robot behind routers is not deaf whose process stood for longer than this lately."""


class Agent:
    """The agent of robot `robot` of `fleet`, an `agent.node.Node`.

    Args:
        decoder: see `agent.links.ingress.Ingress`.

    Raises:
        handfast.agent.fleet.model.FleetError: the fleet has no such robot, or its formation cannot be
        resolved. handfast.agent.control.own_law.LawError: its law cannot be made.
    """

    def __init__(self, fleet: Fleet, robot: int, decoder: Decode | None = None) -> None:
        fleet.robot(robot)  # says which there are, when there is none of that id
        name = fleet.fleet.name
        self.robot: Final = robot
        self.period_ns = fleet.period_ns
        self.phase_ns: Final = fleet.period_ns // 2
        """Agents tick half a period after plants: a plant's state has come by then, and the
        wrench is there before the plant's next tick."""
        self.state = State.WAITING
        self.transition = ""
        self.reason = ""

        geometry = resolve(fleet)
        self._missions = MissionChoice(fleet, geometry)
        self._controller = Controller(fleet, geometry, robot)
        self._peers = self._controller.peers
        self._rest_period_ns = limits.rest_period_ns(fleet)
        self._rests = False
        self._overload = Overload(
            limits.steps(fleet), fleet.period_ns, limits.gap_ns(fleet), limits.standing_period_ns(fleet)
        )
        self._stood_until_ns = 0
        self._speed_share = partial(limits.speed_share, fleet)
        self._peers.missed_ns = self._overload.missed_ns
        self._trust = NeighbourTrust(fleet, self._controller, self._overload)
        self._situation = Situation(fleet, robot, self._controller, self._trust, self._overload)
        self._latch = self._situation.latch
        self._relay = OrderRelay(fleet, robot, self._latch, self._missions)
        self._lasting = LastingOrders(self._latch)
        self._own_hand = OwnHand(self._controller, rolls_of(fleet.robot(robot)))
        self._event = _event_trigger(fleet, self._controller)
        self._outbox = Outbox(
            fleet, robot, self.phase_ns, self._peers, self._missions, self._latch, self._event
        )
        self._key_status = key_expressions.status(name, robot)

        others = [other for other in fleet.ids if other != robot]
        self._hand_of = {other: key_expressions.hand(name, other) for other in others}
        self._hands = {key: other for other, key in self._hand_of.items()}
        self._said_by = {key: (other, True) for key, other in self._hands.items()}
        self._said_by |= {key_expressions.beacon(name, other): (other, False) for other in others}
        self._watches_all, self._is_routed = not fleet.is_large, fleet.is_routed
        horizon_ns = round(fleet.control.prediction_horizon_s * NS_PER_S)
        self._deafness = Deafness(
            others,
            horizon_ns,
            fleet.hands_within_ns,
            seldom_ns=(fleet.beacon_rounds_max - fleet.beacon_rounds) * fleet.period_ns,
            sees_all=self._watches_all,
            one_link=fleet.is_routed,
        )
        self._ingress = Ingress(
            fleet,
            robot,
            "agent",
            {"hand": others, "beacon": others, "state": (robot,)},
            self._damaged,
            decoder,
        )
        self.plan: Final = self._ingress.plan
        self.rejected: Final = self._ingress.rejected
        self._report = StatusReport(self.rejected, self._overload, status_hz(len(fleet.robots)))
        self._route(name, others)

        self.alive_keys: Final[tuple[str, ...]] = (key_expressions.alive(name, robot, "agent"),)
        self._alive_of = {other: key_expressions.alive(name, other, "agent") for other in others}
        self.watched: tuple[str, ...] = ()
        if self._watches_all:
            self.watched = (key_expressions.alive(name, "*", "agent"),)
        self._always = (
            # A stop is taken before a mission: who catches up must not drive first. What robots relay comes
            # on one key, and so in the order in which it is said: there too the stop first.
            key_expressions.stop(name),
            key_expressions.resume(name),
            self._relay.subscription,
            key_expressions.plant_state(name, robot),
            key_expressions.mission(name),
            key_expressions.heartbeat(name),
            key_expressions.ask(name),
            key_expressions.beacon(name, "*"),
            *self._ingress.subscriptions,
        )
        self.subscriptions: tuple[str, ...] = self._always
        self.publications: Final[tuple[str, ...]] = (
            *self._outbox.keys,
            self._key_status,
            self._relay.key,
            *self._ingress.publications,
        )
        self._listened: set[int] = set()
        self._controller.look(0)
        self._listen(0)

    # ------------------------------------------------------------------ in

    def _route(self, name: str, others: list[int]) -> None:
        """Who takes what comes on which key."""
        on, robot = self._ingress.on, self.robot
        for other in others:
            on(self._hand_of[other], HandState, self._peers.accept, robot=other, topic="hand")
            on(key_expressions.beacon(name, other), Beacon, self._accept_beacon, robot=other, topic="beacon")
        on(
            key_expressions.plant_state(name, robot),
            PlantState,
            self._situation.accept_plant,
            robot=robot,
            topic="state",
        )
        on(key_expressions.mission(name), Mission, self._accept_operators_mission)
        on(key_expressions.stop(name), Stop, self._relay.accept)
        on(key_expressions.resume(name), Resume, self._accept_operators_resume)
        for other in others:
            key = key_expressions.relayed(name, other)
            on(key, Mission, self._accept_mission)
            on(key, Stop, self._relay.accept)
            on(key, Resume, self._relay.accept)
        on(key_expressions.heartbeat(name), Heartbeat, self._situation.accept_heartbeat)
        on(key_expressions.ask(name), Ask, self._relay.accept_question)
        on(key_expressions.beacon(name, robot), Beacon, _own)
        for kind in (Mission, Stop, Resume):
            on(self._relay.key, kind, _own)

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes one message off the bus. What is not valid is counted by its reason and changes nothing."""
        said_by = self._said_by.get(key)
        if said_by is not None:
            self._deafness.came(said_by[0], now_ns, hand=said_by[1])
        self._ingress.receive(now_ns, key, payload)

    def present(self, key: str, here: bool) -> None:
        """See `agent.node.Node`: another agent's process came or went."""
        found = key_expressions.robot_of_alive(key)
        if found is not None and found[0] != self.robot:
            self._peers.present(found[0], here)
            if self._event is not None:
                self._event.missed()
            self._deafness.present(found[0], here)

    def deaf_to(self, now_ns: int) -> Sequence[int]:
        """See `agent.node.Node`: robots that others hear. Of what came while the process stood, some comes
        later than the rest. Routers that are short of processor drop messages of some: links to them that
        were opened anew for that would take what they have left."""
        if self._overload.missed_ns(now_ns - NS_PER_S):
            return ()
        if self._is_routed and (not self._overload.idle or self._stood_lately(now_ns)):
            return ()
        return self._deafness.look(now_ns)

    def _stood_lately(self, now_ns: int) -> bool:
        return self._overload.missed_ns(now_ns - LATELY_NS) > STOOD_MOST_NS

    def link_opened_anew(self, now_ns: int, what: str) -> None:
        """See `agent.node.Node`: its status says so for a while."""
        self._report.link_opened_anew(now_ns, what)

    def _damaged(self, key: str, error: Malformed) -> None:
        other = self._hands.get(key)
        if other is not None:
            self._report.corrupted += 1
            if error.reason == "version":
                self._peers.speaks_another_version(other, error.detail)

    def late(self, now_ns: int, late_ns: int) -> None:
        """See `agent.node.Node`: it may want a lower rate, and has not heard what it could not."""
        self._overload.late(now_ns, late_ns)
        # By the time of the tick what comes now would be quicker than it was, and what came meanwhile older.
        self._peers.behind_ns = late_ns % self.period_ns
        self._peers.stood = late_ns >= self.period_ns
        if late_ns >= IN_TIME_NS:
            self._peers.stood_until_ns = now_ns + STOOD_KEPT_NS
        self._stood_until_ns = now_ns + STOOD_NS

    def _accept_beacon(self, beacon: Beacon, now_ns: int) -> str | None:
        if beacon.overload or not self._overload.idle:
            self._overload.heard(beacon.robot, beacon.overload, now_ns, beacon.next_ms * NS_PER_MS)
        self._relay.compare(now_ns, beacon)
        self._deafness.told(beacon)
        reason = self._peers.accept_beacon(beacon, now_ns)
        self._outbox.heard(beacon)
        situation = self._situation
        if not situation.may_go_on and reason is None and beacon.following and situation.mission is not None:
            its_mission = beacon.mission_version, beacon.mission_tag
            situation.may_go_on = its_mission == self._missions.mark
        return reason

    def _accept_operators_mission(self, mission: Mission, now_ns: int) -> str | None:
        reason = self._accept_mission(mission, now_ns)
        if reason is None and self._missions.holds(mission):
            self._situation.may_go_on = True
        return reason

    def _accept_operators_resume(self, resume: Resume, now_ns: int) -> str | None:
        reason = self._relay.accept(resume, now_ns)
        is_for_it = not resume.robots or self.robot in resume.robots
        if reason is None and is_for_it and not self._latch.stopped:
            self._situation.may_go_on = True
        return reason

    def _accept_mission(self, mission: Mission, now_ns: int) -> str | None:
        situation, before = self._situation, self._situation.mission
        if not can_be(mission.version, now_ns):
            return "future"
        if self._missions.is_ours(mission):
            self._relay.heard(now_ns, mission)
        try:
            plan = self._missions.take(mission)
        except MissionRefused as error:
            situation.refused_mission = str(error)
            if error.reason == "digest":
                self._report.digest = (self._missions.digest,)
            return error.reason
        if plan is None:
            return None
        situation.mission, situation.refused_mission = mission, ""
        self._relay.took(mission, now_ns)
        self._controller.plan(plan)
        if before is None or before.epoch_ns != mission.epoch_ns:
            situation.give_back()
            self._ingress.begin(mission.epoch_ns)
            self._outbox.begin(mission.epoch_ns)
        return None

    @property
    def lasting(self) -> tuple[bytes, ...]:
        """See `agent.node.Node`: the last stop and resume, and the mission."""
        return self._lasting.current

    def recall(self, now_ns: int, orders: Sequence[bytes]) -> None:
        """See `agent.node.Node`. What it recalls it relays to who lacks it, and drives by when it may
        (`Situation.may_go_on`)."""
        self._lasting.has_disk()
        for payload in orders:
            order = decode(payload)
            if isinstance(order, Stop | Resume):
                self._relay.recall(order)
            elif isinstance(order, Mission):
                self._accept_mission(order, now_ns)

    def kept(self, orders: tuple[bytes, ...], trouble: str) -> None:
        """See `agent.node.Node`: now it acknowledges them."""
        before = self._lasting.acknowledged
        self._lasting.kept(orders, trouble)
        self._situation.unkept = trouble
        if self._lasting.acknowledged != before:
            self._report.hurry()

    def runs_by(self, clock: MachineClock) -> None:
        """See `agent.node.Node`: its plant goes by the same clock."""
        self._outbox.runs_by(clock)

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
        situation = self._situation
        rests = self._rest_period_ns > 0 and not self._peers.rows.are_told(now_ns)
        if rests is not self._rests or not self._overload.idle:
            self._keep_pace(now_ns, rests=rests)
        if self._stood_until_ns:
            self._tell_how_long_it_stood(now_ns)
        self._peers.begin(now_ns)
        self._ingress.arrive(now_ns)
        self._controller.look(now_ns)
        here = self._find_hand(now_ns)
        self._report.ages_us.extend(self._trust.update(now_ns, self.state, here))
        self._listen(now_ns)
        self._lasting.look(situation.mission)
        was = self.state
        situation.lost_plant(was)
        conditions = situation.conditions(now_ns, was)
        if not (was is State.RUNNING and conditions.all_well):
            self.state, row = step(was, conditions)
            if row is not None:
                self.reason = row.reason(conditions)
                if self.state is not was:
                    self.transition = row.name
        drives = self.state in DRIVING
        if drives and was not in DRIVING:
            self._controller.restart()
        if drives and here is not None:
            out = self._drive(now_ns, here)
        elif here is not None and self.state is State.HOLDING and conditions.hold == self._trust.hold:
            out = self._stand_aside(now_ns, here)
        else:
            out = self._brake(now_ns)
        if self.state is not was or self._report.is_due(now_ns):
            out.append(self._status(now_ns))
        shown, doubt = self._own_hand.shown, self._own_hand.doubt
        if shown is not None:
            obeys, lost_ms = self._own_hand.obeys, self._own_hand.lost_ms
            out += self._outbox.beacon(
                now_ns, shown, doubt, following=self._follows, obeys=obeys, lost_ms=lost_ms
            )
            self._controller.told(now_ns, shown, self._outbox.told_mark)
        self._relay.look(now_ns, situation.plant, situation.unmoved_ns)
        out += self._relay.due(now_ns)
        stopping = situation.ending or self.state in (State.STOPPING, State.STOPPED)
        out += self._ingress.outgoing(now_ns, flush=stopping)
        return out

    def _keep_pace(self, now_ns: int, *, rests: bool) -> None:
        """Decides as often as the slowest machine of the fleet can, and drives as fast as that allows; rarely
        while it `rests`."""
        overload, peers = self._overload, self._peers
        peers.behind_ns, peers.stood = 0, False
        if overload.look(now_ns, drives=self.state in ACTIVE) or rests is not self._rests:
            self._rests = peers.rests = rests
            self.period_ns = period_ns = max(overload.period_ns, self._rest_period_ns * rests)
            self._controller.keep_pace(period_ns, self._speed_share(overload.level))
            self._trust.period_s = period_ns / NS_PER_S
            peers.keep_pace(period_ns)
            self._outbox.keep_pace(period_ns, limits.STANDING_PROMISE_NS * overload.stands)
        self._outbox.overload, self._outbox.others_overload = overload.wanted, overload.others

    def _tell_how_long_it_stood(self, now_ns: int) -> None:
        """What it did not say then has not been lost on its links."""
        if now_ns >= self._stood_until_ns:
            self._stood_until_ns = 0
        self._outbox.stood_ms = self._overload.missed_ns(now_ns - STOOD_NS) // NS_PER_MS

    def _find_hand(self, now_ns: int) -> Hand | None:
        """Where the own hand is; None when the plant does not tell."""
        situation, own = self._situation, self._own_hand
        situation.check_plant(now_ns)
        plant = situation.plant
        if plant is not None and not situation.plant_trouble and not own.measured(now_ns, plant):
            situation.plant_trouble = "plant unhealthy: it tells an impossible place"
        if situation.plant_trouble:
            own.lost(now_ns)
        elif own.here is not None:
            self._ingress.position = own.here.x, own.here.y
        return own.here

    def _listen(self, now_ns: int) -> None:
        """Changes the subscriptions when other robots are to be listened to."""
        if self._trust.changed:
            self._trust.changed = False
            close = self._controller.proximity.close
            wanted = {peer.robot for _, peer in self._controller.edges} | {peer.robot for peer in close}
            self._peers.listen(wanted, now_ns)
            if not self._watches_all:
                for other in self._listened - wanted:  # whether it goes is not seen any more
                    self._peers.present(other, True)
                self.watched = tuple(self._alive_of[other] for other in sorted(wanted))
            self._listened = wanted
            self._deafness.listens(wanted, now_ns)
            self.subscriptions = (*self._always, *(self._hand_of[other] for other in sorted(wanted)))
            if self._event is not None:  # those it listens to listen to it
                self._event.missed()

    def _drive(self, now_ns: int, here: Hand) -> list[Outgoing]:
        controller, situation = self._controller, self._situation
        plant = situation.plant
        assert plant is not None
        try:
            drive = controller.drive(plant, now_ns, self._trust.slower)
        except Error as error:  # of a law of others: it is not asked again
            situation.numbers = str(error)
            return self._brake(now_ns)
        multipliers = controller.coupling.shared()
        if not _can_be_sent(drive, multipliers):
            # Never sent, never hidden: this tick brakes, and the next finds the fault.
            situation.numbers = f"the law gave force {drive.force} N and torque {drive.torque} N m"
            return self._brake(now_ns)
        controller.sent(now_ns, (drive.force, drive.torque))
        if self._event is not None and self._is_mistaken(now_ns):
            self._event.missed()
        self._report.intervened(drive.causes)
        hands = self._outbox.hand(
            now_ns,
            here,
            self._own_hand.doubt,
            following=not situation.is_let_down,
            degree=drive.degree,
            forces=drive.forces,
            multipliers=multipliers,
            own=drive.own,
            obeys=self._own_hand.obeys,
        )
        self._report.sent_hands += len(hands) * len(controller.edges)
        return [self._outbox.wrench(now_ns, drive.force, drive.torque), *hands]

    def _is_mistaken(self, now_ns: int) -> bool:
        """Whether somebody who is near goes by another mission, and so expects other things of this robot."""
        controller = self._controller
        return any(
            peer.mark != controller.mark and peer.is_heard(now_ns)
            for peer in (*(peer for _, peer in controller.edges), *controller.proximity.close)
        )

    def _stand_aside(self, now_ns: int, here: Hand) -> list[Outgoing]:
        """One that holds for others brakes, but gets out of the way of a vehicle that nothing commands."""
        plant = self._situation.plant
        assert plant is not None
        asked = self._controller.evasion(plant, now_ns)
        if asked is None or not max(map(abs, asked)) <= FLOAT_MAX:
            return self._brake(now_ns)
        self._controller.sent(now_ns, asked)
        doubt, obeys = self._own_hand.doubt, self._own_hand.obeys
        hands = self._outbox.hand(now_ns, here, doubt, following=False, obeys=obeys)
        self._report.sent_hands += len(hands) * len(self._controller.edges)
        return [self._outbox.wrench(now_ns, *asked), *hands]

    def _brake(self, now_ns: int) -> list[Outgoing]:
        self._controller.sent(now_ns, None)
        out = [self._outbox.wrench(now_ns, brake=True)]
        shown, doubt = self._own_hand.shown, self._own_hand.doubt
        if shown is not None:
            obeys, lost_ms = self._own_hand.obeys, self._own_hand.lost_ms
            hands = self._outbox.hand(
                now_ns, shown, doubt, following=self._follows, obeys=obeys, lost_ms=lost_ms
            )
            self._report.sent_hands += len(hands) * len(self._controller.edges)
            out += hands
        return out

    @property
    def _follows(self) -> bool:
        """Whether the robot and its body obey the law, or stand ready to from the epoch on."""
        if self.state in DRIVING:
            return not self._situation.is_let_down
        return self.state is State.READY and self._situation.mission is not None and self._situation.may_go_on

    def _status(self, now_ns: int) -> Outgoing:
        lasting = self._lasting
        # One that it would not drive by it has not acknowledged: who drives the fleet says it again.
        mission_version, order_version = lasting.acknowledged
        if not self._situation.may_go_on:
            mission_version = 0
        reason = "; ".join(filter(None, (self.reason, self._report.opened_anew(now_ns))))
        situation = (self.state.value, self.transition, clipped(reason))
        neighbours = [peer for _, peer in self._controller.edges]
        status = self._report.status(
            now_ns,
            self.robot,
            situation,
            mission_version,
            order_version,
            neighbours,
            self._peers.known,
        )
        return self._key_status, encode(status)


def _event_trigger(fleet: Fleet, controller: Controller) -> EventTrigger | None:
    """What says which hand states are sent; None where one is in every tick."""
    control = fleet.control
    if control.send == "periodic":
        return None

    def missed() -> float:
        return max((peer.lateness.missed for _, peer in controller.edges), default=0.0)

    return EventTrigger(
        controller.peers.forecast,
        fleet.period_ns,
        SEND_BOUND_M,
        fleet.hands_within_ns,
        predicts=control.prediction,
        slopes=controller.coupling.slopes,
        missed=missed if fleet.is_large else None,
    )


def _can_be_sent(drive: Drive, multipliers: tuple[tuple[int, float], ...]) -> bool:
    """Whether all its numbers are within what a message may hold, which none is that is not finite."""
    if not (-FLOAT_MAX <= drive.force <= FLOAT_MAX and -FLOAT_MAX <= drive.torque <= FLOAT_MAX):
        return False
    for value in drive.forces:
        if not -FLOAT_MAX <= value <= FLOAT_MAX:
            return False
    for _, value in multipliers:  # noqa: SIM110 (a generator is slower, and this is asked at every tick)
        if not -FLOAT_MAX <= value <= FLOAT_MAX:
            return False
    return True


def _own(message: Mission | Stop | Resume | Beacon, now_ns: int) -> None:
    """What comes back of the robot's own is no news, and no reason to count it."""
