"""A fleet on this machine: one process for each agent and each plant, watched to the end."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Final

from agent import keys
from agent.bus import Bus, Presence
from agent.clock import NS_PER_S, RealClock
from agent.codec import encode
from agent.faults import FaultPlan
from agent.fleet import Fleet
from agent.formation import resolve
from agent.hand import Pose
from agent.messages import Ask, Event, Heartbeat, Message, PlantState
from agent.node import next_tick_ns
from agent.order_sections import OrderSection
from agent.orders import OrderError
from deploy.author import author
from deploy.interrupt import Interrupt
from deploy.live import View, Watch, fleet_time_s
from deploy.operating import HEARTBEAT_PERIOD_NS, Operator, Order, refused
from deploy.placing import Vehicle
from deploy.process_faults import WORDS, Action, actions
from deploy.processes import Processes
from deploy.readiness import in_words, is_ready, stands, waits
from deploy.registry import Registration
from deploy.runfolder import RunFolder
from deploy.vehicle_checks import VehicleChecks

POLL_S: Final = 0.04
SHOW_PERIOD_NS: Final = NS_PER_S // 4
AGAIN_PERIOD_NS: Final = NS_PER_S // 2
"""How often something is said again that a process has not heard."""
ORDER_LATE_NS: Final = NS_PER_S // 2
"""An order of the fleet file counts as given at its time, as in a simulation, unless that is so long ago."""
EPOCH_AHEAD_NS: Final = NS_PER_S // 2
"""The mission is out this long before the epoch: every agent has it by then."""
READY_TIMEOUT_S: Final = 10.0
READY_TIMEOUT_PER_CHILD_S: Final = 0.5
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
END_TIMEOUT_S: Final = 0.4
VEHICLES_END_TIMEOUT_S: Final = 2.0
"""A bridge that is just opening its connection takes longer to let go of it."""
RECORDER_INBOX: Final = 65_536


class LocalRun:
    """One run: starts the processes of `fleet` (resolved and placed, with these simulated rovers), drives it
    and ends it.

    After `run`, `reasons` holds what went wrong in the operator's eyes, as sentences for the verdict.
    """

    def __init__(
        self,
        fleet: Fleet,
        folder: RunFolder,
        view: View,
        interrupt: Interrupt,
        vehicles: Sequence[Vehicle] = (),
    ) -> None:
        self._fleet, self._folder, self._view, self._interrupt = fleet, folder, view, interrupt
        self._clock = RealClock()
        geometry = resolve(fleet)
        self._watch = Watch(fleet, geometry)
        self._operator = Operator(fleet, geometry)
        self._vehicles = vehicles
        self._processes = Processes(fleet, folder.fleet_file, folder.log, vehicles)
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
        self._show_due_ns = self._heartbeat_due_ns = 0
        self._author = author()
        self.reasons: list[str] = []

    def run(self) -> None:
        """From start to end; whatever happens, no process is left.

        Raises:
            agent.bus.BusError: the operator's session cannot be opened.
            deploy.recorder.RecordingError: the recording cannot be written (the fleet is stopped first).
        """
        endpoints = [
            endpoint
            for robot in self._fleet.ids
            for endpoint in (self._fleet.agent_endpoint(robot), self._fleet.plant_endpoint(robot))
        ]
        try:
            self._start()
            with (
                Registration(self._fleet.fleet.name, self._folder.path, self._folder.fleet_file),
                Bus(listen=[], connect=endpoints) as bus,
            ):
                self._operate(bus)
        finally:
            timeout_s = VEHICLES_END_TIMEOUT_S if self._checks.robots else END_TIMEOUT_S
            for child in self._processes.end(timeout_s):
                self._view.say(f"{child.name} did not end when asked and was killed")

    def _start(self) -> None:
        count = len(self._fleet.robots)
        self._view.say(
            f"starting {count} agents and {count} plants on ports {self._fleet.network.base_port} to "
            f"{self._fleet.network.base_port + 2 * count - 1}"
        )
        self._processes.start()
        for vehicle in self._vehicles:
            self._view.say(str(vehicle))

    def _operate(self, bus: Bus) -> None:
        name = self._fleet.fleet.name
        for key in self._operator.keys.values():
            bus.declare(key)
        bus.subscribe(keys.everything(name), RECORDER_INBOX)
        presence = bus.watch(keys.alive(name, "*", "*"))
        try:
            if self._wait_until_ready(bus, presence):
                self._drive(bus)
        finally:
            self._stop(bus)

    # ------------------------------------------------------------------ phases

    def _wait_until_ready(self, bus: Bus, presence: Presence) -> bool:
        expected = {
            keys.alive(self._fleet.fleet.name, *process): name
            for process, name in self._processes.names.items()
        }
        begun = time.monotonic()
        timeout_s = READY_TIMEOUT_S + READY_TIMEOUT_PER_CHILD_S * len(expected)
        timeout_s = max(timeout_s, VEHICLES_TIMEOUT_S if self._checks.robots else 0.0)
        alive = False
        say_due_s = WAITS_PERIOD_S
        while self._step(bus):
            presence.update()
            missing = [name for key, name in expected.items() if key not in presence.alive]
            waited_s = time.monotonic() - begun
            if not missing and not alive:
                alive = True
                self._view.say(f"all {len(expected)} processes alive after {waited_s:.2f} s")
            now_ns = self._clock.now_ns()
            refusals = self._checks.refusals(now_ns)
            if refusals:
                self._fail(f"Not started: {'; '.join(refusals)}.")
                return False
            ready = all(map(is_ready, self._watch.states().values()))
            if alive and ready and self._checks.complete(now_ns):
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

    def _waits(self, missing: Sequence[str]) -> str:
        """What keeps the fleet from starting."""
        if missing:
            return ", ".join(missing)
        found = waits(self._fleet.ids, self._watch.statuses, self._states)
        return in_words(found) if found else in_words(self._checks.waits())

    def _drive(self, bus: Bus) -> None:
        period_ns = self._fleet.period_ns
        duration_ns = round(self._fleet.fleet.duration_s * NS_PER_S)
        now_ns = self._clock.now_ns()
        self._epoch_ns = next_tick_ns(now_ns + EPOCH_AHEAD_NS, period_ns, 0)
        self._plan(bus)
        self._say(bus, self._operator.begin(now_ns, self._epoch_ns, duration_ns))
        end_ns = self._epoch_ns + duration_ns
        due_ns, ask_due_ns = now_ns + AGAIN_PERIOD_NS, now_ns
        while (now_ns := self._clock.now_ns()) < end_ns:
            if now_ns >= due_ns:
                # Said again until all have it: a process that starts again needs it too.
                due_ns = now_ns + AGAIN_PERIOD_NS
                for message in self._operator.wanted(self._watch.statuses, self._states, self._processes.up):
                    self._say(bus, message)
            if self._operator.behind and now_ns >= ask_due_ns:
                # Another operator has given an order: its own messages do not come here, agents tell it.
                ask_due_ns = now_ns + AGAIN_PERIOD_NS
                self._say(bus, Ask(now_ns, self._author))
            if not self._step(bus):
                return
        self._show()  # how it ended, whenever the last look was

    def _plan(self, bus: Bus) -> None:
        """Notes what is to be done at which time; of one time, what rules do comes first."""
        rules = FaultPlan(self._fleet).file_rules()
        todo: list[tuple[float, Callable[[], None]]] = [
            (action.time_s, partial(self._carry_out, action))
            for action in actions(rules, self._fleet.ids, self._fleet.fleet.duration_s)
        ]
        todo += [(order.at, partial(self._give, bus, order)) for order in self._fleet.orders]
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
        timeout_s = INTERRUPT_STOP_TIMEOUT_S if hurried else STOP_TIMEOUT_S
        if self._checks.robots:
            timeout_s = VEHICLES_STOP_TIMEOUT_S
        why = "interrupted" if hurried else "; ".join(self.reasons) or "the run is over"
        stop = self._operator.order_stop(self._clock.now_ns(), why)
        self._say(bus, stop)
        begun = time.monotonic()
        again = begun + STOP_AGAIN_S
        waiting = [
            robot for robot in self._fleet.ids if all(self._processes.up(robot, role) for role in keys.ROLES)
        ]
        while (now := time.monotonic()) < begun + timeout_s and self._interrupt.count < 2:
            self._collect(bus)
            statuses = self._watch.statuses
            if all(stands(statuses.get(robot), self._states.get(robot)) for robot in waiting):
                break
            if now >= again:
                again = now + STOP_AGAIN_S
                if any(r not in statuses or statuses[r].order_version < stop.version for r in waiting):
                    self._say(bus, stop)
            time.sleep(POLL_S / 2)
        self._collect(bus)

    # ------------------------------------------------------------------ every step

    def _step(self, bus: Bus) -> bool:
        """Waits a moment, takes what came, does what rules order; False when the run has to end."""
        time.sleep(min(POLL_S, max(0.0, self._until_next_s())))
        self._collect(bus)
        for sentence in self._watch.news(fleet_time_s(self._clock.now_ns(), self._epoch_ns)):
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

    def _show(self) -> None:
        self._view.show(self._watch.picture(fleet_time_s(self._clock.now_ns(), self._epoch_ns)))

    def _collect(self, bus: Bus) -> None:
        now_ns = self._clock.now_ns()
        for key, payload in bus.drain():
            message = self._folder.record(now_ns, key, payload)
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
        self._folder.record(now_ns, keys.events(self._fleet.fleet.name), encode(event))
        at = fleet_time_s(now_ns, self._epoch_ns)
        name = self._processes.names[robot, role]
        self._view.say(f"{at:.1f} s: rule {action.rule!r} {WORDS[action.what]} {name}")

    def _fail(self, reason: str) -> None:
        self.reasons.append(reason)
        self._view.say(reason)
