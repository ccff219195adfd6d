"""Which routers a fleet has, and where (PURE)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from handfast.agent.fleet.hosts import HostSection, NetworkSection, names_host
from handfast.agent.fleet.sections import Robot
from handfast.agent.security.identity import MAIN

ROUTERS_CHOSEN: Final = 2
"""So many routers a fleet on hosts has whose file names none: where the host of one is lost, one is left."""


class RouterPlace(NamedTuple):
    """One router.

    Attributes:
        number: from 1, in the order in which robots try them.
        where: ``HOST:PORT`` at which all others reach it.
        listens: ``HOST:PORT`` on which it listens.
        host: name of the fleet's host on which `handfast up` starts it; None where others see to it.
    """

    number: int
    where: str
    listens: str
    host: str | None

    @property
    def identity_name(self) -> str:
        """Its name in its certificate: each host makes a key of its own."""
        return MAIN if self.host is None else str(self.number)


def router_hosts(network: NetworkSection, robots: Sequence[Robot]) -> tuple[str, ...]:
    """Names of the hosts on which routers run, in the order in which robots try them, of a fleet that is
    routed: those that the file names; where it names no router at all, the first hosts that have robots."""
    if network.routers:
        return tuple(router for router in network.routers if names_host(router))
    used = dict.fromkeys(robot.host for robot in robots if robot.host is not None)
    return tuple(used)[:ROUTERS_CHOSEN]


def routers_of(
    network: NetworkSection, hosts: Sequence[HostSection], robots: Sequence[Robot]
) -> tuple[RouterPlace, ...]:
    """The routers of a fleet that is routed. None where the file names none and no robot has a host: then
    who runs the whole fleet starts some, and writes down which."""
    port, sections = network.base_port + 2 * len(robots), {host.name: host for host in hosts}
    found = []
    for number, each in enumerate(network.routers or router_hosts(network, robots), 1):
        if names_host(each):
            host = sections[each]
            address = host.address or host.name
            found.append(RouterPlace(number, f"{address}:{port}", f"{host.listen or address}:{port}", each))
        else:
            found.append(RouterPlace(number, each, each, None))
    return tuple(found)
