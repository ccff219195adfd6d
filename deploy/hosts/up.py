"""Brings a fleet up on its hosts: all of them side by side, and none waits for another.

Each host is made ready (`deploy.hosts.setup`), and what is not as it should be starts again there. While the
fleet drives, robots start again one at a time, each only when the one before is back in its place. Who is
there, and in what state, is heard over the bus and not from ssh. Where that goes through routers on hosts
and none of them answers, these start before anything else.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import encode
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import Resume, Stop
from handfast.agent.runtime.order_store import packed
from handfast.agent.supervision.state_machine import DRIVING_NAMES
from handfast.agent.transport.bus import BusError
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.sources import plugin_modules
from handfast.deploy.console.wording import robots as robots_words
from handfast.deploy.console.wording import some
from handfast.deploy.drive.preconditions import clock, older_mission, why
from handfast.deploy.hosts import systemd_units
from handfast.deploy.hosts.arrivals import Arrivals
from handfast.deploy.hosts.bundle import program_archive
from handfast.deploy.hosts.certificates import AnotherAuthorityError, HostKeys
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.hosts.jobs import (
    AT_ONCE_MAX,
    DOING,
    DONE,
    FAILED,
    INTERRUPTED,
    HostJobs,
    HostsView,
    Row,
    Work,
)
from handfast.deploy.hosts.remote_program import STOP_TEXT_MAX
from handfast.deploy.hosts.setup import Prepared, prepare, start_router
from handfast.deploy.inventory.hosts import robots_on, robots_text
from handfast.deploy.inventory.operator_credentials import short
from handfast.deploy.session.operator_bus import sealed, unsealed

SAY_PERIOD_S: Final = 0.25
ORDERS_EACH: Final = 4
"""A robot's two processes keep a stop and a resume each."""
ROBOTS_LEFT: Final = 4
"""Robots that have been on a host and are no more: so many may have left orders there."""
REMIND_S: Final = 2.0
"""Robots that do not know of the stop in force have so long to acknowledge it; then it counts who drives."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of bringing a fleet up, s.

    Attributes:
        look_s: how often it is looked what happens.
        listen_s: a fleet that is up is heard within this: whether it drives decides how its robots start
            again.
        present_s: how long a robot may take to be heard after its start.
        units_period_s: how often it is looked whether a unit that is waited for has failed for good.
        idle_s: a robot that came back drives again within this after the first sign of it, if the others
            still do.
        settle_s: how long those that came first may take to find those that came last.
    """

    look_s: float = 0.1
    listen_s: float = 1.5
    present_s: float = 30.0
    units_period_s: float = 2.0
    idle_s: float = 3.0
    settle_s: float = 5.0


