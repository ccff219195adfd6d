"""The command ``handfast router``: passes on messages between robots that do not link to each other."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handfast.agent.common.errors import INTERRUPTED, PASSED
from handfast.deploy.console.arguments import InputError, describe, fleet_path, load, no_changes
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.inventory.known_fleets import handled

if TYPE_CHECKING:
    from handfast.agent.fleet.model import Fleet
    from handfast.agent.security.identity import Security


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast router`` takes."""
    describe(
        parser,
        ": one of those that [network] routers names as HOST:PORT; `handfast up` starts those on hosts of "
        "the fleet. In a secured fleet it needs a certificate: `handfast keys FLEET --router --address A`. "
        "Exit status: 1 its port cannot be had; 2 bad input; 130 after Ctrl-C.",
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
    from handfast.agent.runtime.router import others, serve
    from handfast.agent.runtime.service import SystemdNotifier
    from handfast.agent.transport.bus import settings_of

    fleet = load(options)
    interrupt = Interrupt()
    with interrupt.caught():
        listen = _listen(options, fleet)
        security = _security(options, fleet)
        connect = others(fleet, listen)
        if options.print_config:
            settings = settings_of("router", [listen], connect, security)
            print(json.dumps(_nested(settings), indent=2))
            return PASSED
        with SystemdNotifier() as service:
            serve(fleet, listen, connect, security, lambda: interrupt.count > 0, _say, service)
    return INTERRUPTED


def _say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def _listen(options: argparse.Namespace, fleet: Fleet) -> str:
    elsewhere = [router.where for router in fleet.routers if router.host is None]
    if not elsewhere:
        on_hosts = [str(router.host) for router in fleet.routers]
        why = (
            f"`handfast up` starts its routers, on {' and '.join(on_hosts)}" if on_hosts else "it names none"
        )
        raise InputError(
            f"{fleet_path(options.fleet)}: robots would not look for it in network.routers: {why}. Write for "
            'example [network] routers = ["192.168.1.2:7447"]'
        )
    where = options.listen or elsewhere[0]
    host, _, port = where.rpartition(":")
    if not host or not port.isdecimal():
        raise InputError(f"--listen must be HOST:PORT, such as 0.0.0.0:7447, got {where!r}")
    return f"{'tls' if fleet.is_secured else 'tcp'}/{where}"


def _security(options: argparse.Namespace, fleet: Fleet) -> Security | None:
    from handfast.agent.runtime.router import security_of
    from handfast.agent.security.credentials import CredentialsError, MissingError
    from handfast.agent.security.identity import IdentityError
    from handfast.deploy.inventory.operator_credentials import keys_folder

    folder = keys_folder(fleet.fleet.name) if options.keys is None else Path(options.keys).expanduser()
    try:
        return security_of(fleet, folder)
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
