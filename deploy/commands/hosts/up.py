"""The command ``handfast up``: a fleet on its hosts, installed, configured, started and heard of."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
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
from handfast.deploy.inventory.known_fleets import handled

if TYPE_CHECKING:
    from handfast.deploy.hosts.certificates import HostKeys
    from handfast.deploy.hosts.up import BringUp


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast up`` takes."""
    describe(
        parser,
        ": looks at all of them side by side, installs this version "
        "of handfast where it is not (robots need no internet), writes fleet file and systemd user units, "
        "starts what does not run as it should, and waits until each robot is heard. Run it again to "
        "upgrade: while the fleet drives, robots start again one at a time. Exit status: 0 all robots are "
        "up; 1 some are not; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file with [host.NAME] tables")
    host_argument(parser)
    parser.add_argument(
        "--accept-new-host-keys",
        action="store_true",
        help="take the key of a host that this machine has never met for its own",
    )
    parser.add_argument(
        "--no-check", dest="check", action="store_false", help="go on even where `check` finds errors"
    )
    parser.set_defaults(command=handled(_up), quiet=False, **no_changes())


def _up(options: argparse.Namespace) -> int:
    from handfast.deploy.drive.outcome import refuse_errors
    from handfast.deploy.hosts.jobs import DONE as HOST_DONE
    from handfast.deploy.hosts.jobs import make_hosts_view
    from handfast.deploy.hosts.up import BringUp
    from handfast.deploy.inventory.expiry import operators, warnings
    from handfast.deploy.inventory.hosts import hosts_of, located, refuse_simulated

    fleet = load(options)
    interrupt = Interrupt()
    with interrupt.caught():
        source = str(fleet_path(options.fleet))
        hosts = hosts_of(fleet, source, options.hosts)
        refuse_simulated(fleet, source)
        refuse_errors(options, fleet)
        fleet = located(fleet)
        with ExitStack() as stack:
            keys = stack.enter_context(_keys(fleet, options)) if fleet.is_secured else None
            notes = Notes(fleet, Path(source))
            work = BringUp(
                fleet,
                hosts,
                keys,
                accept_new=options.accept_new_host_keys,
                before_changes=lambda host: notes.up([host], complete=False),
            )
            view = stack.enter_context(make_hosts_view())
            work.warnings += warnings(operators(fleet, options.fleet), time.time())
            work.run(view, interrupt)
        notes.up([row.host for row in work.rows.values() if row.state == HOST_DONE], complete=True)
        work.warnings += notes.problems
    return _say(work, interrupt)


class Notes:
    """Notes where a fleet is up, for `handfast status`; a disk that is full keeps no fleet from coming up.

    Attributes:
        problems: what could not be noted, for the operator.
    """

    def __init__(self, fleet: Fleet, source: Path) -> None:
        self._fleet, self._source = fleet, source
        self.problems: list[str] = []

    def up(self, hosts: Sequence[str], *, complete: bool) -> None:
        """It is up on these hosts, or is about to be."""
        from handfast.deploy.inventory.registry import note_up

        try:
            if hosts:
                note_up(self._fleet, self._source, hosts, complete=complete)
        except OSError as error:
            why = f"`handfast status` does not know that it is up: cannot note it: {error}"
            if why not in self.problems:
                self.problems.append(why)


@contextmanager
def _keys(fleet: Fleet, options: argparse.Namespace) -> Iterator[HostKeys]:
    """What gives robots their certificates, by the authority that `handfast keys` has made; with an
    operator's credentials alone, what leaves robots be that need none."""
    from handfast.agent.security.certificates import CertificateError
    from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE
    from handfast.agent.security.private_files import KeyFileError, exists, read
    from handfast.deploy.hosts.certificates import HostKeys
    from handfast.deploy.inventory.certificate_authority import Authority, AuthorityError
    from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, keys_folder

    name, what = fleet.fleet.name, options.fleet
    folder = keys_folder(name)
    try:
        if exists(folder / AUTHORITY_FILE):
            with Authority(folder, name, fleet.ids, time.time()) as authority:
                own = authority.certificate_pem
                yield HostKeys(fleet, authority, own, what)
        elif exists(folder / AUTHORITY_CERTIFICATE):
            yield HostKeys(fleet, None, read(folder / AUTHORITY_CERTIFICATE), what)
        else:
            raise InputError(
                f"{name} is secured and has no authority in {folder}: `handfast keys {what}` makes it; where "
                f"it is on another computer, `handfast keys {what} --request` asks there for a certificate "
                '(or, on a network that you trust entirely: network.security = "off")'
            )
    except (AuthorityError, CertificateError, KeyFileError) as error:
        raise InputError(str(error)) from None


def _say(work: BringUp, interrupt: Interrupt) -> int:
    """Says what became of each robot; the exit status."""
    from handfast.deploy.hosts.jobs import DONE as HOST_DONE

    for router in work.fleet.routers:
        row = work.rows.get(router.host or "")
        if row is not None:
            state = work.routers.get(router.number, f"NOT UP: {row.step}")
            print(f"router {router.number} on {row.host}: {state}")
    for row in work.rows.values():
        for robot in row.robots:
            outcome = row.outcomes.get(robot, f"NOT UP: {row.step}")
            print(
                f"robot {robot} on {row.host}: {outcome}{' (left as before)' if robot in work.left else ''}"
            )
    for warning in work.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if interrupt.count:
        return INTERRUPTED
    return PASSED if all(row.state == HOST_DONE for row in work.rows.values()) else FAILED
