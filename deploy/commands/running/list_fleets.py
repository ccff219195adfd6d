"""The command ``handfast list``: which fleets run on this machine, and which were brought up on hosts."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import suppress
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

from agent.common.exit import FAILED, PASSED
from agent.common.wording import printable
from agent.fleet.loading import load_fleet
from agent.fleet.model import FleetError
from deploy.console.arguments import describe
from deploy.console.wording import some
from deploy.inventory.running import handled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from deploy.inventory.fleets_up import FleetUp
    from deploy.inventory.known_fleets import KnownFleet
    from deploy.inventory.registry import Running

HEADINGS: Final = ("fleet", "where", "robots", "since", "state", "process", "stop it with", "files")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast list`` takes."""
    describe(
        parser,
        ": what `handfast run` and `drive` of this user drive on this machine, and what `handfast up` has "
        "brought up on hosts and `down` has not taken down. Nobody is asked over the network: "
        "`handfast status` does that. Exit status: 0 fine; 1 something that is there cannot be told; 2 bad "
        "input.",
    )
    parser.add_argument("--json", action="store_true", help="for programs: one JSON document")
    parser.set_defaults(command=handled(_list))


def _list(options: argparse.Namespace) -> int:
    from deploy.inventory.known_fleets import NONE, known, unreadable

    rows, damaged = [row(fleet) for fleet in known()], unreadable()
    if options.json:
        print(json.dumps({"fleets": rows, "unreadable": damaged}, indent=2))
    elif rows:
        print(*table(rows), sep="\n")
    else:
        print(f"{NONE}, and none is up on hosts")
    for line in () if options.json else damaged:
        print(f"handfast: {line}", file=sys.stderr)
    return FAILED if damaged else PASSED


def row(fleet: KnownFleet) -> dict[str, Any]:
    """What is known of a fleet, JSON values."""
    up, runs = fleet.up, fleet.runs
    states = [_state(run) for run in runs]
    if up is not None:
        lacking = [host.name for host in up.hosts if not host.complete]
        states.append(f"up (perhaps not on {some(lacking)})" if lacking else "up")
    return {
        "fleet": fleet.name,
        "hosts": fleet.hosts or None,
        "robots": [robot.id for robot in fleet.robots] if up is None else up.robots,
        "since": min([run.started for run in runs] + ([] if up is None else [up.since])),
        "state": ", ".join(states),
        "processes": [run.pid for run in runs],
        "folder": runs[-1].folder if runs else None,
        "source": next(filter(None, [up.source if up else "", *(run.source for run in runs)]), None),
        "fleet_file": str(fleet.fleet_file),
        "stop": f"handfast stop {quote(fleet.selector)}",
        "down": None if up is None else f"handfast down {quote(_down_file(up))}",
    }


def _state(run: Running) -> str:
    from deploy.processes.table import PAUSED, state_of

    paused = " (PAUSED: `fg` there)" if state_of(run.pid) == PAUSED else ""
    return f"{'driven' if run.attached else 'running'}{paused}"


def _down_file(up: FleetUp) -> str:
    """The file that `up` was given, while it has the hosts that it had then; else what was kept of it."""
    with suppress(FleetError):
        fleet = load_fleet(up.source)
        there = {robot.host for robot in fleet.robots}
        if fleet.fleet.name == up.name and there.issuperset(host.name for host in up.hosts):
            return up.source
    return str(up.fleet_file)


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each fleet, after the headings. Nothing is cut: commands are there to be copied."""
    cells = [HEADINGS] + [
        (
            row["fleet"],
            some(row["hosts"] or ["here"]),
            str(len(row["robots"])),
            row["since"].replace("T", " "),
            row["state"],
            ", ".join(map(str, row["processes"])) or "-",
            row["stop"],
            row["folder"] or row["source"] or row["fleet_file"],
        )
        for row in rows
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(map(str.ljust, each, widths)).rstrip() for each in cells]
    downs = [f"take {row['fleet']} down with: {row['down']}" for row in rows if row["down"] is not None]
    return list(map(printable, lines + downs))
