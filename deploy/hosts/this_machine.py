"""This machine as a host: what it says of the processes of a fleet that runs here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.deploy.hosts.artifacts import systemd_units
from handfast.deploy.hosts.status import HostStatus
from handfast.deploy.inventory.known_fleets import KnownFleet
from handfast.deploy.inventory.registry import Running
from handfast.deploy.processes.log_files import last_words
from handfast.deploy.processes.table import PAUSED, fleet_processes, state_of
from handfast.deploy.recording.run_files import LOG_FOLDER


def logs_of(known: KnownFleet) -> Path | None:
    """The folder of the logs of a fleet that runs here; None where others started its processes."""
    for run in known.runs:
        if not run.attached:
            return Path(run.folder) / LOG_FOLDER
    return None


def run_words(run: Running) -> str:
    """A run and its process on one line."""
    what = "driven" if run.attached else "run"
    paused = f", PAUSED: `fg` there or `kill -CONT {run.pid}` lets it go on" * (state_of(run.pid) == PAUSED)
    return f"{what} by process {run.pid} since {run.started[11:]}{paused}: {run.folder}"


def this_machine(fleet: Fleet, fleet_file: Path, logs: Path | None) -> HostStatus:
    """What is known here of the agents and plants that read this fleet file.

    Args:
        logs: the folder of their logs, None where they have none.
    """
    processes = fleet_processes(fleet, fleet_file)
    units: dict[str, dict[str, Any]] = {}
    for robot in fleet.ids:
        for role in ROLES:
            about = units.setdefault(systemd_units.unit_name(fleet.fleet.name, robot, role), {})
            if logs is not None:
                about["StatusText"] = last_words(logs, robot, role)
            process = processes.get((robot, role))
            if process is not None:
                about |= {
                    "ActiveState": process.state,
                    "cpu_s": process.cpu_s,
                    "age_s": process.age_s,
                    "memory_bytes": float(process.memory_bytes),
                }
    return HostStatus(units)
