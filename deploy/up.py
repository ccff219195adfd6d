"""Brings a fleet up on its hosts: all of them side by side, and none waits for another.

Each host is made ready (`deploy.host_setup`), and what is not as it should be starts again there. While the
fleet drives, robots start again one at a time, each only when the one before is back in its place. Who is
there, and in what state, is heard over the bus and not from ssh.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Final

from agent.fleet import Fleet
from agent.host_sections import HostSection
from agent.keys import ROLES
from agent.supervision import DRIVING, State
from deploy import units
from deploy.bundle import program_archive
from deploy.host_connection import HostConnection, HostError
from deploy.host_jobs import LOOK_S, HostJobs
from deploy.host_setup import Keys, Prepared, prepare
from deploy.hosts import robots_text
from deploy.hosts_view import HostsView, Row
from deploy.interrupt import Interrupt
from deploy.live_faults import Receiver
from deploy.operator_session import OperatorSession
from deploy.readiness import is_ready
from deploy.wording import robots as robots_words

LISTEN_S: Final = 1.5
"""A fleet that is up is heard within this: whether it drives decides how its robots start again."""
PRESENT_TIMEOUT_S: Final = 30.0
UNITS_PERIOD_S: Final = 2.0
"""How often it is looked whether a unit that is waited for has failed for good."""
SETTLE_S: Final = 5.0

_DRIVING: Final = frozenset(state.value for state in DRIVING)
_SETTLED: Final = _DRIVING | {State.STOPPED.value, State.RELEASED.value, State.HOLDING.value}


class Arrivals(OperatorSession):
    """Who is there, and since when. One thread collects; others may look."""

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._came: dict[Receiver, float] = {}

    def look(self) -> None:
        """Takes what came."""
        self.collect()
        now = time.monotonic()
        for receiver in list(self._came):
            if receiver not in self.alive:
                self._came.pop(receiver, None)
                self.statuses.pop(receiver[0], None)
        for receiver in self.alive:
            self._came.setdefault(receiver, now)

    def is_here(self, robot: int, since: Mapping[str, float]) -> bool:
        """Whether its agent, heard from, and its plant are there; of roles in `since` only who came later."""
        came = {role: self._came.get((robot, role)) for role in ROLES}
        return robot in self.statuses and all(
            moment is not None and moment >= since.get(role, moment) for role, moment in came.items()
        )

    def drives(self, robot: int) -> bool:
        status = self.statuses.get(robot)
        return status is not None and status.state in _DRIVING

    @property
    def driving(self) -> bool:
        """Whether any robot drives."""
        return any(map(self.drives, self.fleet.ids))

    def settled(self, robot: int) -> bool:
        """Whether it is ready to drive, drives, or has driven."""
        status = self.statuses.get(robot)
        return status is not None and (is_ready(status.state) or status.state in _SETTLED)

    @property
    def drives_by_another_file(self) -> bool:
        """Whether robots drive a mission for another fleet file than this one."""
        return self.driving and self.operator.mission is None and self.operator.foreign is not None

    def says(self, robot: int) -> str:
        """State of a robot's agent, and why."""
        status = self.statuses.get(robot)
        if status is None:
            return "silent"
        return f"{status.state}: {status.reason}" if status.reason else status.state


