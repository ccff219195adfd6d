"""What the processes of a fleet on its hosts have been granted of real time, by looking at them there."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.runtime.realtime_granted import Granted, from_json
from handfast.deploy.drive.realtime import NAME, lines
from handfast.deploy.drive.vehicle_checks import WARNING, Line, sentences
from handfast.deploy.faults.process_actions import Process
from handfast.deploy.hosts.artifacts import systemd_units
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.inventory.hosts import robots_on

MODULE: Final = "handfast.agent.runtime.realtime_granted"


def granted_on(connection: HostConnection, fleet: Fleet) -> dict[Process, Granted | None]:
    """What the agents and plants on a host have, of those that run.

    Raises:
        HostError: it cannot be asked, or what it says makes no sense.
    """
    name = fleet.fleet.name
    units = connection.ask("status", fleet=name)["units"]
    pids: dict[Process, str] = {}
    version = ""
    try:
        for robot in robots_on(fleet, connection.host):
            for role in ROLES:
                about = units.get(systemd_units.unit_name(name, robot, role), {})
                if about.get("ActiveState") == "active" and about.get("version"):
                    pids[robot, role], version = str(int(about["MainPID"])), str(about["version"])
        if not pids:
            return {}
        told = connection.ask("run", module=MODULE, arguments=list(pids.values()), version=version)
        found = [from_json(json.loads(line)) for line in told.splitlines()]
        return dict(zip(pids, found, strict=True))
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise HostError(f"what it says of its processes makes no sense ({type(error).__name__})") from None


def lines_on(connection: HostConnection, fleet: Fleet) -> dict[int, list[Line]]:
    """Lines of a preflight, by robot (`deploy.drive.realtime.lines`); raises as `granted_on`."""
    return lines(fleet.process, granted_on(connection, fleet), as_units=True)


def warnings(found: dict[int, list[Line]]) -> list[str]:
    """Sentences about what was not granted; one that several robots share is said once."""
    return sentences((line, robot) for robot, each in found.items() for line in each if line.level == WARNING)


def unknown(robots: Iterable[int], why: str) -> dict[int, list[Line]]:
    """Lines of robots whose host cannot be asked."""
    return {robot: [Line(NAME, WARNING, f"cannot be looked at: {why}", "")] for robot in robots}