class BringUp:
    """Brings a fleet up on its hosts, once (`handfast up`).

    Args:
        fleet: resolved and located.
        hosts: those to bring up.
        keys: gives robots of a secured fleet their certificates; None where it is not secured.
        accept_new: takes the keys of hosts that were never met before for their own.
        timing: how long things may take.
        before_changes: called with a host's name before anything of the fleet changes there, in a thread.

    Attributes:
        fleet: as it was given.
        rows: by host, what became of it.
        routers: by number, what became of the routers on these hosts.
        left: robots that should have started again and did not, as one before them did not come back.
        warnings: what the operator should know.
    """

    def __init__(
        self,
        fleet: Fleet,
        hosts: Sequence[HostSection],
        keys: HostKeys | None,
        *,
        accept_new: bool,
        timing: Timing | None = None,
        before_changes: Callable[[str], None] = lambda host: None,
    ) -> None:
        self._before_changes = before_changes
        self.fleet: Final = fleet
        self._keys, self._timing = keys, timing or Timing()
        self._hosts, self._accept_new = hosts, accept_new
        self._jobs = self._jobs_first = self._work_on(hosts, self._bring)
        self.rows: Final = self._jobs.rows
        self.routers: dict[int, str] = {}
        self._hears = False
        self.left: set[int] = set()
        self.warnings: list[str] = []
        self._text = robots_text(fleet)
        self._program = program_archive(plugin_modules(fleet))
        self._turn = threading.Lock()
        """Held by the one robot that may be down while the fleet drives."""
        self._halted = ""
        self._rolling = self._foreign = False
        self._asked: set[str] = set()
        self._ruled: list[str] = []
        """Hosts that were asked which authority their robots have, and those that have another one."""
        self._listened = threading.Event()
        self._starts, self._stopped = False, threading.Event()
        """Whether robots start of a fleet that stands, and that a stop was made for that."""
        self._stop: Stop | None = None
        self._kept: queue.SimpleQueue[Stop | Resume] = queue.SimpleQueue()
        """What robots have kept of operators' orders, as their hosts tell."""
        self._say_due = 0.0
        self._forgetful = ""

    def run(self, view: HostsView, interrupt: Interrupt) -> None:
        """Brings all up; what became of each host and robot is in `rows` then.

        Raises:
            handfast.agent.transport.bus.BusError: the operator's session cannot be opened.
        """
        arrivals = self._open(view, interrupt)
        if arrivals is None:
            for row in self.rows.values():
                row.fail(INTERRUPTED)
            return
        with arrivals as self._arrivals:
            self._hears = True
            listen_until = time.monotonic() + self._timing.listen_s

            def look() -> None:
                self._arrivals.look()
                self._say_stop()
                if self._listened.is_set():
                    return
                if self._arrivals.operator.behind:
                    self._arrivals.say_ask()
                late_s = time.monotonic() - listen_until
                if late_s > REMIND_S or (
                    not self._forgot_stop() and (self._arrivals.complete or late_s > 0.0)
                ):
                    self._rolling = self._arrivals.driving
                    self._foreign = self._arrivals.drives_by_another_file
                    self._listened.set()

            with self._jobs as jobs:
                jobs.wait(view, interrupt, look)
                self._settle(interrupt)
            self._arrivals.look()
            if goes_on := older_mission(self._arrivals.operator, self._arrivals.now_ns()):
                self.warnings.append(goes_on)
            for row in self.rows.values():
                self._conclude(row)
            view.show(list(self.rows.values()))

    def _work_on(self, hosts: Sequence[HostSection], work: Work) -> HostJobs:
        return HostJobs(
            self.fleet,
            hosts,
            work,
            accept_new=self._accept_new,
            at_once=AT_ONCE_MAX,
            look_s=self._timing.look_s,
        )

    def _open(self, view: HostsView, interrupt: Interrupt) -> Arrivals | None:
        """An ear on the fleet's bus; where no router answers, the routers on these hosts are brought up
        first. None where somebody wants to end it.

        Raises:
            BusError: there is no way to hear the fleet.
        """
        hosts = [host for host in self._hosts if self.fleet.router_on(host.name) is not None]
        try:
            return Arrivals(self.fleet)
        except BusError as error:
            if not hosts:
                on = [router.host for router in self.fleet.routers if router.host is not None]
                raise BusError(f"{error}{f'; bring up {some(on)}, too' if on else ''}") from None
        self._bring_routers(hosts, view, interrupt)
        deadline = time.monotonic() + self._timing.present_s
        while not interrupt.count:
            try:
                return Arrivals(self.fleet)
            except BusError:
                if time.monotonic() > deadline:
                    raise
        return None

    def _bring_routers(self, hosts: Sequence[HostSection], view: HostsView, interrupt: Interrupt) -> None:
        """Bring up the routers on these hosts; raise `BusError` where all of them fail."""
        # Which authority the robots of any host have counts before this one's has given the first.
        first = self._hosts if self._keys is not None and self._keys.is_first else hosts
        with self._work_on(first, self._bring_router) as self._jobs_first:
            self._jobs_first.wait(view, interrupt)
            view.show(list(self._jobs_first.rows.values()))
        rows = [self._jobs_first.rows[host.name] for host in hosts]
        if not interrupt.count and all(row.state == FAILED for row in rows):
            raise BusError("; ".join(f"{row.host}: {row.step}" for row in rows))

    def _say_stop(self) -> None:
        """Says the stop in force to those who do not know of it; when robots start, one that ends whatever
        was ordered before."""
        starts = self._starts  # before what its host told is looked at
        while not self._kept.empty():
            self._arrivals.learn(self._kept.get())
        meant = self._arrivals.meant
        if starts and (self._stop is None or (meant is not None and meant.reason != self._stop.reason)):
            self._stop = self._arrivals.came_up()
            self._stopped.set()
        forgot = self._forgot_stop()
        if forgot and time.monotonic() > self._say_due:
            self._say_due = time.monotonic() + SAY_PERIOD_S
            stop = self._arrivals.operator.stop_in_force
            assert stop is not None
            self._arrivals.say(stop)
            if self._stop is None and not self._forgetful:  # not of those that start
                self._forgetful = (
                    f"{robots_words(forgot)} did not know of the stop that was given at "
                    f"{clock(stop.time_ns, self._arrivals.now_ns())}{why(stop)}; told again"
                )
                self.warnings.append(self._forgetful)

    def _forgot_stop(self) -> list[int]:
        """Robots that are heard and have not acknowledged the stop that is in force."""
        stop = self._arrivals.operator.stop_in_force
        return [] if stop is None else self._arrivals.operator.without(stop, self._arrivals.statuses)

    def _lay_stop(self, connection: HostConnection) -> None:
        """Has the robots of a host find that stop before they start. Robots that were heard to stand are not
        to drive by what somebody ordered before they started."""
        name, robots = self.fleet.fleet.name, len(robots_on(self.fleet, connection.host))
        most = ORDERS_EACH * (robots + ROBOTS_LEFT)
        told = connection.ask("orders", fleet=name, most=most, answer_bytes=most * (STOP_TEXT_MAX + 4))
        for each in unsealed(self.fleet, told if isinstance(told, list) else ()):
            self._kept.put(each)
        self._starts = True
        if not self._stopped.wait(self._timing.listen_s + 5.0) or self._stop is None:
            raise HostError("left as it was: this machine is too busy to stop the fleet first")
        order = packed([sealed(self.fleet, encode(self._stop))])
        connection.exchange("order", order, fleet=name)

    def _settle(self, interrupt: Interrupt) -> None:
        """Gives those that came first a moment to find those that came last."""
        here = [robot for row in self.rows.values() for robot in row.outcomes]
        deadline = time.monotonic() + self._timing.settle_s
        while time.monotonic() < deadline and not interrupt.count:
            self._arrivals.look()
            self._say_stop()
            if all(map(self._arrivals.settled, here)):
                break
            time.sleep(self._timing.look_s)

    def _conclude(self, row: Row) -> None:
        """Says of a host's robots what they do at the end."""
        gone = [robot for robot in row.outcomes if not self._arrivals.is_here(robot, {})]
        row.outcomes = {robot: self._arrivals.says(robot) for robot in row.outcomes if robot not in gone}
        if gone and row.state == DONE:
            row.fail(f"{robots_words(gone)} came and went again: `handfast logs` says why")

    # ------------------------------------------------------------------ one host, in a thread of its own

    def _bring_router(self, connection: HostConnection, row: Row) -> None:
        """Brings the router of a host up, and nothing else, while the fleet cannot be heard."""

        def say(text: str) -> None:
            row.step = text

        def before_changes() -> None:
            self._refuse_unheard(connection)
            self._before_changes(row.host)

        if self._keys is not None:
            say("asking which authority its robots have")
            self._refuse_another_authority(self._keys, connection, self._jobs_first)
        if self.fleet.router_on(row.host) is None:
            row.done("waits for the routers")
            return
        prepared = prepare(
            connection,
            self.fleet,
            self._text,
            self._program,
            say,
            self._keys,
            before_changes,
            robots=False,
        )
        self._start_router(row, connection, prepared)
        row.done("its router runs")

    def _start_router(self, row: Row, connection: HostConnection, prepared: Prepared) -> None:
        row.step = "starting its router"
        start_router(
            connection,
            self.fleet.fleet.name,
            prepared,
            self._timing.present_s,
            lambda: self._jobs.ended or self._jobs_first.ended,
        )

    def _bring(self, connection: HostConnection, row: Row) -> None:
        def say(text: str) -> None:
            row.step = text

        def before_changes() -> None:
            say("listening whether the fleet drives")
            if not self._listened.wait(self._timing.listen_s + 5.0):
                raise HostError("left as it was: this machine is too busy to hear whether the fleet drives")
            if self._foreign:
                raise HostError(
                    "left as it was: the fleet drives by another fleet file. `handfast stop` first, then up"
                )
            if not self._rolling:
                self._refuse_unheard(connection)
            self._before_changes(row.host)

        if self._keys is not None:
            say("asking which authority its robots have")
            self._refuse_another_authority(self._keys, connection, self._jobs)
        prepared = prepare(connection, self.fleet, self._text, self._program, say, self._keys, before_changes)
        self.warnings += [f"{row.host}: {warning}" for warning in prepared.warnings]
        what = self._start(row, connection, prepared)
        row.step = "looking for what is left"
        self.warnings += [f"{row.host}: {warning}" for warning in self._left_over(connection, prepared)]
        row.done(f"up, {what}")

    def _refuse_another_authority(self, keys: HostKeys, connection: HostConnection, jobs: HostJobs) -> None:
        """Raises `HostError` where the robots of a host have another authority; before this machine's has
        given any robot a certificate, also where those of any other host have: a fleet shall not have two."""
        is_first, name = keys.is_first, connection.host.name
        try:
            if found := keys.look(connection):
                self.warnings.append(f"{name}: its robots had another authority, {short(found)}")
        except AnotherAuthorityError:
            self._ruled.append(name)
            raise
        finally:
            self._asked.add(name)
        while is_first and not self._ruled and not jobs.ended:
            known = [row for row in jobs.rows.values() if row.state != DOING or row.host in self._asked]
            if len(known) >= min(len(jobs.rows), AT_ONCE_MAX):  # others begin when some of these have ended
                break
            time.sleep(self._timing.look_s)
        if is_first and self._ruled:
            raise HostError(f"left as it was: another authority rules on {', '.join(self._ruled)}")

    def _refuse_unheard(self, connection: HostConnection) -> None:
        """Raises `HostError` where the fleet is heard to stand, but a robot there says that it drives."""
        units = connection.ask("status", fleet=self.fleet.fleet.name)["units"]
        for robot in self.fleet.ids:
            about = units.get(systemd_units.unit_name(self.fleet.fleet.name, robot, "agent"), {})
            state = about.get("StatusText", "").partition(":")[0]
            if about.get("ActiveState") != "active" or state not in DRIVING_NAMES:
                continue
            if not (self._hears and self._arrivals.drives(robot)):
                raise HostError(
                    f"left as it was: robot {robot} drives, but is not heard here: `handfast stop` first, or "
                    "open the ports"
                )
            self._rolling = True  # it has begun just now

    def _start(self, row: Row, connection: HostConnection, prepared: Prepared) -> str:
        """Has those start that do not run as they should, and waits for all; says what was done."""
        starts = list(prepared.stale)
        left: list[int] = []
        since: dict[int, Mapping[str, float]] = {robot: {} for robot in row.robots}
        problems = self._renew_router(row, connection, prepared)
        if self._rolling:
            left = self._one_at_a_time(row, connection, prepared)
            since = {robot: {} for robot in row.robots if robot not in starts or robot in left}
        else:
            row.step = f"starting {robots_words(starts)}" if starts else "looking"
            if prepared.unwanted:
                connection.ask("remove", names=prepared.unwanted)
            if starts:
                self._lay_stop(connection)
            since |= self._restart(connection, prepared, starts)
        self._await(row, connection, since)
        if lacking := [robot for robot in row.robots if robot not in row.outcomes]:
            problems.append(self._why(connection, lacking))
        if left:
            self.left.update(left)
            problems.append(f"{robots_words(left)} left as before: {self._halted or 'interrupted'}")
        if problems:
            raise HostError("; ".join(problems))
        started = " and ".join(
            [robots_words(starts)] * bool(starts) + ["its router"] * bool(prepared.stale_router)
        )
        return f"{started} started" if started else "nothing to do"

    def _renew_router(self, row: Row, connection: HostConnection, prepared: Prepared) -> list[str]:
        """Has the router of a host run as it should; says what is wrong then. While the fleet drives, one at
        a time like the robots: the next one when all drive again that did before."""
        router = self.fleet.router_on(row.host)
        if router is None:
            return []
        try:
            if not self._rolling or not prepared.stale_router:
                self._start_router(row, connection, prepared)
            elif not self._renew_router_in_turn(row, connection, prepared):
                self.routers[router.number] = "left as before"
                return [f"its router left as before: {self._halted or 'interrupted'}"]
        except HostError as error:
            self.routers[router.number] = "NOT UP"
            return [str(error)]
        self.routers[router.number] = "up"
        return []

    def _renew_router_in_turn(self, row: Row, connection: HostConnection, prepared: Prepared) -> bool:
        row.step = "waiting for its turn to start its router again"
        with self._turn:
            if self._halted or self._jobs.ended:
                return False
            self._halted = f"the router on {row.host} did not come back"
            drove = [robot for robot in self.fleet.ids if self._arrivals.drives(robot)]
            self._start_router(row, connection, prepared)
            begun = time.monotonic()
            row.step = f"waiting for {robots_words(drove)} to drive again"
            deadline, idle_due = begun + self._timing.present_s, begun + self._timing.idle_s
            while time.monotonic() < deadline and not self._jobs.ended:
                if self._arrivals.driving:
                    idle_due = time.monotonic() + self._timing.idle_s
                if time.monotonic() >= idle_due or all(
                    self._arrivals.said_since(robot, begun) and self._arrivals.drives(robot)
                    for robot in drove
                ):
                    self._halted = ""
                    return True
                time.sleep(self._timing.look_s)
            raise HostError(f"{robots_words(drove)} did not all drive again after its router had started")

    def _one_at_a_time(self, row: Row, connection: HostConnection, prepared: Prepared) -> list[int]:
        """Has robots start again in their turns; gives those that were left as they were."""
        left = []
        if prepared.unwanted:
            with self._turn:
                if not self._halted:
                    connection.ask("remove", names=prepared.unwanted)
        for robot in prepared.stale:
            row.step = f"waiting for its turn to start robot {robot} again"
            with self._turn:
                if self._halted or self._jobs.ended:
                    left.append(robot)
                    continue
                self._halted = f"robot {robot} did not come back"  # also where its host dies in its turn
                row.step = f"starting robot {robot} again"
                drove = self._arrivals.drives(robot)
                since = self._restart(connection, prepared, [robot])
                if self._await(row, connection, since, drives=drove):
                    self._halted = ""
        return left

    def _restart(
        self, connection: HostConnection, prepared: Prepared, robots: Sequence[int]
    ) -> dict[int, dict[str, float]]:
        """Has robots start by the units that they should have.

        Returns:
            By robot, since when which of its processes are new, of those that are heard on the bus.
        """
        begun = time.monotonic()
        name = self.fleet.fleet.name
        if robots:
            texts = {unit: text for robot in robots for unit, text in prepared.units[robot].items()}
            connection.ask("units", wanted=texts)
            connection.ask("restart", names=[unit for robot in robots for unit in prepared.stale[robot]])
        return {
            robot: {
                role: begun
                for role in ROLES
                if systemd_units.unit_name(name, robot, role) in prepared.stale[robot]
            }
            for robot in robots
        }

    def _await(
        self,
        row: Row,
        connection: HostConnection,
        since: Mapping[int, Mapping[str, float]],
        *,
        drives: bool = False,
    ) -> bool:
        """Waits until robots are heard on the bus, or a process of those that are not will not start.

        Args:
            since: by robot, see `Arrivals.is_here`.
            drives: they must drive, too; unless nothing of the fleet drives any more.

        Returns:
            Whether all of them are there.
        """
        waiting = dict(since)
        now = time.monotonic()
        deadline, look_due, idle_due = (
            now + self._timing.present_s,
            now + self._timing.units_period_s,
            now + self._timing.idle_s,
        )
        while waiting and now < deadline and not self._jobs.ended:
            row.step = f"waiting for {robots_words(list(waiting))} on the bus"
            here = [robot for robot in waiting if self._arrivals.is_here(robot, waiting[robot])]
            if self._arrivals.driving or not here or not all(map(self._arrivals.settled, here)):
                idle_due = now + self._timing.idle_s
            for robot in here:
                if not drives or self._arrivals.drives(robot) or now >= idle_due:
                    row.outcomes[robot] = self._arrivals.says(robot)
                    del waiting[robot]
            if waiting and now >= look_due:
                look_due = now + self._timing.units_period_s
                for robot in self._failed(connection, waiting):
                    del waiting[robot]
            if waiting:
                time.sleep(self._timing.look_s)
            now = time.monotonic()
        return all(robot in row.outcomes for robot in since)

    def _failed(self, connection: HostConnection, robots: Iterable[int]) -> list[int]:
        """Robots of which a process has failed and will not start again by itself."""
        states = self._states(connection, robots)
        return sorted({robot for (robot, _), state in states.items() if state.startswith("failed")})

    def _states(
        self, connection: HostConnection, robots: Iterable[int], roles: Sequence[str] = ROLES
    ) -> dict[tuple[int, str], str]:
        """State of the systemd unit of each process (robot, role)."""
        name = self.fleet.fleet.name
        names = {
            (robot, role): systemd_units.unit_name(name, robot, role) for robot in robots for role in roles
        }
        states = connection.ask("states", names=list(names.values())) if names else {}
        return {process: states[unit] for process, unit in names.items()}

    def _why(self, connection: HostConnection, robots: Sequence[int]) -> str:
        """Why robots are not there: what their processes said last."""
        needed = [role for role in systemd_units.roles(self.fleet) if role != systemd_units.RECORDER]
        states = self._states(connection, robots, needed)
        wrong = {process: state for process, state in states.items() if state != "active"}
        lines = [self._last_words(connection, *process, state) for process, state in wrong.items()]
        silent = [robot for robot in robots if all((robot, role) not in wrong for role in needed)]
        if silent:
            lines.append(
                f"{robots_words(silent)}: running there, but not heard here: is the port open "
                f"({self.fleet.agent_endpoint(silent[0])} and so on)?"
            )
        return "; ".join(lines)

    def _last_words(self, connection: HostConnection, robot: int, role: str, state: str) -> str:
        unit = systemd_units.unit_name(self.fleet.fleet.name, robot, role)
        lines = connection.ask("last_lines", name=unit, count=1)
        return f"robot {robot}'s {role} is {state}{f': {lines[-1]}' if lines else ''}"

    def _left_over(self, connection: HostConnection, prepared: Prepared) -> list[str]:
        """Removes what nothing needs any more; says what is still wrong though all robots are there."""
        warnings = []
        recorders = [role for role in systemd_units.roles(self.fleet) if role not in ROLES]
        try:
            for (robot, role), state in self._states(connection, prepared.stale, recorders).items():
                if state not in ("active", "activating"):
                    warnings.append(self._last_words(connection, robot, role, state))
            connection.ask("tidy", keep=[prepared.version])
        except HostError as error:
            warnings.append(f"versions that nothing needs may still be there: {error}")
        return warnings
