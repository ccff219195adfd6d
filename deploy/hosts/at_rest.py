"""Whether a fleet on its hosts is at rest: what its robots say on the bus, and what their hosts say."""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from typing import Final, NamedTuple

from handfast.agent.fleet.model import Fleet
from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.agent.transport.bus import BusError
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.wording import robots as robots_words
from handfast.deploy.hosts.arrivals import Arrivals
from handfast.deploy.hosts.artifacts import systemd_units
from handfast.deploy.hosts.connection import HostConnection
from handfast.deploy.hosts.jobs import HostJobs
from handfast.deploy.hosts.view import Row
from handfast.deploy.inventory.hosts import hosts_of, located

LISTEN_S: Final = 2.0
LOOK_S: Final = 0.05
HOSTS_TIMEOUT_S: Final = 60.0
TOO_LATE: Final = "it has not answered in time"
ON_MISSION: Final = DRIVING_NAMES | {State.HOLDING.value, State.RELEASED.value}
"""States of robots on a mission: those that hold may drive on by themselves."""


class Rest(NamedTuple):
    """Robots on a mission, and those of which nobody knows; all others stand, or do not run."""

    on_mission: tuple[int, ...]
    unknown: tuple[int, ...]

    def refusal(self) -> str:
        """Why nothing may be done that needs the fleet at rest, "" when it may."""
        if self.on_mission:
            are = "are" if len(self.on_mission) > 1 else "is"
            return (
                f"{robots_words(self.on_mission)} {are} on a mission: `handfast stop` first (or, where "
                "that is not to be believed, --force)"
            )
        if self.unknown:
            return (
                f"{robots_words(self.unknown)} cannot be asked, neither on the bus nor over ssh: bring them "
                "into reach, or see that they stand and say --force"
            )
        return ""


def rest_of(fleet: Fleet, source: str) -> Rest:
    """Asks robots and hosts, side by side.

    Args:
        fleet: resolved.
        source: the fleet file's name, for messages.
    """
    on_hosts = any(robot.host is not None for robot in fleet.robots)
    fleet = located(fleet) if on_hosts else fleet
    told: dict[int, bool] = {}

    def ask(connection: HostConnection, row: Row) -> None:
        units = connection.ask("status", fleet=fleet.fleet.name)["units"]
        for robot in row.robots:
            about = units.get(systemd_units.unit_name(fleet.fleet.name, robot, "agent"), {})
            state = str(about.get("StatusText", "")).partition(":")[0]
            told[robot] = about.get("ActiveState") == "active" and state in ON_MISSION

    with ExitStack() as stack:
        arrivals = None
        with suppress(BusError, InputError):  # such as without a certificate: ssh is the other way
            arrivals = stack.enter_context(Arrivals(fleet))
        jobs = stack.enter_context(HostJobs(fleet, hosts_of(fleet, source), ask)) if on_hosts else None
        listen_until = time.monotonic() + LISTEN_S
        ask_until = time.monotonic() + HOSTS_TIMEOUT_S
        while (now := time.monotonic()) < ask_until:
            if arrivals is not None:
                arrivals.look()
                if all(robot in arrivals.statuses for robot in fleet.ids):
                    break
            if (arrivals is None or now >= listen_until) and (jobs is None or not jobs.busy):
                break
            time.sleep(LOOK_S)
        heard = {} if arrivals is None else {robot: each.state for robot, each in arrivals.statuses.items()}
        if jobs is not None:
            jobs.end(TOO_LATE)
    known = told | {robot: state in ON_MISSION for robot, state in heard.items()}
    return Rest(
        tuple(robot for robot in fleet.ids if known.get(robot)),
        tuple(robot for robot in fleet.ids if robot not in known),
    )
