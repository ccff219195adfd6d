"""The command ``handfast fetch``: what robots recorded on their hosts, as one run."""

from __future__ import annotations

import argparse
import sys
import time

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.common.wording import printable
from handfast.deploy.console.arguments import (
    InputError,
    describe,
    fleet_path,
    host_argument,
    load,
    no_changes,
    place_for,
)
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.times import FORMS, time_option
from handfast.deploy.inventory.known_fleets import handled


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast fetch`` takes."""
    describe(
        parser,
        ": the last mission, unless times are given; `handfast "
        "report` and `export` work on it. What was fetched before is not sent again. Exit status: 0 all of "
        "them gave theirs; 1 some did not (the folder is made of the others); 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file with [host.NAME] tables")
    host_argument(parser)
    parser.add_argument(
        "--out", type=place_for, metavar="DIR", help="the run's folder (default: runs/FLEET-fetched-TIME)"
    )
    parser.add_argument("--since", metavar="TIME", help=f"from when on: {FORMS}")
    parser.add_argument("--until", metavar="TIME", help="until when")
    parser.add_argument("--all", action="store_true", help="all that there is")
    parser.add_argument("--no-report", dest="report", action="store_false", help="no figures, no report.html")
    parser.set_defaults(command=handled(_fetch), **no_changes())


def _fetch(options: argparse.Namespace) -> int:
    from handfast.deploy.drive.outcome import conclude
    from handfast.deploy.hosts.fetch import Fetching
    from handfast.deploy.hosts.jobs import FAILED as HOST_FAILED
    from handfast.deploy.hosts.jobs import HostJobs, make_hosts_view
    from handfast.deploy.inventory.hosts import hosts_of, located
    from handfast.deploy.inventory.own_orders import out_folder, refuse_full
    from handfast.deploy.merging.merge import Choice, Known, merge
    from handfast.deploy.merging.robot_files import MergeError
    from handfast.deploy.recording.run_files import RecordingError
    from handfast.deploy.report.run_folder import FolderError
    from handfast.deploy.session.operator_bus import order_opener

    now_s = time.time()
    since_s, until_s = (time_option(options, name, now_s) for name in ("since", "until"))
    if options.all and (since_s is not None or until_s is not None):
        raise InputError("--all takes all that there is: leave out --since and --until")
    if since_s is not None and until_s is not None and since_s >= until_s:
        raise InputError(f"--until {options.until} must be later than --since {options.since}")
    fleet = load(options)
    interrupt = Interrupt()
    with interrupt.caught():
        name = fleet.fleet.name
        out = out_folder(options.out, f"{name}-fetched")
        refuse_full(out)
        hosts = hosts_of(fleet, str(fleet_path(options.fleet)), options.hosts)
        fetching = Fetching(fleet, since_s)
        with make_hosts_view() as view, HostJobs(located(fleet), hosts, fetching) as jobs:
            jobs.wait(view, interrupt)
            rows = list(jobs.rows.values())
            view.show(rows)
    if interrupt.count:
        return INTERRUPTED
    # From here on a Ctrl-C ends the command where it is.
    lacking = [robot for row in rows for robot in row.robots if robot not in fetching.folders]
    warnings = [warning for robot in lacking if (warning := fetching.fall_back(robot)) is not None]
    if not fetching.folders:
        return FAILED
    choice = Choice(name, _ns(since_s), _ns(until_s), options.all)
    opener = order_opener(fleet) if fleet.is_secured else None
    if fleet.is_secured and opener is None:
        warnings.append(
            f"the certificate of {name}'s authority is not here, so nobody looked at the seals of orders: "
            "those count that most robots recorded"
        )
    known = Known(fleet, opener, fetching.fetched_before)
    try:
        merged = merge(fetching.folders, out, choice, known=known, warnings=warnings, report=options.report)
    except (MergeError, FolderError, RecordingError) as error:
        for warning in warnings:
            print(f"warning: {printable(warning)}", file=sys.stderr)
        raise InputError(printable(str(error))) from None
    print(f"{merged.messages} messages of {len(merged.robots)} robots in {merged.folder}")
    conclude(merged.result, merged.folder)
    return FAILED if any(row.state == HOST_FAILED for row in rows) else PASSED


def _ns(seconds: float | None) -> int | None:
    return None if seconds is None else round(seconds * 1e9)
