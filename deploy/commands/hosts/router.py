"""The command ``handfast router``: passes on messages between robots that do not link to each other."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from agent.common.exit import INTERRUPTED, PASSED
from deploy.console.arguments import InputError, describe, fleet_path, load, no_changes
from deploy.console.interrupt import Interrupt
from deploy.inventory.running import handled

if TYPE_CHECKING:
    from agent.fleet.model import Fleet
    from agent.security.access_control import Security

POLL_S: Final = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast router`` takes."""
    describe(
        parser,
        ": one of those that [network] routers names. In a secured "
        "fleet it needs a certificate: `handfast keys FLEET --router --address A`. Exit status: 1 its "
        "port cannot be had; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file with [network] routers")
    parser.add_argument(
        "--listen",
        metavar="HOST:PORT",
        help="where robots reach it (default: the first of [network] routers)",
    )
    parser.add_argument("--keys", metavar="DIR", help="folder of its key (default: as `handfast keys`)")
    parser.add_argument(
        "--print-config",
        action="store_true",
        help="print the configuration that makes a zenohd such a router, JSON5, and end",
    )
    parser.set_defaults(command=handled(_router), **no_changes())


def _router(options: argparse.Namespace) -> int:
    from agent.messages.key_expressions import alive, robot_of_alive
    from agent.runtime.bus import Router, init_log, settings_of
    from agent.runtime.systemd_notify import SystemdNotifier
    from agent.runtime.tcp_linger import Lingering
    from agent.runtime.zenoh_log import ZenohLog
    from agent.security.refusals import FILTER

    interrupt = Interrupt()
    with interrupt.caught():
        fleet = load(options)
        listen = _listen(options, fleet)
        if options.print_config:
            settings = settings_of("router", [listen], [], _security(options, fleet))
            print(json.dumps(_nested(settings), indent=2))
            return PASSED
        name = fleet.fleet.name
        with ExitStack() as stack:
            log = stack.enter_context(ZenohLog())
            init_log(FILTER)
            security = _security(options, fleet)
            router = stack.enter_context(Router([listen], [], security))
            service = stack.enter_context(SystemdNotifier())
            _say(f"router of {name} on {listen}{', secured' if security else ', not secured'}")
            lingering = Lingering()
            presence = router.watch(alive(name, "*", "*"))
            service.ready()
            while not interrupt.count:
                for key, here in presence.update():
                    robot, role = robot_of_alive(key) or (0, "")
                    _say(f"robot {robot}'s {role} {'came' if here else 'is gone'}")
                for line in log.lines(time.monotonic_ns()):
                    _say(line)
                lingering.end()
                service.lives(time.monotonic_ns())
                time.sleep(POLL_S)
    return INTERRUPTED


def _say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def _listen(options: argparse.Namespace, fleet: Fleet) -> str:
    where = options.listen or next(iter(fleet.network.routers), None)
    if where is None:
        raise InputError(
            f"{fleet_path(options.fleet)}: network.routers names none: robots would not look for it. Write "
            'for example [network] routers = ["192.168.1.2:7447"]'
        )
    host, _, port = where.rpartition(":")
    if not host or not port.isdecimal():
        raise InputError(f"--listen must be HOST:PORT, such as 0.0.0.0:7447, got {where!r}")
    return f"{'tls' if fleet.is_secured else 'tcp'}/{where}"


def _security(options: argparse.Namespace, fleet: Fleet) -> Security | None:
    if not fleet.is_secured:
        return None
    from agent.runtime.sealed_bus import secured
    from agent.security.credentials import CredentialsError, MissingError, load
    from agent.security.identity import IdentityError, of_router
    from deploy.inventory.operator_credentials import keys_folder

    name = fleet.fleet.name
    folder = keys_folder(name) if options.keys is None else Path(options.keys).expanduser()
    try:
        return secured(fleet, load(folder, of_router(name), time.time()))
    except MissingError as error:
        raise InputError(f"{error}; `handfast keys {options.fleet} --router --address A` makes one") from None
    except (CredentialsError, IdentityError) as error:
        raise InputError(str(error)) from None


def _nested(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by their paths as the tree that a configuration file is."""
    tree: dict[str, Any] = {}
    for path, value in settings.items():
        *above, last = path.split("/")
        node = tree
        for part in above:
            node = node.setdefault(part, {})
        node[last] = value
    return tree
