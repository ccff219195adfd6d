"""The command ``handfast firewall``: rules for nftables, for whoever has root on robots' computers."""

from __future__ import annotations

import argparse
import re
import socket
from typing import TYPE_CHECKING, Final

from agent.common.exit import PASSED
from deploy.console.arguments import InputError, describe, fleet_path, load, no_changes
from deploy.inventory.hosts import used_hosts

if TYPE_CHECKING:
    from agent.fleet.model import Fleet

DEVICE: Final = r"[A-Za-z0-9][A-Za-z0-9._-]{0,14}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast firewall`` takes."""
    describe(
        parser,
        ", as `nft -f -` reads it on each of them, as root: the fleet's hosts and those that are named may "
        "open as many connections to its ports as they like, all others together five a second. Changes "
        "nothing by itself. Exit status: 0; 2 bad input.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file with [host.NAME] tables")
    parser.add_argument(
        "--known",
        action="append",
        default=[],
        metavar="ADDRESS",
        help="address or name of an operator's computer, as robots see it; once for each",
    )
    parser.add_argument(
        "--device",
        dest="devices",
        action="append",
        default=[],
        metavar="NAME",
        help="network device, such as wg0, through which alone the ports are reached; once for each",
    )
    parser.set_defaults(command=_firewall, **no_changes())


def _firewall(options: argparse.Namespace) -> int:
    from deploy.hosts.artifacts.nftables import ruleset
    from deploy.inventory.hosts import hosts_of, located

    for device in options.devices:
        if not re.fullmatch(DEVICE, device):
            raise InputError(f"--device {device}: must be the name of a network device, such as wg0")
    fleet = load(options)
    hosts_of(fleet, str(fleet_path(options.fleet)))
    print(ruleset(fleet, _known(located(fleet), options.known), options.devices), end="")
    return PASSED


def _known(fleet: Fleet, more: list[str]) -> list[str]:
    """Addresses, as numbers, of the fleet's hosts and routers, and of what was named."""
    names = {f"host {host.name}": host.address or host.name for host in used_hosts(fleet)}
    elsewhere = [router.where for router in fleet.routers if router.host is None]
    names |= {f"router {where}": where.rpartition(":")[0] for where in elsewhere}
    names |= {f"--known {name}": name for name in more}
    found = []
    for what, name in names.items():
        try:
            there = socket.getaddrinfo(name.strip("[]"), None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or "not a name"
            raise InputError(f"{what}: {name} has no address: {why.lower()}") from None
        found += [str(each[4][0]) for each in there]
    return found
