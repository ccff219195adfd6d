"""Drives a fleet whose processes are up to the end: what `handfast run` and `handfast drive` share."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Final

from agent import keys
from agent.bus import Bus
from agent.clock import NS_PER_S, RealClock
from agent.codec import encode
from agent.faults import FaultPlan
from agent.fleet import Fleet
from agent.formation import resolve
from agent.hand import Pose
from agent.messages import Ask, Event, Heartbeat, Message, PlantState, Status, Stop
from agent.node import next_tick_ns
from agent.order_sections import OrderSection
from agent.orders import OrderError
from agent.supervision import State
from deploy.author import author
from deploy.before_drive import OVER, clock, refusal, stop_in_force
from deploy.fleet_processes import FleetProcesses
from deploy.interrupt import Interrupt
from deploy.live import View, Watch, fleet_time_s
from deploy.operating import HEARTBEAT_PERIOD_NS, Operator, Order, refused
from deploy.process_faults import WORDS, Action, Process, actions
from deploy.readiness import in_words, is_ready, stands, waits
from deploy.stopping import has_heard
from deploy.vehicle_checks import VehicleChecks
from deploy.wording import robots

POLL_S: Final = 0.04
SHOW_PERIOD_NS: Final = NS_PER_S // 4
AGAIN_PERIOD_NS: Final = NS_PER_S // 2
"""How often something is said again that a process has not heard."""
ORDER_LATE_NS: Final = NS_PER_S // 2
"""An order of the fleet file counts as given at its time, as in a simulation, unless that is so long ago."""
EPOCH_AHEAD_NS: Final = NS_PER_S // 2
"""The mission is out this long before the epoch: every agent has it by then."""
STOPPED_AHEAD_NS: Final = 2 * NS_PER_S
"""Likewise for a fleet that stands after a stop: leave to drive comes when all have the mission."""
READY_TIMEOUT_S: Final = 10.0
READY_TIMEOUT_PER_PROCESS_S: Final = 0.5
VEHICLES_TIMEOUT_S: Final = 120.0
"""So long for vehicles: one that was just switched on takes 40 s, and its operator has to arm it."""
WAITS_PERIOD_S: Final = 5.0
"""How often it is said what is waited for."""
STOP_AGAIN_S: Final = 0.25
"""A status comes five times a second: who has not told of a stop by then may not have heard it."""
STOP_TIMEOUT_S: Final = 2.0
INTERRUPT_STOP_TIMEOUT_S: Final = 0.3
VEHICLES_STOP_TIMEOUT_S: Final = 4.0
"""A rover takes seconds to rest: its bridge stays for that, also after Ctrl-C; a second Ctrl-C ends it."""
RECORDER_INBOX: Final = 65_536
HAND_OVER_NS: Final = 2 * NS_PER_S
"""So long after the epoch all must have said that they know what to drive, if they are to be left alone."""

Record = Callable[[int, str, bytes], Message | None]
"""Takes what came: time of reception (ns), key, payload; gives the message, None when it is none."""


class Drive:
    """One drive of `fleet` (resolved, as its robots read it).

    Args:
        processes: those of the fleet.
        record: keeps what comes.
        duration_s, orders: what is driven; the fleet file's unless given.
        resume: whether a stop that somebody else gave is to be lifted; one that the regular end of a drive
            gave always is.

    After `run`, `reasons` holds what went wrong in the operator's eyes, as sentences for the verdict.
    """

    def __init__(
        self,
        fleet: Fleet,
        processes: FleetProcesses,
        record: Record,
        view: View,
        interrupt: Interrupt,
        *,
        duration_s: float | None = None,
        orders: Sequence[OrderSection] | None = None,
        resume: bool = False,
    ) -> None:
        self._fleet, self._processes, self._record = fleet, processes, record
        self._view, self._interrupt = view, interrupt
        self._duration_s = fleet.fleet.duration_s if duration_s is None else duration_s
        self._orders = fleet.orders if orders is None else orders
        self._resume = resume
        self._clock = RealClock()
        geometry = resolve(fleet)
        self._watch = Watch(fleet, geometry)
        self._operator = Operator(fleet, geometry)
        self._checks = VehicleChecks(fleet)
        self._states: dict[int, PlantState] = {}
        """The latest state of each plant that is up."""
        self._truths: dict[int, PlantState] = {}
        """Where each simulated body really was last, for those that measure with noise."""
        self._todo: list[tuple[float, Callable[[], None]]] = []
        """What rules will do to processes and what the fleet file orders, with its fleet time (s), the next
        one last."""
        self._events = 0
        self._epoch_ns: int | None = None
        self._refused: dict[int, int] = {}
        """How many missions for other fleet files each agent had refused before this one was given."""
        self._present: set[Process] = set()
        self._show_due_ns = self._heartbeat_due_ns = self._ask_due_ns = self._again_due_ns = 0
        self._author = author()
        self._is_over = self._is_left = False
        self.reasons: list[str] = []

    def run(self, bus: Bus, *, detach: bool = False) -> None:
        """From the wait for the fleet to its standstill, or, with `detach`, until all know what to drive.

        Args:
            bus: connected to all processes of the fleet.

        Raises:
            deploy.recorder.RecordingError: the recording cannot be written (the fleet is stopped first).
        """
        name = self._fleet.fleet.name
        for key in self._operator.keys.values():
            bus.declare(key)
        bus.subscribe(keys.everything(name), RECORDER_INBOX)
        self._presence = bus.watch(keys.alive(name, "*", "*"))
        try:
            if self._wait_until_ready(bus) and self._begin(bus):
                if detach:
                    self._is_left = self._hand_over(bus)
                else:
                    self._drive(bus)
        finally:
            begun = self._processes.ours or self._epoch_ns is not None
            if begun and not self._is_left:
                self._stop(bus)

    @property
    def end_ns(self) -> int:
        """When the mission ends (wall clock); 0 when none was given."""
        return 0 if self._epoch_ns is None else self._epoch_ns + round(self._duration_s * NS_PER_S)

    # ------------------------------------------------------------------ phases

    def _wait_until_ready(self, bus: Bus) -> bool:
        names = self._processes.names
        begun = time.monotonic()
        timeout_s = READY_TIMEOUT_S + READY_TIMEOUT_PER_PROCESS_S * len(names)
        timeout_s = max(timeout_s, VEHICLES_TIMEOUT_S if self._checks.robots else 0.0)
        alive = False
        say_due_s = WAITS_PERIOD_S
        while self._step(bus):
            missing = [name for process, name in names.items() if process not in self._present]
            waited_s = time.monotonic() - begun
            if not missing and not alive:
                alive = True
                self._view.say(f"all {len(names)} processes alive after {waited_s:.2f} s")
            self._ask(bus)
            now_ns = self._clock.now_ns()
            refusals = self._checks.refusals(now_ns)
            if refusals:
                self._fail(f"Not started: {'; '.join(refusals)}.")
                return False
            if alive and self._is_ready and self._checks.complete(now_ns):
                for warning in self._checks.warnings():
                    self._view.say(f"warning: {warning}")
                return True
            if waited_s > timeout_s:
                self._fail(f"Not ready within {timeout_s:.0f} s: {self._waits(missing)}.")
                return False
            if waited_s >= say_due_s:
                say_due_s += WAITS_PERIOD_S
                self._view.say(f"waiting after {waited_s:.0f} s: {self._waits(missing)}")
        return False

    @property
    def _is_ready(self) -> bool:
        states = self._watch.states().values()
        if self._processes.ours:
            return all(map(is_ready, states))
        # Those that drove before stand: a new mission, and leave to drive, make them ready.
        return all(is_ready(state) or state == State.STOPPED.value for state in states) and (
            not self._operator.behind or self._operator.foreign is not None
        )

    def _waits(self, missing: Sequence[str]) -> str:
        """What keeps the fleet from starting."""
        if missing:
            return ", ".join(missing)
        found = waits(self._fleet.ids, self._watch.statuses, self._states)
        if not found and self._operator.behind:
            return "nobody tells what was ordered last"
        return in_words(found) if found else in_words(self._checks.waits())

    def _begin(self, bus: Bus) -> bool:
        """Gives the mission, and leave to drive to robots that were stopped; False when that cannot be."""
        now_ns, stop = self._clock.now_ns(), None
        if not self._processes.ours:
            why = refusal(self._operator, now_ns, resume=self._resume)
            if why:
                self._fail(f"Not started: {why}.")
                return False
            stop = stop_in_force(self._operator)
        ahead_ns = EPOCH_AHEAD_NS if stop is None else STOPPED_AHEAD_NS
        epoch_ns = self._epoch_ns = next_tick_ns(now_ns + ahead_ns, self._fleet.period_ns, 0)
        self._plan(bus)
        self._refused = {robot: _refusals(status) for robot, status in self._watch.statuses.items()}
        self._again_due_ns, self._ask_due_ns = now_ns + AGAIN_PERIOD_NS, now_ns
        self._say(bus, self._operator.begin(now_ns, epoch_ns, round(self._duration_s * NS_PER_S)))
        return stop is None or self._lift(bus, stop, epoch_ns - EPOCH_AHEAD_NS)

    def _lift(self, bus: Bus, stop: Stop, by_ns: int) -> bool:
        """Gives leave to drive as soon as all know the new mission: nobody may go on with one before it."""
        while self._ignorant:
            if not self._go_on(bus):
                return False
            if self._clock.now_ns() >= by_ns:
                self._fail(f"Not started: {robots(self._ignorant)} did not take the mission.")
                return False
        newest = stop_in_force(self._operator)
        if newest is None or newest.version != stop.version:
            self._fail("Not started: another operator said stop or resume meanwhile.")
            return False
        if stop.reason != OVER:
            why = f": {stop.reason}" if stop.reason else ""
            self._view.say(f"lifting the stop that was given at {clock(stop.time_ns)}{why}")
        self._say(bus, self._operator.order_resume(self._clock.now_ns(), ()))
        return True

    def _hand_over(self, bus: Bus) -> bool:
        """Waits until all know what to drive, and leaves them to it; False when not all do."""
        while late := self._ignorant or self._slow:
            if not self._go_on(bus):
                return False
            if self._clock.now_ns() >= (self._epoch_ns or 0) + HAND_OVER_NS:
                self._fail(f"Not left to drive alone: {robots(late)} did not take the mission.")
                return False
        return True

    @property
    def _ignorant(self) -> list[int]:
        """Robots of whose agent or plant it is not known that it has the mission."""
        version, statuses = self._operator.mission_version, self._watch.statuses
        return [
            robot
            for robot in self._fleet.ids
            if robot not in statuses
            or statuses[robot].mission_version < version
            or not self._operator.counts(self._states.get(robot))
        ]

    @property
    def _slow(self) -> list[int]:
        """Robots whose agents have not said that they know the last stop or leave."""
        version = self._operator.order_version
        return [robot for robot, each in self._watch.statuses.items() if each.order_version < version]

    def _drive(self, bus: Bus) -> None:
        while self._clock.now_ns() < self.end_ns:
            if not self._go_on(bus):
                return
        self._show()  # how it ended, whenever the last look was
        self._is_over = True
        for sentence in self._processes.lacking():
            self._fail(sentence)

    def _go_on(self, bus: Bus) -> bool:
        """A step of a fleet that was given its mission: tells who lacks something; False when it ends."""
        now_ns = self._clock.now_ns()
        if now_ns >= self._again_due_ns:
            # Said again until all have it: a process that starts again needs it too.
            self._again_due_ns = now_ns + AGAIN_PERIOD_NS
            for message in self._operator.wanted(self._watch.statuses, self._states, self._processes.up):
                self._say(bus, message)
        self._ask(bus)
        return self._step(bus) and not self._is_refused() and not self._is_overtaken()

    def _ask(self, bus: Bus) -> None:
        """Asks for what was ordered and not heard: other operators' messages need not come here, agents tell
        them."""
        now_ns = self._clock.now_ns()
        if self._operator.behind and now_ns >= self._ask_due_ns:
            self._ask_due_ns = now_ns + AGAIN_PERIOD_NS
            self._say(bus, Ask(now_ns, self._author))

    def _is_refused(self) -> bool:
        """Whether an agent has refused the mission because it reads another fleet file."""
        version = self._operator.mission_version
        strangers = [
            robot
            for robot, status in self._watch.statuses.items()
            if status.mission_version < version and _refusals(status) > self._refused.get(robot, 0)
        ]
        if strangers:
            self._fail(f"Not driven: this is not the fleet file that is read by {robots(strangers)}.")
        return bool(strangers)

    def _is_overtaken(self) -> bool:
        """Whether another operator has begun another drive, which those that were up before go on with."""
        mission = self._operator.mission
        if self._processes.ours or mission is None or mission.epoch_ns == self._epoch_ns:
            return False
        self._is_left = True
        self._fail("Another operator has begun another drive, and the robots drive that.")
        return True

    def _plan(self, bus: Bus) -> None:
        """Notes what is to be done at which time; of one time, what rules do comes first."""
        rules = FaultPlan(self._fleet).file_rules()
        todo: list[tuple[float, Callable[[], None]]] = [
            (action.time_s, partial(self._carry_out, action))
            for action in actions(rules, self._fleet.ids, self._duration_s)
        ]
        todo += [(order.at, partial(self._give, bus, order)) for order in self._orders]
        self._todo = sorted(todo, key=itemgetter(0))[::-1]

    def _give(self, bus: Bus, order: OrderSection) -> None:
        """Carries out an order of the fleet file; one that cannot be is a reason for the verdict."""
        assert self._epoch_ns is not None
        now_ns, due_ns = self._clock.now_ns(), self._epoch_ns + round(order.at * NS_PER_S)
        try:
            given_ns = due_ns if now_ns - due_ns < ORDER_LATE_NS else now_ns
            self._say(bus, self._operator.give(order, given_ns))
        except OrderError as error:
            self._fail(refused(order, error))

    def _say(self, bus: Bus, message: Order | Heartbeat | Ask) -> None:
        bus.publish(*self._operator.outgoing(message))

    def _stop(self, bus: Bus) -> None:
        """Brings every robot to a standstill, or gives up after a while."""
        self._processes.resume_all()
        hurried = self._interrupt.count > 0
        if hurried:
            self._view.say(f"{signal.Signals(self._interrupt.number).name}: stopping every robot")
        ours = self._processes.ours
        timeout_s = INTERRUPT_STOP_TIMEOUT_S if hurried and ours else STOP_TIMEOUT_S
        if self._checks.robots:
            timeout_s = VEHICLES_STOP_TIMEOUT_S
        stop = self._operator.order_stop(self._clock.now_ns(), self._why_stop(hurried))
        self._say(bus, stop)
        begun = time.monotonic()
        again = begun + STOP_AGAIN_S
        waiting = [
            robot for robot in self._fleet.ids if all(self._processes.up(robot, role) for role in keys.ROLES)
        ]
        while (now := time.monotonic()) < begun + timeout_s and self._interrupt.count < 2:
            self._collect(bus)
            statuses = self._watch.statuses
            rest = all(stands(statuses.get(robot), self._states.get(robot)) for robot in waiting)
            # Those that end now will not drive again; others must have latched the stop.
            if rest and (ours or all(has_heard(statuses.get(robot), stop) for robot in waiting)):
                break
            if now >= again:
                again = now + STOP_AGAIN_S
                if any(r not in statuses or statuses[r].order_version < stop.version for r in waiting):
                    self._say(bus, stop)
            time.sleep(POLL_S / 2)
        self._collect(bus)
        deaf = [robot for robot in self._fleet.ids if not has_heard(self._watch.statuses.get(robot), stop)]
        if deaf and not ours:
            self._fail(f"Not heard to stop: {robots(deaf)}.")

    def _why_stop(self, hurried: bool) -> str:
        """The reason of the stop at the end, by which the next drive knows whether it may lift it."""
        if hurried:
            return "interrupted"
        if not self._is_over:
            return "; ".join(self.reasons) or OVER
        # One that somebody said during the drive, and nobody lifted, holds beyond it.
        standing = stop_in_force(self._operator)
        return OVER if standing is None else standing.reason

    # ------------------------------------------------------------------ every step

    def _step(self, bus: Bus) -> bool:
        """Waits a moment, takes what came, does what rules order; False when the run has to end."""
        time.sleep(min(POLL_S, max(0.0, self._until_next_s())))
        self._collect(bus)
        at_s = fleet_time_s(self._clock.now_ns(), self._epoch_ns)
        news = self._watch.news(at_s)
        if self._epoch_ns is None and not self._processes.ours:
            news = []  # of what was ordered and done before this drive, as agents tell it now
        for sentence in [*news, *self._look(at_s)]:
            self._view.say(sentence)
        while self._until_next_s() <= 0.0:
            _, do = self._todo.pop()
            do()
            self._collect(bus)
        now_ns = self._clock.now_ns()
        if self._beats and now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + HEARTBEAT_PERIOD_NS
            self._say(bus, Heartbeat(now_ns, self._author))
        if now_ns >= self._show_due_ns:
            self._show_due_ns = now_ns + SHOW_PERIOD_NS
            self._show()
        return not self._interrupt.count and not self._deaths()

    def _look(self, at_s: float | None) -> list[str]:
        """What is to be said of processes that came or went."""
        for key, here in self._presence.update():
            process = keys.robot_of_alive(key)
            if process is not None:
                (self._present.add if here else self._present.discard)(process)
                if not here and not self._processes.ours and process[1] == "agent":
                    self._watch.forget(process[0])
        return self._processes.look(self._present, at_s)

    def _show(self) -> None:
        self._view.show(self._watch.picture(fleet_time_s(self._clock.now_ns(), self._epoch_ns)))

    def _collect(self, bus: Bus) -> None:
        now_ns = self._clock.now_ns()
        for key, payload in bus.drain():
            message = self._record(now_ns, key, payload)
            if message is not None:
                self._watch.feed(key, message)
                self._operator.hear(key, message)
                self._checks.feed(now_ns, key, message)
                self._locate(key, message)

    def _locate(self, key: str, message: Message) -> None:
        if type(message) is PlantState:
            name, robot = self._fleet.fleet.name, message.robot
            if key == keys.plant_state(name, robot):
                self._states[robot] = message
            elif key == keys.plant_truth(name, robot):
                self._truths[robot] = message

    def _deaths(self) -> bool:
        """Reports every child that has ended of its own; True when there was one."""
        deaths = self._processes.deaths()
        for child, how in deaths:
            at = fleet_time_s(self._clock.now_ns(), self._epoch_ns)
            when = "before the start" if at is None or at < 0 else f"at {at:.1f} s"
            self._fail(f"{child.name.capitalize()} ended {when} ({how}).")
            for line in child.last_lines():
                self._view.say(f"    {line}")
        return bool(deaths)

    # ------------------------------------------------------------------ what rules do to processes

    @property
    def _beats(self) -> bool:
        """Whether robots need this operator's heartbeat."""
        return self._fleet.supervision.deadman_s is not None

    def _until_next_s(self) -> float:
        """Time until something is to be done, s."""
        if not self._todo or self._epoch_ns is None:
            return float("inf")
        return self._todo[-1][0] - (self._clock.now_ns() - self._epoch_ns) / NS_PER_S

    def _carry_out(self, action: Action) -> None:
        robot, role = action.robot, action.role
        seen = self._truths.get(robot) or self._states.get(robot)
        if not self._processes.carry_out(action, None if seen is None else Pose._make(seen[3:8])):
            return  # it has died of its own, which ends the run
        now_ns = self._clock.now_ns()
        if action.what == "start" and role == "plant":
            self._states.pop(robot, None)
        event = Event(robot, self._events, now_ns, role, action.what, action.rule)
        self._events += 1
        self._record(now_ns, keys.events(self._fleet.fleet.name), encode(event))
        at = fleet_time_s(now_ns, self._epoch_ns)
        name = self._processes.names[robot, role]
        self._view.say(f"{at:.1f} s: rule {action.rule!r} {WORDS[action.what]} {name}")

    def _fail(self, reason: str) -> None:
        self.reasons.append(reason)
        self._view.say(reason)


def _refusals(status: Status) -> int:
    """How many missions an agent has refused because they are for another fleet file."""
    return dict(status.counters).get("rejected.digest", 0)
