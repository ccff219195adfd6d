"""``python -m agent.admission --fleet FILE --robot ID``: stands before one robot's ports; with ``--router K``
before that of a router on a host.

Agent and plant, or the router, listen on the loopback then, and this on the address of their host, on the
same ports.
"""

from __future__ import annotations

import argparse
import ipaddress
import json
import socket
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Final

from agent.admission.budgets import PROVEN_MAX, Budgets
from agent.admission.proxy import Door, Proxy, listener
from agent.common.exit import BAD_INPUT, FAILED, PASSED
from agent.common.time import NS_PER_S
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet, FleetError
from agent.runtime.process import logger
from agent.runtime.shutdown import Shutdown, add_parent_argument
from agent.runtime.systemd_notify import SystemdNotifier
from agent.security.private_files import KeyFileError, read, write
from agent.security.refusals import Refusals

TURN_S: Final = 0.1
DEADLINE_S: Final = 2.0
"""A connection has proven itself by then, or later where links may take longer to open."""
RESOLVE_S: Final = 60.0
"""How often the hosts' names are looked up."""
STATUS_S: Final = 2.0
KINDS_MAX: Final = 12
"""Refusals that are logged apart: a flood comes from many addresses."""


def where(endpoint: str) -> tuple[str, int]:
    """Address and port of an endpoint as Zenoh writes it."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def addresses_of(names: Sequence[str]) -> frozenset[str]:
    """The addresses that names have now; of one that has none, nothing."""
    found = set()
    for name in names:
        with suppress(OSError, UnicodeError):
            bare = name.strip("[]")
            found |= {str(each[4][0]) for each in socket.getaddrinfo(bare, None, type=socket.SOCK_STREAM)}
    return frozenset(found)


def read_proven(path: Path | None) -> list[str]:
    """Who had proven itself, as `path` has it; nobody where it is not there.

    Raises:
        ValueError: it says something else; or, as a `KeyFileError`, cannot be read.
        OSError: nor can its folder.
        RecursionError: it says something else, with many brackets.
    """
    if path is None or not path.exists():
        return []
    found = json.loads(read(path))
    if not isinstance(found, list) or not all(isinstance(each, str) for each in found):
        raise ValueError("it is no list of addresses")
    return [str(ipaddress.ip_address(each)) for each in found[-PROVEN_MAX:]]


class _Background:
    """A thread for what may take its time, so that no link waits: name servers, and the disk.

    Args:
        budgets: whose hosts it looks up, now and then.
        file: where it writes who has proven himself; None for nowhere.
    """

    def __init__(self, fleet: Fleet, budgets: Budgets, file: Path | None, log: Callable[[str], None]) -> None:
        self._names = [host.address or host.name for host in fleet.hosts]
        self._budgets, self._file, self._log = budgets, file, log
        self._proven = budgets.proven
        self._awake, self._ended = Event(), Event()
        Thread(target=self._run, daemon=True).start()

    def remember(self) -> None:
        """Has it write who has proven himself by now."""
        self._proven = self._budgets.proven
        self._awake.set()

    def end(self) -> None:
        self._ended.set()
        self._awake.set()

    def _run(self) -> None:
        due_s, written = 0.0, self._proven
        while not self._ended.is_set():
            self._awake.clear()
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + RESOLVE_S
                self._budgets.hosts = addresses_of(self._names) or self._budgets.hosts
            proven = self._proven
            if proven != written and self._file is not None:
                written = proven
                try:
                    self._file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                    write(self._file, json.dumps(proven).encode(), private=True)
                except (KeyFileError, OSError) as error:
                    self._log(f"will not remember who had a certificate: {error}")
            self._awake.wait(RESOLVE_S)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process. Returns its exit status: 0 when it was asked to end, 1 when it cannot begin now, 2
    for bad input."""
    parser = argparse.ArgumentParser(
        prog="python -m agent.admission", description="Lets connections through to its ports, or not."
    )
    parser.add_argument("--fleet", required=True, metavar="FILE", help="the fleet file (TOML)")
    whose = parser.add_mutually_exclusive_group(required=True)
    whose.add_argument("--robot", type=int, metavar="ID", help="id of the robot before which it stands")
    whose.add_argument("--router", type=int, metavar="K", help="or which router, from 1")
    parser.add_argument("--proven", type=Path, metavar="FILE", help="remembers there who had a certificate")
    add_parent_argument(parser)
    options = parser.parse_args(argv)
    shutdown = Shutdown(with_parent=options.exit_with_parent)
    robot, router = options.robot, options.router
    log = logger(f"router {router}" if robot is None else f"robot {robot}", "admission")
    try:
        fleet = load_fleet(options.fleet)
        doors = fleet.router_doors(router) if robot is None else fleet.admission_doors(robot)
    except FleetError as error:
        log(str(error))
        return BAD_INPUT
    if not doors:
        what = "" if robot is not None else ", or has no such router on a host"
        log(f'nothing to do: the fleet file does not say network.admission = "proxy"{what}')
        return BAD_INPUT
    with SystemdNotifier() as service, ExitStack() as opened:
        found = []
        for outside, inside in doors:
            try:
                at = opened.enter_context(listener(where(outside)))
            except OSError as error:
                log(f"cannot listen on {outside}: {(error.strerror or str(error)).lower()}")
                return FAILED
            found.append(Door(at, where(inside)))
        log(f"lets connections through on {' and '.join(outside for outside, _ in doors)}")
        _serve(fleet, found, options.proven, shutdown, service, log)
    return PASSED


def _serve(
    fleet: Fleet,
    doors: Sequence[Door],
    file: Path | None,
    shutdown: Shutdown,
    service: SystemdNotifier,
    log: Callable[[str], None],
) -> None:
    try:
        proven = read_proven(file)
    except (ValueError, OSError, RecursionError) as error:
        log(f"begins without knowing who had a certificate: {file}: {error}")
        proven = []
    budgets, refusals = Budgets(proven), Refusals(KINDS_MAX)
    background = _Background(fleet, budgets, file, log)
    deadline_s = max(DEADLINE_S, fleet.network.link_timeout_s)
    status_due_s = 0.0
    try:
        with Proxy(doors, budgets, deadline_s, refusals.add, background.remember) as proxy:
            service.ready()
            while not shutdown.asked:
                proxy.turn(TURN_S, time.monotonic)
                now_ns = time.monotonic_ns()
                service.lives(now_ns)
                for line in refusals.lines(now_ns):
                    log(line)
                if now_ns / NS_PER_S >= status_due_s:
                    status_due_s = now_ns / NS_PER_S + STATUS_S
                    service.says(f"{len(proxy)} connections, {refusals.total} refused")
                    shutdown.look_for_parent()
            service.stopping()
            for line in refusals.lines(time.monotonic_ns() + 10 * NS_PER_S):
                log(line)
    finally:
        background.end()
    log(f"ending ({shutdown.why})")


if __name__ == "__main__":
    sys.exit(main())
