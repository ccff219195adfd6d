"""The command ``handfast status``: what each process of a fleet does, on its host and on the bus."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from agent.common.exit import FAILED, INTERRUPTED, PASSED
from deploy.console.arguments import InputError, describe, fleet_path, host_argument, load, no_changes
from deploy.console.interrupt import Interrupt
from deploy.inventory.running import handled

if TYPE_CHECKING:
    from agent.messages.types import Status

LISTEN_S: Final = 2.0
HOSTS_TIMEOUT_S: Final = 60.0
LOOK_S: Final = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast status`` takes."""
    describe(
        parser,
        ": its unit, how often it was started again, CPU and memory "
        "(as the host says, over ssh); state of its agent, age of its neighbours' messages (as it says, "
        "on the bus); version; how its host's clock stands to this one; how long certificates hold; robots "
        "that are not heard, and where the others believe them to be. Exit status: 0 all processes run and "
        "all agents are heard; 1 not all; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file with [host.NAME] tables")
    host_argument(parser)
    parser.add_argument("--json", action="store_true", help="for programs: one JSON document")
    parser.set_defaults(command=handled(_status), **no_changes())


def wait_for(look: Callable[[], bool], timeout_s: float) -> bool:
    """As `deploy.session.session.Session.wait`, without a session."""
    deadline = time.monotonic() + timeout_s
    while not look():
        if time.monotonic() >= deadline:
            return False
        time.sleep(LOOK_S)
    return True


def _status(options: argparse.Namespace) -> int:
    from agent.runtime.bus import BusError
    from deploy.analysis.silent_bodies import SilentBodies, in_words
    from deploy.hosts import systemd_units
    from deploy.hosts.connection import HostConnection
    from deploy.hosts.jobs import HostJobs
    from deploy.hosts.status import (
        HostStatus,
        host_rows,
        host_status,
        print_table,
        process_row,
        robots_by_host,
    )
    from deploy.hosts.view import FAILED as HOST_FAILED
    from deploy.hosts.view import Row
    from deploy.inventory.expiry import operators, summary
    from deploy.inventory.hosts import hosts_of, located
    from deploy.session.operator_session import OperatorSession

    interrupt = Interrupt()
    with interrupt.caught():
        fleet = load(options)
        hosts = hosts_of(fleet, str(fleet_path(options.fleet)), options.hosts)
        fleet = located(fleet)
        found = {host.name: HostStatus() for host in hosts}

        def ask(connection: HostConnection, row: Row) -> None:
            answer = connection.ask("status", fleet=fleet.fleet.name)
            found[row.host] = host_status(answer, connection.clock())

        with ExitStack() as stack:
            statuses: dict[int, Status] = {}
            wait, expected = wait_for, 0
            silent, operator = SilentBodies(), None
            try:
                session = stack.enter_context(OperatorSession(fleet))
                wait, statuses, expected = session.wait, session.statuses, len(fleet.ids)
                silent, operator = session.silent, session.operator
                session.listen_to_beacons()
            except (BusError, InputError) as error:
                print(f"handfast: agents are not heard, only hosts are asked: {error}", file=sys.stderr)
            jobs = stack.enter_context(HostJobs(fleet, hosts, ask))

            def asked() -> bool:
                return interrupt.count > 0 or not jobs.busy

            def known() -> bool:
                return asked() and (interrupt.count > 0 or len(statuses) >= expected <= silent.senders)

            if not wait(known, LISTEN_S):
                wait(asked, HOSTS_TIMEOUT_S)
            if not interrupt.count:
                jobs.end(f"it has not said all within {LISTEN_S + HOSTS_TIMEOUT_S:.0f} s")
    if interrupt.count:
        return INTERRUPTED
    for row in jobs.rows.values():
        if row.state == HOST_FAILED:
            found[row.host].error = row.step
    now_s = time.time()
    on_hosts = {name: row.robots for name, row in jobs.rows.items()}
    expiries = [*operators(fleet, options.fleet), *robots_by_host(found, on_hosts, options.fleet)]
    rows = [
        process_row(fleet, robot, role, found[host.name], statuses.get(robot), now_s)
        for host in hosts
        for robot in jobs.rows[host.name].robots
        for role in systemd_units.roles(fleet)
    ]
    mission = None if operator is None else operator.mission
    bodies = silent.bodies(mission.removed if mission else ())
    if options.json:
        about = {
            "fleet": fleet.fleet.name,
            "hosts": host_rows(found),
            "processes": rows,
            "silent": [body.row for body in bodies],
            "certificates": [{"who": each.who, "days": round(each.days(now_s), 1)} for each in expiries],
        }
        print(json.dumps(about, indent=2))
    else:
        print_table(rows, found)
        for line in (*in_words(bodies), *summary(expiries, now_s)):
            print(line)
    good = all(row["unit"] == "active" and (row["role"] != "agent" or row["state"]) for row in rows)
    return PASSED if good else FAILED
