"""The command ``handfast down``: a fleet leaves its hosts."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.arguments import (
    InputError,
    describe,
    fleet_path,
    host_argument,
    load,
    no_changes,
)
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.wording import FEW
from handfast.deploy.inventory.known_fleets import NoAnswerError, handled

if TYPE_CHECKING:
    from handfast.deploy.hosts.connection import HostConnection
    from handfast.deploy.hosts.jobs import HostsView, Row


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast down`` takes."""
    describe(
        parser,
        ": every robot brakes, then its processes end, and their "
        "units are removed; recordings, keys and installed versions stay. Looks whether anything is left. "
        "Exit status: 0 nothing is left; 1 something is, or a host cannot be reached; 2 bad input; 130 after "
        "Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file with [host.NAME] tables")
    host_argument(parser)
    parser.set_defaults(command=handled(_down), **no_changes())


def _down(options: argparse.Namespace) -> int:
    from handfast.deploy.hosts.jobs import DONE as HOST_DONE
    from handfast.deploy.hosts.jobs import HostJobs, make_hosts_view
    from handfast.deploy.inventory.hosts import hosts_of, located
    from handfast.deploy.inventory.registry import note_down

    fleet = load(options)
    interrupt = Interrupt()
    with interrupt.caught():
        hosts = hosts_of(fleet, str(fleet_path(options.fleet)), options.hosts)
        fleet = located(fleet)
        with make_hosts_view() as view:
            if not options.hosts:
                _brake(fleet, view)
            with HostJobs(fleet, hosts, lambda connection, row: _end(connection, row, fleet)) as jobs:
                jobs.wait(view, interrupt)
            rows = list(jobs.rows.values())
            view.show(rows)
            try:
                note_down(fleet, [row.host for row in rows if row.state == HOST_DONE])
            except OSError as error:
                view.say(f"`handfast status` still shows what is down: cannot note it: {error}")
    if interrupt.count:
        return INTERRUPTED
    return PASSED if all(row.state == HOST_DONE for row in rows) else FAILED


def _brake(fleet: Fleet, view: HostsView) -> None:
    """Stops all robots at once, before their processes end one by one."""
    from handfast.agent.transport.bus import BusError
    from handfast.deploy.session.stop import stop

    try:
        stopping, troubles = stop(fleet, _reason(fleet), [])
    except NoAnswerError:
        view.say("no robot answers: nothing to stop")
    except (BusError, InputError) as error:  # such as a certificate that is out of date: ssh is another way
        view.say(f"not stopped over the bus, robots brake as their processes end: {error}")
    else:
        if stopping.done:
            view.say("all robots brake")
            return
        for line in [*stopping.outcomes(each=len(fleet.ids) <= FEW), *troubles]:
            view.say(line)


def _reason(fleet: Fleet) -> str:
    """Why the robots stand from now on, also when they are up again: if somebody has stopped them for a
    reason, for that."""
    from handfast.deploy.drive.preconditions import GOES_DOWN, is_lifted
    from handfast.deploy.session.operator_session import OperatorSession
    from handfast.deploy.session.session import connected

    with connected(OperatorSession(fleet)) as session:
        session.ask()
        standing = session.operator.stop_in_force
    return GOES_DOWN if standing is None or is_lifted(standing) else standing.reason


def _end(connection: HostConnection, row: Row, fleet: Fleet) -> None:
    from handfast.deploy.hosts.connection import HostError

    row.step = "ending"
    answer = connection.ask("down", fleet=fleet.fleet.name)
    if answer["left"]:
        raise HostError(f"still there: {', '.join(answer['left'])}")
    count = len(answer["stopped"])
    row.done(f"down, {count} units ended and removed" if count else "down, there was nothing")
