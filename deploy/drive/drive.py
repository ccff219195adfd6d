"""Drives a fleet whose processes are up to the end: what `handfast run` and `handfast drive` share."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from operator import itemgetter
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.ticks import next_tick_ns
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Event, Heartbeat, Stop
from handfast.agent.transport.bus import Bus
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.wording import robots, some
from handfast.deploy.drive.display.live_view import View
from handfast.deploy.drive.fleet_state import FleetState, Record
from handfast.deploy.drive.preconditions import BROKEN_OFF, OVER, Timing, clock, is_lifted, refusal, why
from handfast.deploy.drive.standstill import Standstill
from handfast.deploy.faults.process_actions import WORDS, Action, actions
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.orders.operator import HEARTBEAT_PERIOD_NS, refused
from handfast.deploy.processes.child import Ended, FleetProcesses
from handfast.deploy.session.stop import Way

POLL_S: Final = 0.04
DEATHS_PERIOD_NS: Final = NS_PER_S // 10
"""How often is looked for processes that have ended: each is asked for."""
DEATHS_MAX: Final = 3
"""So many that ended in one way are told one by one."""
SHOW_PERIOD_NS: Final = NS_PER_S // 4
STOOD_NS: Final = NS_PER_S
FRESH_NS: Final = NS_PER_S // 2
"""A drive that has stood for longer than the first shows nothing for the second: statuses come five times a
second."""
SHOW_FIRST_NS: Final = NS_PER_S // 10
"""So long after a mission's begin all have told that they drive."""
ORDER_LATE_NS: Final = NS_PER_S // 2
"""An order of the fleet file counts as given at its time, as in a simulation, unless that is so long ago."""


