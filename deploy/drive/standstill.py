"""The end of a drive: every robot is brought to a standstill."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from typing import Final

from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Stop
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.drive.display.live_view import View
from handfast.deploy.drive.fleet_state import COLLECT_S, FleetState
from handfast.deploy.drive.preconditions import Timing
from handfast.deploy.drive.readiness import stands
from handfast.deploy.orders.stop_outcome import Stopping, has_acknowledged
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.session.stop import Way

LOOK_S: Final = 0.02
LATE_S: Final = 0.5
"""A robot that has not acknowledged a stop by then is reached by other ways too."""
LAST_S: Final = 2.0
"""So long what came until the end is taken."""
WAYS_S: Final = 8.0
"""So long other ways may take, such as ssh to a host that is far away."""


class Standstill:
    """Stops every robot of a fleet: over the links that there are, and by other ways at once after Ctrl-C,
    else when a robot has not answered for `LATE_S`.

    Args:
        ways: makes those.

    After `wait`, `deaf` are the robots that were not heard to stop, and `lost` is what kept what was heard
    from being recorded, None when nothing did.
    """

    def __init__(
        self,
        fleet_state: FleetState,
        interrupt: Interrupt,
        timing: Timing,
        ways: Callable[[], Sequence[Way]] = tuple,
    ) -> None:
        self._fleet_state, self._interrupt, self._timing = fleet_state, interrupt, timing
        self._make_ways = ways
        self._hurried = interrupt.count > 0
        self.deaf: list[int] = []
        self.lost: RecordingError | None = None

    def wait(self, view: View, reason: str) -> None:
        """Sends the stop again and again until all stand, or gives up after a while."""
        fleet_state, processes = self._fleet_state, self._fleet_state.processes
        processes.resume_all()
        stop = fleet_state.operator.order_stop(fleet_state.clock.now_ns(), reason)
        fleet_state.say(stop)
        if self._hurried:
            view.say(f"{signal.Signals(self._interrupt.number).name}: stopping every robot")
        others = Stopping(fleet_state.fleet, stop.time_ns, reason, stop)
        ways = self._repeat(stop, others)
        self._collect(LAST_S)
        for way in ways:
            way.close()
        deaf = [robot for robot in fleet_state.fleet.ids if not self._has_acknowledged(robot, stop)]
        reached = [robot for robot in deaf if others.stands_by(robot)]
        for line in others.outcomes_elsewhere(reached):
            view.say(line)
        self.deaf = [robot for robot in deaf if robot not in reached]

    def _repeat(self, stop: Stop, others: Stopping) -> Sequence[Way]:
        """Repeat the stop until all stand or time is up; return the other ways that were used."""
        fleet_state = self._fleet_state
        ways: Sequence[Way] = ()
        asked_ways = False
        begun = time.monotonic()
        again, deadline = begun + self._timing.stop_again_s, begun + self._timeout_s
        last = max(deadline, begun + WAYS_S)
        waiting = self._running()
        while (now := time.monotonic()) < last and self._interrupt.count < 2:
            if now >= deadline and not any(way.busy for way in ways):
                break
            self._collect()
            late = now >= begun + LATE_S
            if not asked_ways and (self._hurried or (late and not self._all_acknowledged(waiting, stop))):
                asked_ways, ways = True, self._sent_by_ways(stop)
            for way in ways:
                way.collect(others)
            if late:
                waiting = self._awaited(waiting, stop, others)
            if self._at_rest(waiting, stop):
                break
            if now >= again:
                again = now + self._timing.stop_again_s
                if not self._all_know(waiting, stop):
                    fleet_state.say(stop)
            time.sleep(LOOK_S)
        return ways

    def _running(self) -> list[int]:
        """Return the robots of which all processes run."""
        processes = self._fleet_state.processes
        return [
            robot
            for robot in self._fleet_state.fleet.ids
            if all(processes.up(robot, role) for role in key_expressions.ROLES)
        ]

    def _awaited(self, robots: Sequence[int], stop: Stop, others: Stopping) -> list[int]:
        """Return the robots without those already known, through another channel only, to be braking."""
        return [
            robot for robot in robots if self._has_acknowledged(robot, stop) or not others.stands_by(robot)
        ]

    def _sent_by_ways(self, stop: Stop) -> Sequence[Way]:
        """Make the other ways and send the stop by each."""
        ways = self._make_ways()
        for way in ways:
            way.send(stop)
        return ways

    def _has_acknowledged(self, robot: int, stop: Stop) -> bool:
        return has_acknowledged(self._fleet_state.watch.statuses.get(robot), stop)

    def _all_acknowledged(self, robots: Sequence[int], stop: Stop) -> bool:
        return all(self._has_acknowledged(robot, stop) for robot in robots)

    def _at_rest(self, robots: Sequence[int], stop: Stop) -> bool:
        """Return True if all stand. Processes of ours end now and will not drive again; other robots must
        also have latched the stop."""
        statuses, states = self._fleet_state.watch.statuses, self._fleet_state.states
        if not all(stands(statuses.get(robot), states.get(robot)) for robot in robots):
            return False
        return self._fleet_state.processes.ours or self._all_acknowledged(robots, stop)

    def _all_know(self, robots: Sequence[int], stop: Stop) -> bool:
        statuses = self._fleet_state.watch.statuses
        return all(r in statuses and statuses[r].order_version >= stop.version for r in robots)

    @property
    def _timeout_s(self) -> float:
        ours = self._fleet_state.processes.ours
        return self._timing.standstill_timeout_s(
            has_vehicles=bool(self._fleet_state.checks.robots), is_hurried=self._hurried and ours
        )

    def _collect(self, most_s: float = COLLECT_S) -> None:
        """Takes what came: whether robots stand matters more than that it is recorded."""
        try:
            self._fleet_state.collect(most_s)
        except RecordingError as error:
            self.lost = error
