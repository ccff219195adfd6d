"""``python -m handfast.agent.runtime.router --fleet FILE --number K``: the K-th router of a fleet.

It passes on what its clients say to those of them that listen, and links to the other routers. `handfast
router` serves by the same loop.
"""

from __future__ import annotations

import argparse
import os
import resource
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from handfast.agent.common.errors import BAD_INPUT, FAILED, PASSED
from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.messages.key_expressions import alive, robot_of_alive
from handfast.agent.runtime.batcher import Batcher
from handfast.agent.runtime.loop import DIALLED, Log
from handfast.agent.runtime.service import Shutdown, SystemdNotifier, add_parent_argument, wait_until_valid
from handfast.agent.security.credentials import CredentialsError, load
from handfast.agent.security.identity import MAIN, Security, of_router
from handfast.agent.security.refusals import FILTER
from handfast.agent.transport.bus import Bus, BusError, Presence, Router, init_log
from handfast.agent.transport.sealed_bus import secured
from handfast.agent.transport.zenoh_log import ZenohLog

POLL_NS: Final = NS_PER_S // 10
"""How often it looks at its links, and is seen to live."""
ANYWHERE: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""Addresses that stand for all of a machine's, and for the one by which it reaches itself."""
_LEFT: Final[list[ExitStack]] = []
"""What is not to be closed: a session that nobody has any more is."""


def others(fleet: Fleet, listen: str) -> list[str]:
    """Endpoints of the routers that the one on `listen` links to: of any two, the later one in the file. One
    that listens on another address than the file has, such as 0.0.0.0, links to all but itself."""
    endpoints = list(fleet.router_endpoints)
    if listen in endpoints:
        return endpoints[: endpoints.index(listen)]
    port = listen.rpartition(":")[2]
    return [each for each in endpoints if each.rpartition(":")[2] != port or not _is_here(each)]