class Drive:
    """One drive of `fleet` (resolved, as its robots read it).

    Args:
        processes: those of the fleet.
        bus: connected to all of them.
        record: keeps what comes.
        duration_s, orders: what is driven; the fleet file's unless given.
        resume: whether a stop that somebody else gave is to be lifted; one that the regular end of a drive
            gave always is.
        given_ns: when somebody gave the drive (wall clock), now unless given: it lifts no stop since.
        timing: how long is waited for what.
        ways: makes the ways by which robots are stopped, besides the links that there are, after Ctrl-C or
            when they do not answer.

    After `run`, `reasons` holds what went wrong in the operator's eyes, as sentences for the verdict, and
    `warnings` what fails nothing, as such without their ends.
    """

    def __init__(
        self,
        fleet: Fleet,
        processes: FleetProcesses,
        bus: Bus,
        record: Record,
        view: View,
        interrupt: Interrupt,
        *,
        duration_s: float | None = None,
        orders: Sequence[OrderSection] | None = None,
        resume: bool = False,
        given_ns: int | None = None,
        timing: Timing | None = None,
        ways: Callable[[], Sequence[Way]] = tuple,
    ) -> None:
        self._fleet, self._processes, self._view, self._interrupt = fleet, processes, view, interrupt
        self._duration_s = fleet.fleet.duration_s if duration_s is None else duration_s
        self._orders = fleet.orders if orders is None else orders
        self._resume = resume
        self._given_ns = time.time_ns() if given_ns is None else given_ns
        self._timing, self._ways = timing or Timing(), ways
        self._fleet_state = FleetState(fleet, bus, processes, record)
        self._watch, self._operator = self._fleet_state.watch, self._fleet_state.operator
        self._clock, self._checks = self._fleet_state.clock, self._fleet_state.checks
        self._stepped_ns, self._has_stood = self._clock.now_ns(), False
        self._todo: list[tuple[float, Callable[[], None]]] = []
        """What rules will do to processes and what the fleet file orders, with its fleet time (s), the next
        one last."""
        self._events = 0
        self._show_due_ns = self._heartbeat_due_ns = self._deaths_due_ns = 0
        self._is_over = self._is_left = False
        self.reasons: list[str] = []
        self.warnings: list[str] = []

    def run(self, *, detach: bool = False) -> None:
        """Drives the fleet, from the wait until it is ready to standstill.

        With `detach` only until all have acknowledged the mission.

        Raises:
            handfast.deploy.recording.run_files.RecordingError: the recording cannot be written (the fleet is
            stopped first).
        """
        try:
            if self._wait_until_ready() and self._begin():
                if detach:
                    self._is_left = self._hand_over()
                else:
                    self._drive()
        finally:
            begun = self._processes.ours or self._fleet_state.epoch_ns is not None
            if begun and not self._is_left:
                self._stop()

    @property
    def end_ns(self) -> int:
        """When the mission ends (wall clock); 0 when none was given."""
        epoch_ns = self._fleet_state.epoch_ns
        return 0 if epoch_ns is None else epoch_ns + round(self._duration_s * NS_PER_S)

    @property
    def is_left(self) -> bool:
        """Whether robots drive on although this has ended."""
        return self._is_left

    @property
    def is_behind(self) -> bool:
        """Whether not all that came has been recorded: there was no time for it."""
        return self._fleet_state.is_behind

    def take_rest(self) -> None:
        """Takes all that waits still, of processes that have ended meanwhile.

        Raises:
            handfast.deploy.recording.run_files.RecordingError: the recording cannot be written.
        """
        self._fleet_state.collect(inf)

    # ------------------------------------------------------------------ phases

    def _wait_until_ready(self) -> bool:
        fleet_state, names = self._fleet_state, self._processes.names
        begun = time.monotonic()
        timeout_s = self._timing.ready_timeout_s(len(names), has_vehicles=bool(self._checks.robots))
        alive = False
        say_due_s = self._timing.waits_period_s
        while self._step():
            missing = [name for process, name in names.items() if process not in fleet_state.present]
            waited_s = time.monotonic() - begun
            if not missing and not alive:
                alive = True
                alive_s = time.monotonic() - self._processes.begun_s
                self._view.say(f"all {self._processes.count} processes alive after {alive_s:.2f} s")
            fleet_state.ask()
            now_ns = self._clock.now_ns()
            refusals = self._checks.refusals(now_ns)
            if refusals:
                self._fail(f"Not started: {'; '.join(refusals)}.")
                return False
            if alive and fleet_state.is_ready and self._checks.complete(now_ns):
                for warning in self._checks.warnings():
                    self._view.say(f"warning: {warning}")
                return True
            if waited_s > timeout_s:
                self._fail(f"Not ready within {timeout_s:.0f} s: {fleet_state.waits(missing)}.")
                return False
            if waited_s >= say_due_s:
                say_due_s += self._timing.waits_period_s
                self._view.say(f"waiting after {waited_s:.0f} s: {fleet_state.waits(missing)}")
        return False

    def _begin(self) -> bool:
        """Gives the mission, and resumes robots that were stopped; False when that cannot be."""
        now_ns, stop = self._clock.now_ns(), None
        if not self._processes.ours:
            obstacle = refusal(self._operator, now_ns, resume=self._resume, given_ns=self._given_ns)
            if obstacle:
                self._fail(f"Not started: {obstacle}.")
                return False
            stop = self._operator.stop_in_force
        ahead_ns = self._timing.epoch_ahead_ns if stop is None else self._timing.stopped_ahead_ns
        epoch_ns = next_tick_ns(now_ns + ahead_ns, self._fleet.period_ns, 0)
        self._plan(epoch_ns)
        self._fleet_state.begin(epoch_ns, round(self._duration_s * NS_PER_S))
        return stop is None or self._lift(stop, epoch_ns - self._timing.epoch_ahead_ns)

    def _lift(self, stop: Stop, by_ns: int) -> bool:
        """Resumes as soon as all have acknowledged the new mission: nobody may go on with one before it."""
        while late := self._fleet_state.without_mission:
            if not self._go_on():
                return False
            if self._clock.now_ns() >= by_ns:
                self._fail(f"Not started: {robots(late)} did not take the mission.")
                return False
        newest = self._operator.stop_in_force
        if newest is None or newest.version != stop.version:
            self._fail("Not started: another operator said stop or resume meanwhile.")
            return False
        now_ns = self._clock.now_ns()
        if not is_lifted(stop):
            self._view.say(f"lifting the stop that was given at {clock(stop.time_ns, now_ns)}{why(stop)}")
        self._fleet_state.say(self._operator.order_resume(now_ns, (), self._given_ns))
        return True

    def _hand_over(self) -> bool:
        """Waits until all have acknowledged the mission, and leaves them alone; False when not all do."""
        by_ns = (self._fleet_state.epoch_ns or 0) + self._timing.hand_over_ns
        while late := self._fleet_state.without_mission or self._fleet_state.without_order:
            if not self._go_on():
                return False
            if self._clock.now_ns() >= by_ns:
                self._fail(f"Not left to drive alone: {robots(late)} did not take the mission.")
                return False
        stop = self._operator.stop_in_force
        if stop is not None:
            when = clock(stop.time_ns, self._clock.now_ns())
            self._fail(f"Not left to drive alone: the robots were told to stop at {when}{why(stop)}.")
            return False
        return True

    def _drive(self) -> None:
        while self._clock.now_ns() < self.end_ns:
            if not self._go_on():
                return
        self._show()  # how it ended, whenever the last look was
        self._is_over = True
        for sentence in self._processes.lacking(self._fleet_state.members):
            self._fail(sentence)

    def _go_on(self) -> bool:
        """A step of a fleet that has its mission: sends lacking orders again; False when the drive ends."""
        self._fleet_state.say_again()
        self._fleet_state.ask()
        return self._step() and not self._is_refused() and not self._is_overtaken()

    def _is_refused(self) -> bool:
        """Whether an agent has refused the mission because it reads another fleet file."""
        others = self._fleet_state.on_other_file
        if others:
            self._fail(f"Not driven: this is not the fleet file that is read by {robots(others)}.")
        return bool(others)

    def _is_overtaken(self) -> bool:
        """Whether another operator has begun another drive, which those that were up before go on with."""
        mission = self._operator.mission
        if self._processes.ours or mission is None or mission.epoch_ns == self._fleet_state.epoch_ns:
            return False
        self._is_left = True
        self._fail("Another operator has begun another drive, and the robots drive that.")
        return True

    def _stop(self) -> None:
        """Brings every robot to a standstill, or gives up after a while."""
        standstill = Standstill(self._fleet_state, self._interrupt, self._timing, self._ways)
        standstill.wait(self._view, self._why_stop())
        if standstill.deaf and not self._processes.ours:
            self._fail(f"Not heard to stop: {robots(standstill.deaf)}.")
        if self.is_behind and not self._processes.ours:
            self._warn("The command did not keep up with what it heard: the last of it is not recorded")
        if standstill.lost is not None:
            raise standstill.lost

    def _why_stop(self) -> str:
        """The reason of the stop at the end, by which the next drive decides whether it may lift it."""
        if self._interrupt.count:
            return "interrupted"
        if not self._is_over:
            return "; ".join(self.reasons) or BROKEN_OFF
        # One that somebody said during the drive, and nobody lifted, holds beyond it.
        standing = self._operator.stop_in_force
        return OVER if standing is None else standing.reason

    # ------------------------------------------------------------------ every step

    def _step(self) -> bool:
        """Waits a moment, takes what came, does what rules order; False when the run has to end."""
        fleet_state = self._fleet_state
        time.sleep(min(POLL_S, max(0.0, self._until_next_s())))
        fleet_state.collect()
        news = self._watch.news(fleet_state.time_s)
        if fleet_state.epoch_ns is None and not self._processes.ours:
            news = []  # of what was ordered and done before this drive, as agents tell it now
        for sentence in [*news, *fleet_state.look()]:
            self._view.say(sentence)
        while self._until_next_s() <= 0.0:
            _, do = self._todo.pop()
            do()
            fleet_state.collect()
        now_ns = self._clock.now_ns()
        self._look_after_a_stand(now_ns)
        if self._beats and now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + HEARTBEAT_PERIOD_NS
            fleet_state.say(Heartbeat(now_ns, fleet_state.author))
        if now_ns >= self._show_due_ns:
            self._show_due_ns = self._next_show_ns(now_ns)
            self._show()
        if now_ns >= self._deaths_due_ns:
            self._deaths_due_ns = now_ns + DEATHS_PERIOD_NS
            if self._deaths():
                return False
        return not self._interrupt.count

    def _look_after_a_stand(self, now_ns: int) -> None:
        """After this process has stood, or while it does not keep up, what waited for it is not shown as what
        is: fresh messages are."""
        stood = now_ns - self._stepped_ns > STOOD_NS or self._fleet_state.is_behind
        before = self._has_stood
        self._stepped_ns, self._has_stood = now_ns, stood
        if stood and not before:
            self._watch.stood()
            self._show_due_ns = max(self._show_due_ns, now_ns + FRESH_NS)

    @property
    def _beats(self) -> bool:
        """Whether robots need this operator's heartbeat."""
        return self._fleet.supervision.deadman_s is not None

    def _next_show_ns(self, now_ns: int) -> int:
        """When the fleet is shown again: now and then, and as soon as it can be heard to drive."""
        epoch_ns, due_ns = self._fleet_state.epoch_ns, now_ns + SHOW_PERIOD_NS
        first_ns = due_ns if epoch_ns is None else epoch_ns + SHOW_FIRST_NS
        return first_ns if now_ns < first_ns < due_ns else due_ns

    def _show(self) -> None:
        self._view.show(self._watch.picture(self._fleet_state.time_s))

    def _deaths(self) -> bool:
        """Reports every child that has ended of its own, many that ended alike as one; True when there was
        one."""
        at = self._fleet_state.time_s
        when = "before the start" if at is None or at < 0 else f"at {at:.1f} s"
        alike: dict[str, list[Ended]] = {}
        for child, how in self._processes.deaths():
            alike.setdefault(how, []).append(child)
        for how, children in alike.items():
            if len(children) > DEATHS_MAX:
                names = some([child.name for child in children])
                self._fail(f"{len(children)} processes ended {when} ({how}): {names}.")
                continue
            for child in children:
                self._fail(f"{child.name.capitalize()} ended {when} ({how}).")
                for line in child.last_lines():
                    self._view.say(f"    {line}")
        return bool(alike)

    def _fail(self, reason: str) -> None:
        self.reasons.append(reason)
        self._view.say(reason)

    def _warn(self, sentence: str) -> None:
        """Warns by a sentence without its end."""
        self.warnings.append(sentence)
        self._view.say(f"warning: {sentence}")

    # ------------------------------------------------------------------ what is done at its time

    def _plan(self, epoch_ns: int) -> None:
        """Notes what is to be done at which time; of one time, what rules do comes first."""
        rules = FaultPlan(self._fleet).file_rules()
        todo: list[tuple[float, Callable[[], None]]] = [
            (action.time_s, partial(self._carry_out, action))
            for action in actions(rules, self._fleet.ids, self._duration_s)
        ]
        todo += [(order.at, partial(self._give, order, epoch_ns)) for order in self._orders]
        self._todo = sorted(todo, key=itemgetter(0))[::-1]

    def _until_next_s(self) -> float:
        """Time until something is to be done, s."""
        epoch_ns = self._fleet_state.epoch_ns
        if not self._todo or epoch_ns is None:
            return float("inf")
        return self._todo[-1][0] - (self._clock.now_ns() - epoch_ns) / NS_PER_S

    def _give(self, order: OrderSection, epoch_ns: int) -> None:
        """Carries out an order of the fleet file; one that cannot be is a reason for the verdict."""
        now_ns, due_ns = self._clock.now_ns(), epoch_ns + round(order.at * NS_PER_S)
        try:
            given_ns = due_ns if now_ns - due_ns < ORDER_LATE_NS else now_ns
            self._fleet_state.say(self._operator.give(order, given_ns, self._fleet_state.heard))
        except OrderError as error:
            self._fail(refused(order, error))

    def _carry_out(self, action: Action) -> None:
        fleet_state, robot, role = self._fleet_state, action.robot, action.role
        if not self._processes.carry_out(action, fleet_state.pose(robot)):
            return  # it has died of its own, which ends the run
        now_ns = self._clock.now_ns()
        if action.what == "start" and role == "plant":
            fleet_state.states.pop(robot, None)
        event = Event(robot, self._events, now_ns, role, action.what, action.rule)
        self._events += 1
        fleet_state.record(now_ns, key_expressions.events(self._fleet.fleet.name), encode(event))
        name = self._processes.names[robot, role]
        self._view.say(f"{fleet_state.time_s:.1f} s: rule {action.rule!r} {WORDS[action.what]} {name}")
