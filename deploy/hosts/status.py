"""What is known of each process of a fleet, on its hosts or on this machine, as rows and as a table."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import CLOCK_SKEW_MAX_S
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import Status
from handfast.agent.security.certificates import DAY_S, until
from handfast.agent.security.identity import Identity, IdentityError, of_robot, of_router, parse
from handfast.agent.supervision.state_machine import State
from handfast.deploy.console.wording import FEW, robots
from handfast.deploy.drive.display.fleet_table import STYLES
from handfast.deploy.hosts import systemd_units
from handfast.deploy.hosts.certificates import identities_on
from handfast.deploy.hosts.connection import Clock, HostError
from handfast.deploy.inventory.expiry import Expiry
from handfast.deploy.inventory.known_fleets import KnownFleet
from handfast.deploy.inventory.registry import Running
from handfast.deploy.processes.running import PAUSED, fleet_processes, last_words, state_of
from handfast.deploy.recording.run_files import LOG_FOLDER

HERE: Final = "here"
QUIET: Final = "-"
PIPE_WIDTH: Final = 240
_NOT_WELL: Final = (State.DEGRADED, State.HOLDING, State.RELEASED, State.FAULT)
WELL: Final = frozenset(state.value for state in State if state not in _NOT_WELL)
"""States of agents in which nothing is wrong."""
_WORDS: Final = ("ActiveState", "Result", "StatusText", "version")
_NUMBERS: Final = ("cpu_s", "age_s", "memory_bytes")


@dataclass
class HostStatus:
    """What a host says: of its units (`deploy.hosts.remote_program.status`; of processes here
    `deploy.hosts.this_machine`), its clock and load."""

    units: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    clock: Clock | None = None
    load: float | None = None
    error: str = ""
    expiries: Mapping[Identity, float] = field(default_factory=dict)
    """Until when certificates of robots and routers hold, s since the Unix epoch, as their host says."""


def host_status(answer: Mapping[str, Any], clock: Clock) -> HostStatus:
    """What a host said, once it is found to make sense.

    Raises:
        HostError: it does not.
    """
    try:
        found = {
            str(name): {
                **{word: str(about[word]) for word in _WORDS if word in about},
                **{number: float(about[number]) for number in _NUMBERS if number in about},
                "NRestarts": int(about.get("NRestarts") or 0),
            }
            for name, about in answer["units"].items()
        }
        expiries = _expiries({str(name): str(pem) for name, pem in answer["certificates"].items()})
        return HostStatus(found, clock, float(answer["load"]), expiries=expiries)
    except (TypeError, ValueError, LookupError, AttributeError, OverflowError) as error:
        raise HostError(f"what it says of its units makes no sense ({type(error).__name__})") from None


def _expiries(certificates: Mapping[str, str]) -> dict[Identity, float]:
    found = {}
    for name, pem in certificates.items():
        ends_s = until(pem.encode(errors="replace"))
        with suppress(IdentityError):
            identity = parse(name.removesuffix(".crt"))
            if ends_s is not None:
                found[identity] = ends_s
    return found


def host_rows(found: Mapping[str, HostStatus]) -> dict[str, dict[str, Any]]:
    """What is known of each host, JSON values."""
    return {
        name: {
            "error": each.error,
            "clock_offset_s": None if each.clock is None else each.clock.offset_s,
            "clock_error_s": None if each.clock is None else each.clock.error_s,
            "load": each.load,
        }
        for name, each in found.items()
    }


def expiries_on_hosts(fleet: Fleet, found: Mapping[str, HostStatus], file: str) -> list[Expiry]:
    """Until when certificates of robots and routers hold, as their own hosts say: the word of a host on
    others counts for nothing.

    Args:
        file: the fleet's, as it is named in commands.
    """
    ends = {
        identity: found[host.name].expiries[identity]
        for host in fleet.hosts
        if host.name in found
        for identity in identities_on(fleet, host).values()
        if identity in found[host.name].expiries
    }
    ordered = sorted(ends, key=lambda identity: (identity.role, int(identity.name)))
    return [Expiry(str(identity), ends[identity], f"`handfast up {file}`") for identity in ordered]


def process_row(
    fleet: Fleet, robot: int, role: str, host: HostStatus, status: Status | None, now_s: float
) -> dict[str, Any]:
    """What is known of a process of a robot, JSON values; None where it is not.

    Args:
        now_s: the present, wall time.
    """
    name = fleet.fleet.name
    row = _row(systemd_units.unit_name(name, robot, role), host)
    row |= {"robot": robot, "host": fleet.robot(robot).host, "role": role}
    if (ends_s := host.expiries.get(of_robot(name, robot))) is not None:
        row["certificate_days"] = _days(ends_s, now_s)
    if role == "agent" and status is not None:
        ages = [age_us for _, age_us, *_ in status.neighbours if age_us >= 0]
        row |= {
            "state": status.state,
            "reason": status.reason,
            "oldest_ms": max(ages) / 1e3 if ages else None,
        }
    return row


def router_rows(fleet: Fleet, host: HostSection, found: HostStatus, now_s: float) -> list[dict[str, Any]]:
    """As `process_row`, of the router on a host, if it has one."""
    name, router = fleet.fleet.name, fleet.router_on(host.name)
    if router is None:
        return []
    row = _row(systemd_units.router_unit_name(name), found)
    row |= {"host": host.name, "role": systemd_units.ROUTER}
    if (ends_s := found.expiries.get(of_router(name, router.identity_name))) is not None:
        row["certificate_days"] = _days(ends_s, now_s)
    return [row]


def _days(ends_s: float, now_s: float) -> float:
    return round((ends_s - now_s) / DAY_S, 1)


def _row(unit: str, host: HostStatus) -> dict[str, Any]:
    """What a host says of a unit."""
    about = host.units.get(unit, {})
    return {
        "robot": None,
        "host": None,
        "role": "",
        "unit": about.get("ActiveState") or ("unknown" if host.error else "none"),
        "result": about.get("Result"),
        "restarts": about.get("NRestarts"),
        "cpu_percent": 100.0 * about["cpu_s"] / about["age_s"] if about.get("age_s") else None,
        "memory_mb": about["memory_bytes"] / 1e6 if "memory_bytes" in about else None,
        "up_s": about.get("age_s"),
        "version": about.get("version") or None,
        "says": about.get("StatusText") or None,
        "state": None,
        "reason": None,
        "oldest_ms": None,
        "certificate_days": None,
    }


_COLUMNS: Final[tuple[tuple[str, Literal["left", "right"]], ...]] = (
    ("robot", "right"),
    ("host", "left"),
    ("process", "left"),
    ("unit", "left"),
    ("restarts", "right"),
    ("up", "right"),
    ("CPU %", "right"),
    ("MB", "right"),
    ("state", "left"),
    ("oldest ms", "right"),
)
"""Headings of the table, and how their columns are aligned."""


def print_table(
    rows: Sequence[Mapping[str, Any]],
    found: Mapping[str, HostStatus],
    *,
    each: bool = False,
) -> None:
    """Print the table, a line for each host, and the versions that robots run.

    Args:
        each: also where there are many robots; else of these only those are shown where something is wrong,
            and the rest is summed up.
    """
    versions = _versions(rows)
    sums: list[str] = []
    if not each and len(_robots(rows)) > FEW:
        sums = _sums(rows, found)
        rows, found = _wrong(rows, found)
    # A pipe has no width of its own: there each process is one line, however long.
    width = None if sys.stdout.isatty() else PIPE_WIDTH
    console = Console(highlight=False, soft_wrap=True, width=width)
    if rows:
        console.print(_table(rows))
    for name, host in found.items():
        _print_host(console, name, host)
    if len(versions) > 1:
        who = "; ".join(f"{name}: {robots(sorted(ids))}" for name, ids in sorted(versions.items()))
        console.print(
            f"not all robots run the same ({who}): `handfast up` again", style="bold red", markup=False
        )
    elif versions:
        sums = [f"version {next(iter(versions))}", *sums]
    for line in sums:
        console.print(line, markup=False)


def _versions(rows: Sequence[Mapping[str, Any]]) -> dict[str, set[int]]:
    """Return the robots that run each version, without its last part, which differs between processors."""
    versions: dict[str, set[int]] = {}
    for row in rows:
        if row["version"] and row["robot"] is not None:
            versions.setdefault(printable(row["version"]).rpartition("-")[0], set()).add(row["robot"])
    return versions


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(pad_edge=False, box=None)
    for heading, side in _COLUMNS:
        table.add_column(heading, justify=side, no_wrap=True)
    table.add_column("why")
    for row in rows:
        state = row["state"] or (QUIET if row["role"] != "agent" else "silent")
        unit = row["unit"] if row["result"] in (None, "success") else f"{row['unit']} ({row['result']})"
        why = (row["reason"] if row["state"] else row["says"]) or ""
        table.add_row(
            _shown(row["robot"], "d"),
            row["host"] or HERE,
            row["role"],
            Text(printable(unit), style="" if row["unit"] == "active" else "bold red"),
            _shown(row["restarts"], "d"),
            _span(row["up_s"]),
            _shown(row["cpu_percent"], ".1f"),
            _shown(row["memory_mb"], ".0f"),
            Text(printable(state), style=STYLES.get(state, "")),
            _shown(row["oldest_ms"], ".0f"),
            Text(printable(why)),  # anybody's words
        )
    return table


def _print_host(console: Console, name: str, host: HostStatus) -> None:
    if host.error:
        console.print(f"{name}: {host.error}", style="bold red", markup=False)
    elif host.clock is not None:
        offset_ms, error_ms = host.clock.offset_s * 1e3, host.clock.error_s * 1e3
        way = "ahead" if offset_ms > 0 else "behind"
        console.print(
            f"{name}: clock {abs(offset_ms):.1f} ms {way} (within {error_ms:.1f} ms), load {host.load:.1f}",
            markup=False,
        )


def _robots(rows: Sequence[Mapping[str, Any]]) -> set[int]:
    return {row["robot"] for row in rows if row["robot"] is not None}


def _wrong(
    rows: Sequence[Mapping[str, Any]], found: Mapping[str, HostStatus]
) -> tuple[list[Mapping[str, Any]], dict[str, HostStatus]]:
    """Return the rows and hosts where something is wrong."""
    is_heard = any(row["state"] for row in rows)
    hosts = {name: host for name, host in found.items() if host.error or _is_off(host.clock)}
    wrong = [
        row
        for row in rows
        if (row["unit"] != "active" and row["host"] not in hosts)
        or (row["role"] == "agent" and is_heard and row["state"] not in WELL)
    ]
    return wrong, hosts


def _sums(rows: Sequence[Mapping[str, Any]], found: Mapping[str, HostStatus]) -> list[str]:
    """Return lines that sum up all processes, agents and hosts."""
    is_heard = any(row["state"] for row in rows)
    units = Counter(printable(row["unit"]) for row in rows)
    states = Counter(printable(row["state"] or "silent") for row in rows if row["role"] == "agent")
    lines = [
        f"{len(rows)} processes of {len(_robots(rows))} robots: {_counted(units)}",
        f"agents: {_counted(states)}" if is_heard else "agents: none is heard",
    ]
    clocks = [host.clock for host in found.values() if host.clock is not None]
    if clocks:
        off_ms = max(abs(clock.offset_s) for clock in clocks) * 1e3
        load = max(host.load or 0.0 for host in found.values())
        lines.append(
            f"{len(clocks)} of {len(found)} hosts: clocks up to {off_ms:.1f} ms off, load up to {load:.1f}"
        )
    return lines


def _is_off(clock: Clock | None) -> bool:
    return clock is not None and abs(clock.offset_s) - clock.error_s > CLOCK_SKEW_MAX_S


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {what}" for what, count in counts.most_common())


def _shown(value: float | None, form: str) -> str:
    return QUIET if value is None else format(value, form)


def _span(seconds: float | None) -> str:
    if seconds is None:
        return QUIET
    if seconds < 60:
        return f"{seconds:.0f}s"
    if seconds < 3600:
        return f"{seconds / 60:.0f}min"
    return f"{seconds / 3600:.1f}h"


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
