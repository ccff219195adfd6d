"""Checks the vehicles of a fleet that is up on its hosts, before a drive.

Bridges run there as units and report on the bus. Of a bridge that says nothing its host is asked over ssh.
Nothing is ordered and no bridge is started: a fleet that drives goes on as it did.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack
from typing import Any, Final

from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Checks, Message
from handfast.agent.transport.bus import BusError
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.drive.preflight import BOOT_TIMEOUT_S, TIMEOUT_S, Found
from handfast.deploy.drive.readiness import BLOCKING, Line, VehicleChecks
from handfast.deploy.hosts import systemd_units
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.hosts.jobs import FAILED, HostJobs, Row
from handfast.deploy.session.session import INBOX, POLL_S, Session

QUIET_S: Final = 4.0
"""A bridge says its checks once a second: for whom nothing came for so long, its host is asked."""
HOSTS_TIMEOUT_S: Final = 30.0
TOO_LATE: Final = "it has not answered in time"
SAYS_MAX: Final = 200


class HostsPreflight:
    """Listens to the bridges of `fleet`.

    Args:
        fleet: resolved and located.
        file: the fleet's, as it is named in commands.
    """

    def __init__(self, fleet: Fleet, file: str, interrupt: Interrupt) -> None:
        self._fleet, self._file, self._interrupt = fleet, file, interrupt
        self._checks = VehicleChecks(fleet)
        self._heard: dict[int, float] = {}
        """When a robot's bridge was heard last, monotonic time (s)."""
        self._told: dict[int, Line] = {}
        """What is known of those that are not heard."""
        self._starting: set[int] = set()
        """Those of them that run: they may still be heard."""
        self._jobs: HostJobs | None = None
        self._asked_s = 0.0

    def run(self) -> Found:
        """What the vehicles tell; ends early when interrupted.

        Raises:
            handfast.deploy.console.arguments.InputError: this operator may not hear the fleet.
        """
        with ExitStack() as stack:
            session = None
            if self._checks.robots:
                try:
                    session = stack.enter_context(_Ear(self._fleet, self._feed, self._interrupt))
                except BusError as error:  # its hosts know why
                    if not self._interrupt.count:
                        print(f"handfast: {error}", file=sys.stderr)
                self._listen(session, stack)
        return {robot: self._lines(robot) for robot in self._fleet.ids}

    def _feed(self, now_ns: int, key: str, message: Message) -> None:
        self._checks.feed(now_ns, key, message)
        if type(message) is Checks and self._checks.lines(message.robot):
            self._heard[message.robot] = time.monotonic()

    def _silent(self, now: float) -> list[int]:
        """Robots whose bridges are not heard."""
        return [robot for robot in self._checks.robots if now - self._heard.get(robot, -QUIET_S) >= QUIET_S]

    def _lines(self, robot: int) -> list[Line]:
        lines = list(self._checks.lines(robot))
        if robot in self._checks.robots and robot in self._silent(time.monotonic()):
            before = f"was heard, and is silent for {QUIET_S:.0f} s" if lines else "said nothing"
            lines = [self._told.get(robot) or Line("bridge", BLOCKING, before, self._logs(robot))]
        return lines

    def _listen(self, session: _Ear | None, stack: ExitStack) -> None:
        begun = time.monotonic()
        while not self._interrupt.count:
            if session is not None:
                session.collect()
            now = time.monotonic()
            silent = self._silent(now)
            if silent and self._jobs is None and (session is None or now - begun >= QUIET_S):
                self._jobs = stack.enter_context(self._ask(silent))
                self._asked_s = now
            hosts_told = self._jobs is None or self._hosts_told(silent, now)
            if hosts_told and self._is_over(session, silent, now - begun):
                return
            time.sleep(POLL_S)

    def _is_over(self, session: _Ear | None, silent: Collection[int], listened_s: float) -> bool:
        """Return True if nothing more is to come, once the hosts have answered, or it takes too long."""
        if session is None:
            return True
        told = {robot for robot in silent if robot in self._told and robot not in self._starting}
        if len(told) < len(silent):
            return listened_s > TIMEOUT_S
        if self._checks.complete(session.now_ns(), told):
            return True
        return listened_s > (BOOT_TIMEOUT_S if self._checks.booting(told) else TIMEOUT_S)

    def _hosts_told(self, silent: Collection[int], now: float) -> bool:
        """Whether the hosts have said all that they were asked, or are not waited for any more."""
        assert self._jobs is not None
        if self._jobs.busy:
            if silent and now - self._asked_s < HOSTS_TIMEOUT_S:
                return False
            self._jobs.end(TOO_LATE)
        for row in self._jobs.rows.values():
            for robot in row.robots:
                if row.state == FAILED and robot not in self._told:
                    advice = f"switch it on or bring it into reach, then `handfast up {self._file}`"
                    where = f"its host {row.host} cannot be asked: {row.step}"
                    self._told[robot] = Line("bridge", BLOCKING, where, advice)
        return not self._jobs.busy

    def _ask(self, silent: Collection[int]) -> HostJobs:
        """Has the hosts of these robots asked what their bridges do."""
        names = {self._fleet.robot(robot).host for robot in silent}
        name = self._fleet.fleet.name

        def ask(connection: HostConnection, row: Row) -> None:
            units = connection.ask("status", fleet=name)["units"]
            for robot in row.robots:
                if robot not in self._checks.robots:
                    continue
                about = units.get(systemd_units.unit_name(name, robot, "plant"), {})
                if not isinstance(about, Mapping):
                    raise HostError("what it says of its units makes no sense")
                if about.get("ActiveState") in ("active", "activating"):
                    self._starting.add(robot)
                self._told[robot] = self._line(robot, row.host, about)

        return HostJobs(self._fleet, [host for host in self._fleet.hosts if host.name in names], ask)

    def _line(self, robot: int, host: str, about: Mapping[str, Any]) -> Line:
        """What the host says of a bridge that is not heard."""
        state, result = str(about.get("ActiveState") or ""), str(about.get("Result") or "success")
        if not state:
            return Line("bridge", BLOCKING, "is not up on its host", f"`handfast up {self._file}`")
        says = printable(str(about.get("StatusText") or ""))[:SAYS_MAX]
        words = f": {says}" if says else ""
        if state == "active":
            endpoint = self._fleet.plant_endpoint(robot)
            advice = f"open the port ({endpoint}) to this computer, or see {self._logs(robot)}"
            return Line("bridge", BLOCKING, f"runs on {host}, but is not heard here{words}", advice)
        how = "" if result == "success" else f" ({printable(result)})"
        advice = f"see {self._logs(robot)}; then `handfast up {self._file}`"
        return Line("bridge", BLOCKING, f"is {printable(state)}{how} on {host}{words}", advice)

    def _logs(self, robot: int) -> str:
        return f"`handfast logs {self._file} --robot {robot}`"


class _Ear(Session):
    """On the bus of a fleet, hearing the checks of its vehicles."""

    def __init__(
        self, fleet: Fleet, takes: Callable[[int, str, Message], None], interrupt: Interrupt
    ) -> None:
        super().__init__(fleet, is_wanted=lambda: not interrupt.count)
        self._takes = takes
        self.bus.subscribe(key_expressions.checks(fleet.fleet.name, "*"), INBOX)

    def feed(self, key: str, message: Message) -> None:
        self._takes(self.now_ns(), key, message)
