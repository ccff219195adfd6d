"""The end of a drive: every robot is brought to a standstill."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from typing import Final

from handfast.agent.messages import key_expressions
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
        fleet, statuses = fleet_state.fleet, fleet_state.watch.statuses
        others = Stopping(fleet, stop.time_ns, reason, stop)
        ways: Sequence[Way] | None = None
        begun = time.monotonic()
        again, deadline = begun + self._timing.stop_again_s, begun + self._timeout_s
        last = max(deadline, begun + WAYS_S)
        waiting = [
            robot for robot in fleet.ids if all(processes.up(robot, role) for role in key_expressions.ROLES)
        ]
        while (now := time.monotonic()) < last and self._interrupt.count < 2:
            if now >= deadline and not any(way.busy for way in ways or ()):
                break
            self._collect()
            fleet_state.pass_on()
            late = now >= begun + LATE_S
            deaf = late and not all(has_acknowledged(statuses.get(robot), stop) for robot in waiting)
            if ways is None and (self._hurried or deaf):
                ways = self._make_ways()
                for way in ways:
                    way.send(stop)
            for way in ways or ():
                way.collect(others)
            # Who is deaf to these links, and is known otherwise to brake, is waited for no longer.
            waiting = [
                robot
                for robot in waiting
                if not late or has_acknowledged(statuses.get(robot), stop) or not others.stands_by(robot)
            ]
            rest = all(stands(statuses.get(robot), fleet_state.states.get(robot)) for robot in waiting)
            # Those that end now will not drive again; others must have latched the stop.
            if rest and (
                processes.ours or all(has_acknowledged(statuses.get(robot), stop) for robot in waiting)
            ):
                break
            if now >= again:
                again = now + self._timing.stop_again_s
                if any(r not in statuses or statuses[r].order_version < stop.version for r in waiting):
                    fleet_state.say(stop)
            time.sleep(LOOK_S)
        self._collect(LAST_S)
        for way in ways or ():
            way.close()
        self.deaf = [robot for robot in fleet.ids if not has_acknowledged(statuses.get(robot), stop)]
        reached = [robot for robot in self.deaf if others.stands_by(robot)]
        for line in others.outcomes_elsewhere(reached):
            view.say(line)
        self.deaf = [robot for robot in self.deaf if robot not in reached]

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