def _is_here(endpoint: str) -> bool:
    """Whether an endpoint's host is this machine."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    with suppress(OSError):
        for family, _, _, _, address in socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM):
            with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as found:
                found.bind(address)
                return True
    return False


def _of_this_machine(listen: str) -> str:
    """Where this machine reaches what listens there: on all its addresses, on the loopback."""
    for anywhere, here in ANYWHERE.items():
        listen = listen.replace(f"/{anywhere}:", f"/{here}:", 1)
    return listen


def _client(fleet: Fleet, router: str, security: Security | None, asked: Callable[[], bool]) -> Bus:
    """A client of the router of this process. Raises `BusError` when it was asked to end meanwhile."""
    return Bus(
        listen=[],
        connect=[],
        routers=[router],
        security=security,
        go_on_waiting=lambda: not asked(),
        is_wanted=lambda: not asked(),
        robots=len(fleet.robots),
        lease_ms=fleet.lease_ms,
    )


def security_of(fleet: Fleet, folder: Path, name: str = MAIN) -> Security | None:
    """How the links of the router `name` are secured whose key is in `folder`; None for not at all.

    Raises:
        handfast.agent.security.credentials.CredentialsError: the files are not there, or not valid.
    """
    if not fleet.is_secured:
        return None
    return secured(fleet, load(folder, of_router(fleet.fleet.name, name), time.time()))


def _news(router: Router, presence: Presence | None, zenoh_log: ZenohLog, now_ns: int) -> Iterator[str]:
    """Lines for the log about what has happened since the last look."""
    for key, here in presence.update() if presence is not None else ():
        robot, role = robot_of_alive(key) or (0, "")
        yield f"robot {robot}'s {role} {'is connected' if here else 'is not connected any more'}"
    yield from zenoh_log.lines(now_ns)
    for endpoint in router.look(now_ns):
        yield f"was deaf to {endpoint or DIALLED}: link opened anew"


def serve(
    fleet: Fleet,
    listen: str,
    connect: Sequence[str],
    security: Security | None,
    asked: Callable[[], bool],
    log: Log,
    service: SystemdNotifier,
    *,
    talks: bool = True,
    leaves: bool = False,
) -> None:
    """Is a router on `listen` until it is `asked` to end.

    Args:
        connect: other routers that it links to.
        talks: says who comes and goes.
        leaves: closes no link: the process ends outright after this, and the kernel closes them at once.

    Raises:
        BusError: the endpoint cannot be listened on.
    """
    with suppress(OSError, ValueError):  # every process of the fleet has links to it
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with ExitStack() as stack:
        zenoh_log = stack.enter_context(ZenohLog())
        init_log(FILTER)
        router = stack.enter_context(
            Router([listen], connect, security, fleet.network.link_timeout_s, fleet.lease_ms)
        )
        about = f"router of {fleet.fleet.name} on {listen}{', secured' if security else ', not secured'}"
        log(about)
        presence = router.watch(alive(fleet.fleet.name, "*", "*")) if talks else None
        batcher = None
        if fleet.batches_beacons:
            client = _client(fleet, _of_this_machine(listen), security, asked)
            batcher = Batcher(fleet, stack.enter_context(client), time.time_ns())
        service.ready()
        service.says(about)
        look_due_ns = 0
        while not asked():
            if batcher is not None:
                batcher.look(time.time_ns())
            now_ns = time.monotonic_ns()
            if now_ns >= look_due_ns:
                look_due_ns = now_ns + POLL_NS
                for line in _news(router, presence, zenoh_log, now_ns):
                    log(line)
                service.lives(now_ns)
            rest_ns = look_due_ns - time.monotonic_ns()
            if batcher is not None:
                rest_ns = min(rest_ns, batcher.due_ns - time.time_ns())
            time.sleep(max(0, rest_ns) / NS_PER_S)
        service.stopping()
        if leaves:
            _LEFT.append(stack.pop_all())


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process. Returns its exit status: 0 when it was asked to end, 1 when it cannot begin now, 2
    for bad input."""
    parser = argparse.ArgumentParser(
        prog="python -m handfast.agent.runtime.router", description="A router of a fleet.", allow_abbrev=False
    )
    parser.add_argument("--fleet", required=True, metavar="FILE", help="the fleet file (TOML)")
    parser.add_argument("--number", type=int, default=1, metavar="K", help="which router, from 1")
    parser.add_argument("--keys", type=Path, metavar="DIR", help="folder of its key and certificates")
    add_parent_argument(parser)
    options = parser.parse_args(argv)
    shutdown = Shutdown(with_parent=options.exit_with_parent)

    def log(text: str) -> None:
        print(f"router {options.number}: {printable(text)}", file=sys.stderr, flush=True)

    def asked() -> bool:
        shutdown.look_for_parent()
        return shutdown.asked

    try:
        fleet = load_fleet(options.fleet)
        routers = fleet.routers
        if not 1 <= options.number <= len(routers):
            log(f"there is no router {options.number}: the fleet has {len(routers) or 'none'}")
            return BAD_INPUT
        if fleet.is_secured and options.keys is None:
            log("this fleet is secured: give the folder of the router's key and certificates, --keys DIR")
            return BAD_INPUT
        own = routers[options.number - 1]
        listen = f"{'tls' if fleet.is_secured else 'tcp'}/{own.listens}"
        identity = of_router(fleet.fleet.name, own.identity_name) if fleet.is_secured else None
        with SystemdNotifier() as service:
            wait_until_valid(identity, options.keys, asked, service, log)
            if not shutdown.asked:
                security = None if identity is None else security_of(fleet, options.keys, identity.name)
                earlier = fleet.router_endpoints[: options.number - 1]
                serve(fleet, listen, earlier, security, asked, log, service, talks=False, leaves=True)
    except BusError as error:
        log(str(error))
        return FAILED
    except (FleetError, CredentialsError) as error:
        log(str(error))
        return BAD_INPUT
    log(f"ending ({shutdown.why})")
    os._exit(PASSED)  # as a robot's process ends (`agent.transport.bus.Bus.leave`)


if __name__ == "__main__":
    sys.exit(main())
