"""A fleet on this machine: one process for each agent and each plant, watched to the end."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from typing import Final

from agent import keys
from agent.bus import Bus, Presence
from agent.clock import NS_PER_S, RealClock
from agent.fleet import Fleet, digest
from agent.formation import resolve
from agent.messages import Mission, Stop, encode
from agent.node import next_tick_ns
from agent.supervision import State
from deploy.children import Child, end_all
from deploy.interrupt import Interrupt
from deploy.live import View, Watch, fleet_time_s
from deploy.ports import Reservation
from deploy.runfolder import RunFolder

ADDRESS: Final = "127.0.0.1"
POLL_S: Final = 0.04
SHOW_PERIOD_NS: Final = NS_PER_S // 4
MISSION_PERIOD_NS: Final = NS_PER_S // 2
EPOCH_AHEAD_NS: Final = NS_PER_S // 2
"""The mission is out this long before the epoch: every agent has it by then."""
READY_TIMEOUT_S: Final = 10.0
READY_TIMEOUT_PER_CHILD_S: Final = 0.5
STOP_TIMEOUT_S: Final = 2.0
INTERRUPT_STOP_TIMEOUT_S: Final = 0.3
END_TIMEOUT_S: Final = 0.4
RECORDER_INBOX: Final = 65_536

MODULES: Final = {"unicycle": "plant"}
"""Kind of plant -> module that hosts it."""


def place(fleet: Fleet) -> tuple[Fleet, Reservation]:
    """`fleet` on this machine's loopback, on ports that are free; they stay reserved until given back.

    Raises:
        deploy.ports.NoPortsError: when there are none.
    """
    ports = Reservation(ADDRESS, fleet.network.base_port, 2 * len(fleet.robots))
    return replace(fleet, network=replace(fleet.network, address=ADDRESS, base_port=ports.base)), ports


class LocalRun:
    """One run: starts the processes of `fleet` (resolved and placed), drives it and ends it.

    After `run`, `reasons` holds what went wrong in the operator's eyes, as sentences for the verdict.
    """

    def __init__(self, fleet: Fleet, folder: RunFolder, view: View, interrupt: Interrupt) -> None:
        self._fleet, self._folder, self._view, self._interrupt = fleet, folder, view, interrupt
        self._clock = RealClock()
        self._watch = Watch(fleet, resolve(fleet))
        self._children: list[Child] = []
        self._dead: set[Child] = set()
        self._epoch_ns: int | None = None
        self._version = 0
        self._show_due_ns = 0
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
            with Bus(listen=[], connect=endpoints) as bus:
                self._operate(bus)
        finally:
            for child in end_all(self._children, END_TIMEOUT_S):
                if child not in self._dead:
                    self._view.say(f"{child.name} did not end when asked and was killed")

    def _start(self) -> None:
        count = len(self._fleet.robots)
        self._view.say(
            f"starting {count} agents and {count} plants on ports {self._fleet.network.base_port} to "
            f"{self._fleet.network.base_port + 2 * count - 1}"
        )
        for robot in self._fleet.robots:
            for role, module in (("agent", "agent"), ("plant", MODULES[robot.plant])):
                log = self._folder.log(f"robot-{robot.id}-{role}.log")
                self._children.append(Child(robot.id, role, module, self._folder.fleet_file, log))

    def _operate(self, bus: Bus) -> None:
        name = self._fleet.fleet.name
        for key in (keys.mission(name), keys.stop(name)):
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
            keys.alive(self._fleet.fleet.name, child.robot, child.role): child for child in self._children
        }
        begun = time.monotonic()
        timeout_s = READY_TIMEOUT_S + READY_TIMEOUT_PER_CHILD_S * len(self._children)
        alive = False
        while self._step(bus):
            presence.update()
            missing = [child for key, child in expected.items() if key not in presence.alive]
            if not missing and not alive:
                alive = True
                self._view.say(f"all {len(expected)} processes alive after {time.monotonic() - begun:.2f} s")
            states = self._watch.states()
            if alive and all(state == State.READY.value for state in states.values()):
                return True
            if time.monotonic() - begun > timeout_s:
                what = [child.name for child in missing] or [
                    f"robot {robot} ({self._watch.statuses[robot].reason if state else 'nothing heard'})"
                    for robot, state in states.items()
                    if state != State.READY.value
                ]
                self._fail(f"Not ready within {timeout_s:.0f} s: {', '.join(what)}.")
                return False
        return False

    def _drive(self, bus: Bus) -> None:
        period_ns = self._fleet.period_ns
        duration_ns = round(self._fleet.fleet.duration_s * NS_PER_S)
        self._epoch_ns = next_tick_ns(self._clock.now_ns() + EPOCH_AHEAD_NS, period_ns, 0)
        self._version = self._epoch_ns // 1_000_000
        end_ns = self._epoch_ns + duration_ns
        due_ns = 0
        while self._clock.now_ns() < end_ns:
            now_ns = self._clock.now_ns()
            if now_ns >= due_ns and any(
                status.mission_version != self._version for status in self._watch.statuses.values()
            ):
                # Said again until every agent has it: one that starts again needs it too.
                due_ns = now_ns + MISSION_PERIOD_NS
                mission = Mission(self._version, now_ns, self._epoch_ns, duration_ns, digest(self._fleet))
                bus.publish(keys.mission(self._fleet.fleet.name), encode(mission))
            if not self._step(bus):
                return
        self._show()  # how it ended, whenever the last look was

    def _stop(self, bus: Bus) -> None:
        """Brings every robot to a standstill, or gives up after a while."""
        hurried = self._interrupt.count > 0
        if hurried:
            self._view.say(f"{signal.Signals(self._interrupt.number).name}: stopping every robot")
        deadline = time.monotonic() + (INTERRUPT_STOP_TIMEOUT_S if hurried else STOP_TIMEOUT_S)
        why = "interrupted" if hurried else "; ".join(self.reasons) or "the run is over"
        now_ns = self._clock.now_ns()
        stop = Stop(max(self._version, now_ns // 1_000_000), now_ns, why[:100])
        bus.publish(keys.stop(self._fleet.fleet.name), encode(stop))
        still = (State.STOPPED.value, State.FAULT.value)
        waiting = {child.robot for child in self._children} - {child.robot for child in self._dead}
        while time.monotonic() < deadline and self._interrupt.count < 2:
            self._collect(bus)
            states = self._watch.states()
            if all(states[robot] in still for robot in waiting):
                break
            time.sleep(POLL_S / 2)
        self._collect(bus)

    # ------------------------------------------------------------------ every step

    def _step(self, bus: Bus) -> bool:
        """Waits a moment, takes what came, shows it; False when the run has to end."""
        time.sleep(POLL_S)
        self._collect(bus)
        now_ns = self._clock.now_ns()
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

    def _deaths(self) -> bool:
        """Reports every child that has ended; True when there was one."""
        for child in self._children:
            how = child.ended() if child not in self._dead else None
            if how is not None:
                self._dead.add(child)
                at = fleet_time_s(self._clock.now_ns(), self._epoch_ns)
                when = "before the start" if at is None or at < 0 else f"at {at:.1f} s"
                self._fail(f"{child.name.capitalize()} ended {when} ({how}).")
                for line in child.last_lines():
                    self._view.say(f"    {line}")
        return bool(self._dead)

    def _fail(self, reason: str) -> None:
        self.reasons.append(reason)
        self._view.say(reason)
