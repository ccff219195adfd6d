"""The command ``handfast status``: the fleets that there are, or what each process of one fleet does."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict
from shlex import quote
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.common.wording import printable
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.console.arguments import InputError, describe, host_argument, refuse_hosts
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.wording import FEW, aligned, some
from handfast.deploy.inventory.known_fleets import MEANING, handled

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from handfast.agent.fleet.hosts import HostSection
    from handfast.agent.messages.types import Status
    from handfast.deploy.analysis.silence import SilentBody
    from handfast.deploy.hosts.status import HostStatus
    from handfast.deploy.inventory.expiry import Expiry
    from handfast.deploy.inventory.known_fleets import KnownFleet
    from handfast.deploy.inventory.registry import FleetUp, Running
    from handfast.deploy.session.operator_session import OperatorSession

HEADINGS: Final = ("fleet", "where", "robots", "since", "state", "process", "stop it with", "files")
LISTEN_S: Final = 2.0
HOSTS_TIMEOUT_S: Final = 60.0
LOOK_S: Final = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast status`` takes."""
    describe(
        parser,
        ". Without FLEET: what `handfast run` and `drive` of this user drive on this machine, and what "
        "`handfast up` has brought up on hosts and `down` has not taken down; no robot is asked. With FLEET: "
        "for each process its unit, how often it was started again, CPU and memory "
        "(as the host says, over ssh; here, as the table of processes has them); state of its "
        "agent, age of its neighbours' messages (as it says, on the bus); version; how its host's clock "
        "stands to this one; how long certificates hold; robots that are not heard, and where the others "
        "believe them to be; a mission that is older than the last stop. "
        f"{MEANING} Exit status: 0 all processes run and all agents are heard, or all fleets are listed; 1 "
        "not all; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("fleet", nargs="?", metavar="FLEET", help="a running fleet (default: list all)")
    host_argument(parser)
    parser.add_argument(
        "--each",
        action="store_true",
        help=f"a row for each process also of more than {FEW} robots; else of these only where something is "
        "wrong",
    )
    parser.add_argument("--json", action="store_true", help="for programs: one JSON document")
    parser.set_defaults(command=handled(_status))


def wait_for(look: Callable[[], bool], timeout_s: float) -> bool:
    """As `deploy.session.session.Session.wait`, without a session."""
    deadline = time.monotonic() + timeout_s
    while not look():
        if time.monotonic() >= deadline:
            return False
        time.sleep(LOOK_S)
    return True


def _status(options: argparse.Namespace) -> int:
    if options.fleet is None:
        return _list(options)
    from handfast.agent.formation.geometry import resolved
    from handfast.deploy.analysis.silence import in_words
    from handfast.deploy.hosts.status import host_rows, print_table
    from handfast.deploy.inventory.expiry import summary
    from handfast.deploy.inventory.hosts import hosts_of, located
    from handfast.deploy.inventory.known_fleets import find

    interrupt = Interrupt()
    with interrupt.caught():
        known = find(options.fleet)
        fleet = resolved(known.fleet)
        if known.on_hosts:
            hosts = hosts_of(fleet, str(known.fleet_file), options.hosts)
            seen = _on_hosts(located(fleet), hosts, options.fleet, interrupt)
        else:
            refuse_hosts(fleet, options)
            seen = _here(fleet, known, interrupt)
    if interrupt.count:
        return INTERRUPTED
    now_s = time.time()
    if options.json:
        about = {
            "fleet": fleet.fleet.name,
            "hosts": host_rows(seen.hosts),
            "processes": seen.rows,
            "silent": [body.row for body in seen.bodies],
            "runs": [asdict(run) for run in known.runs],
            "certificates": [{"who": each.who, "days": round(each.days(now_s), 1)} for each in seen.expiries],
            "older_mission": seen.older_mission,
        }
        print(json.dumps(about, indent=2))
    else:
        print_table(seen.rows, seen.hosts, each=options.each)
        for line in (*seen.lines, *in_words(seen.bodies), *summary(seen.expiries, now_s)):
            print(line)
        if seen.older_mission:
            print(seen.older_mission)
    good = all(row["unit"] == "active" and (row["role"] != "agent" or row["state"]) for row in seen.rows)
    return PASSED if good else FAILED


class Seen(NamedTuple):
    """What is known of a fleet: a row for each process, what its hosts say of themselves, bodies that are not
    heard, a mission that is older than the last stop, more lines for people, and how long certificates hold.
    """

    rows: Sequence[Mapping[str, Any]]
    hosts: Mapping[str, HostStatus]
    bodies: Sequence[SilentBody]
    older_mission: str
    lines: Sequence[str] = ()
    expiries: Sequence[Expiry] = ()


class Ears:
    """An ear on a fleet's bus, deaf where that cannot be opened. A context manager.

    Attributes:
        statuses: what each agent said last.
        session: None where it is deaf.
    """

    def __init__(self, fleet: Fleet, otherwise: str, interrupt: Interrupt) -> None:
        self._fleet, self._otherwise, self._interrupt = fleet, otherwise, interrupt
        self._stack = ExitStack()
        self.session: OperatorSession | None = None
        self.statuses: Mapping[int, Status] = {}

    def __enter__(self) -> Ears:
        from handfast.agent.transport.bus import BusError
        from handfast.deploy.session.operator_session import OperatorSession

        try:
            session = OperatorSession(self._fleet, lambda: not self._interrupt.count)
            self.session = self._stack.enter_context(session)
        except (BusError, InputError) as error:
            if not self._interrupt.count:
                print(f"handfast: agents are not heard{self._otherwise}: {error}", file=sys.stderr)
        else:
            self.statuses = self.session.statuses
            self.session.listen_to_beacons()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def know(self) -> bool:
        """Whether all that can be heard was heard."""
        session, expected = self.session, len(self._fleet.ids)
        return session is None or len(session.statuses) >= expected <= session.silent.senders

    def wait(self, look: Callable[[], bool], timeout_s: float) -> None:
        """Listens until `look` says True, or `timeout_s` are over."""
        if self.session is not None:
            self.session.wait(look, timeout_s)
        else:
            wait_for(look, timeout_s)

    def bodies(self) -> list[SilentBody]:
        """Robots that are not heard."""
        if self.session is None:
            return []
        mission = self.session.operator.mission
        return self.session.silent.bodies(mission.removed if mission else ())

    def older_mission(self) -> str:
        """What is to be said of a mission that is older than the last stop."""
        from handfast.deploy.drive.preconditions import older_mission

        session = self.session
        if session is None or not session.statuses:
            return ""
        session.ask()
        return older_mission(session.operator, session.now_ns())


def _here(fleet: Fleet, known: KnownFleet, interrupt: Interrupt) -> Seen:
    """What is known of a fleet that runs on this machine.

    Raises:
        handfast.deploy.inventory.known_fleets.NoAnswerError: none of its processes is there.
    """
    from handfast.agent.messages.key_expressions import ROLES
    from handfast.deploy.hosts.status import logs_of, process_row, run_words, this_machine

    with Ears(fleet, "", interrupt) as ears:
        ears.wait(lambda: interrupt.count > 0 or ears.know, LISTEN_S)
        bodies, older = ears.bodies(), ears.older_mission()
        here = this_machine(fleet, known.fleet_file, logs_of(known))
        rows = [
            process_row(fleet, robot, role, here, ears.statuses.get(robot), time.time())
            for robot in fleet.ids
            for role in ROLES
        ]
        nobody = not known.runs and not ears.statuses and all(row["unit"] == "none" for row in rows)
        if nobody and ears.session is not None and not interrupt.count:
            raise ears.session.no_answer()
    return Seen(rows, {}, bodies, older, [run_words(run) for run in known.runs])


def _on_hosts(fleet: Fleet, hosts: Sequence[HostSection], what: str, interrupt: Interrupt) -> Seen:
    """What is known of a fleet (located) on these hosts of its; `what`: as the user named it."""
    from handfast.deploy.hosts import systemd_units
    from handfast.deploy.hosts.connection import HostConnection
    from handfast.deploy.hosts.jobs import FAILED as HOST_FAILED
    from handfast.deploy.hosts.jobs import HostJobs, Row
    from handfast.deploy.hosts.status import (
        HostStatus,
        expiries_on_hosts,
        host_status,
        process_row,
        router_rows,
    )
    from handfast.deploy.inventory.expiry import operators

    found = {host.name: HostStatus() for host in hosts}

    def ask(connection: HostConnection, row: Row) -> None:
        answer = connection.ask("status", fleet=fleet.fleet.name)
        found[row.host] = host_status(answer, connection.clock())

    # The hosts first: to open the bus may take a while, in which they answer.
    with HostJobs(fleet, hosts, ask) as jobs, Ears(fleet, ", only hosts are asked", interrupt) as ears:

        def asked() -> bool:
            return interrupt.count > 0 or not jobs.busy

        ears.wait(lambda: asked() and (interrupt.count > 0 or ears.know), LISTEN_S)
        if not asked():
            ears.wait(asked, HOSTS_TIMEOUT_S)
        if not interrupt.count:
            jobs.end(f"it has not said all within {LISTEN_S + HOSTS_TIMEOUT_S:.0f} s")
        bodies, older = ears.bodies(), "" if interrupt.count else ears.older_mission()
    for row in jobs.rows.values():
        if row.state == HOST_FAILED:
            found[row.host].error = row.step
    now_s = time.time()
    expiries = [*operators(fleet, what), *expiries_on_hosts(fleet, found, what)]
    rows = [
        process_row(fleet, robot, role, found[host.name], ears.statuses.get(robot), now_s)
        for host in hosts
        for robot in jobs.rows[host.name].robots
        for role in systemd_units.roles(fleet)
    ]
    rows += [row for host in hosts for row in router_rows(fleet, host, found[host.name], now_s)]
    return Seen(rows, found, bodies, older, expiries=expiries)


# --- without FLEET ---------------------------------------------------------------------------


def _list(options: argparse.Namespace) -> int:
    if options.hosts or options.each:
        raise InputError("--host and --each need FLEET: name the fleet that is meant")
    from handfast.deploy.inventory.known_fleets import NONE, known, unreadable

    rows, damaged = [fleet_row(fleet) for fleet in known()], unreadable()
    if options.json:
        print(json.dumps({"fleets": rows, "unreadable": damaged}, indent=2))
    elif rows:
        print(*fleet_table(rows), sep="\n")
    else:
        print(f"{NONE}, and none is up on hosts")
    for line in () if options.json else damaged:
        print(f"handfast: {line}", file=sys.stderr)
    return FAILED if damaged else PASSED


def fleet_row(fleet: KnownFleet) -> dict[str, Any]:
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
    from handfast.deploy.processes.running import PAUSED, state_of

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


def fleet_table(rows: Sequence[dict[str, Any]]) -> list[str]:
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
    downs = [f"take {row['fleet']} down with: {row['down']}" for row in rows if row["down"] is not None]
    return list(map(printable, aligned(cells) + downs))