class BringUp:
    """One `handfast up`.

    Args:
        fleet: resolved and located.
        hosts: those to bring up.
        keys: gives robots of a secured fleet their certificates; None where it is not secured.
        accept_new: takes the keys of hosts that were never met before for their own.
    """

    def __init__(
        self, fleet: Fleet, hosts: Sequence[HostSection], keys: Keys | None, *, accept_new: bool
    ) -> None:
        self._fleet, self._keys = fleet, keys
        self._jobs = HostJobs(fleet, hosts, self._bring, accept_new=accept_new)
        self.rows: Final = self._jobs.rows
        self.warnings: list[str] = []
        self.versions: dict[str, str] = {}
        self._text = robots_text(fleet)
        self._program = program_archive()
        self._turn = threading.Lock()
        """Held by the one robot that may be down while the fleet drives."""
        self._halted = ""
        self._rolling = self._foreign = False
        self._listened = threading.Event()

    def run(self, view: HostsView, interrupt: Interrupt) -> None:
        """Brings all up; what became of each host and robot is in `rows` then.

        Raises:
            agent.bus.BusError: the operator's session cannot be opened.
        """
        with Arrivals(self._fleet) as self._arrivals:
            listen_until = time.monotonic() + LISTEN_S

            def look() -> None:
                self._arrivals.look()
                if self._listened.is_set():
                    return
                if self._arrivals.operator.behind:
                    self._arrivals.say_ask()
                if time.monotonic() > listen_until:
                    self._rolling = self._arrivals.driving
                    self._foreign = self._arrivals.drives_by_another_file
                    self._listened.set()

            with self._jobs as jobs:
                jobs.wait(view, interrupt, look)
                self._settle(interrupt)
            self._arrivals.look()
            for row in self.rows.values():
                row.outcomes = {robot: self._arrivals.says(robot) for robot in row.outcomes}
            view.show(list(self.rows.values()))

    def _settle(self, interrupt: Interrupt) -> None:
        """Gives those that came first a moment to find those that came last."""
        here = [robot for row in self.rows.values() for robot in row.outcomes]
        deadline = time.monotonic() + SETTLE_S
        while time.monotonic() < deadline and not interrupt.count:
            self._arrivals.look()
            if all(map(self._arrivals.settled, here)):
                break
            time.sleep(LOOK_S)

    # ------------------------------------------------------------------ one host, in a thread of its own

    def _bring(self, connection: HostConnection, row: Row) -> None:
        def say(text: str) -> None:
            row.step = text

        def before_changes() -> None:
            say("listening whether the fleet drives")
            self._listened.wait(LISTEN_S + 5.0)
            if self._foreign:
                raise HostError(
                    "left as it was: the fleet drives by another fleet file. `handfast stop` first, then up"
                )

        prepared = prepare(
            connection, self._fleet, self._text, self._program, say, self._keys, before_changes
        )
        self.versions[row.host] = prepared.version
        self.warnings += [f"{row.host}: {warning}" for warning in prepared.warnings]
        self._start(row, connection, prepared)
        connection.ask("tidy", keep=[prepared.version])

    def _start(self, row: Row, connection: HostConnection, prepared: Prepared) -> None:
        fleet = self._fleet
        robot_of = {
            units.unit_name(fleet.fleet.name, robot, role): robot
            for robot in row.robots
            for role in units.roles(fleet)
        }
        stale = {
            robot: [name for name in prepared.restart if robot_of[name] == robot] for robot in row.robots
        }
        starts = [robot for robot in row.robots if stale[robot]]
        if self._rolling:
            for robot in starts:
                self._one_at_a_time(row, connection, robot, stale[robot])
        elif starts:
            row.step = f"starting {robots_words(starts)}"
            begun = time.monotonic()
            connection.ask("restart", names=[name for robot in starts for name in stale[robot]])
            for robot in starts:
                self._await(row, connection, robot, self._since(robot, stale[robot], begun))
        for robot in row.robots:
            if robot not in starts:
                self._await(row, connection, robot, {})
        lacking = [robot for robot in row.robots if robot not in row.outcomes]
        if lacking:
            raise HostError(self._why(connection, lacking))
        what = f"{robots_words(starts)} started" if starts else "nothing to do"
        row.done(f"up, {what}")

    def _one_at_a_time(self, row: Row, connection: HostConnection, robot: int, names: list[str]) -> None:
        row.step = f"waiting for its turn to start robot {robot} again"
        with self._turn:
            if self._halted or self._jobs.ended:
                raise HostError(f"left as it was: {self._halted or 'interrupted'}")
            drove = self._arrivals.drives(robot)
            row.step = f"starting robot {robot} again"
            since = self._since(robot, names, time.monotonic())
            connection.ask("restart", names=names)
            here = self._await(row, connection, robot, since, drives=drove)
            if not here:
                self._halted = f"robot {robot} did not come back"

    def _since(self, robot: int, names: Collection[str], begun: float) -> dict[str, float]:
        """Since when which of a robot's processes are new, of those that are heard on the bus."""
        name = self._fleet.fleet.name
        return {role: begun for role in ROLES if units.unit_name(name, robot, role) in names}

    def _await(
        self,
        row: Row,
        connection: HostConnection,
        robot: int,
        since: Mapping[str, float],
        *,
        drives: bool = False,
    ) -> bool:
        """Waits until a robot is heard on the bus, or one of its processes will not start; whether it is."""
        deadline = time.monotonic() + PRESENT_TIMEOUT_S
        look_due = time.monotonic() + UNITS_PERIOD_S
        row.step = f"waiting for robot {robot} on the bus"
        names = [units.unit_name(self._fleet.fleet.name, robot, role) for role in ROLES]
        while time.monotonic() < deadline and not self._jobs.ended:
            if self._arrivals.is_here(robot, since) and (not drives or self._arrivals.drives(robot)):
                row.outcomes[robot] = self._arrivals.says(robot)
                return True
            if time.monotonic() > look_due:
                look_due += UNITS_PERIOD_S
                if any(connection.ask("state", name=name).startswith("failed") for name in names):
                    return False
            time.sleep(LOOK_S)
        return False

    def _why(self, connection: HostConnection, robots: Sequence[int]) -> str:
        """Why robots are not there: what their processes said last."""
        name = self._fleet.fleet.name
        lines = []
        for robot in robots:
            for role in ROLES:
                unit = units.unit_name(name, robot, role)
                told = connection.ask("last_lines", name=unit, count=1)
                state = connection.ask("state", name=unit)
                if state != "active" or (robot, role) not in self._arrivals.alive:
                    said = f": {told[-1]}" if told else ""
                    lines.append(f"robot {robot}'s {role} is {state}{said}")
        if lines:
            return "; ".join(lines)
        return (
            f"{robots_words(robots)}: running there, but not heard here: is the port open "
            f"({self._fleet.agent_endpoint(robots[0])} and so on)?"
        )
