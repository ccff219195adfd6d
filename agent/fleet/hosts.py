"""Tables of a fleet file about hosts, network, routers and recording, and their checks (PURE).

They are not part of the digest: robots need not agree on them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import about, setting
from handfast.agent.common.wording import show
from handfast.agent.fleet.sections import Robot
from handfast.agent.security.identity import MAIN, IdentityError, of_operator

PORT_MIN: Final = 1024

PORT_MAX: Final = 32767  # Linux gives ports from 32768 up to outgoing connections

MESH_ROBOTS_MAX: Final = 24
"""More robots are too many to be linked each to each: links grow with the square (docs/architecture.md)."""

CROWD: Final = 24
"""More robots than this on one machine have to share it: their loops do not wake all at once
(`agent.links.ticks`), and none is gone that waits for a processor."""

LEASE_MS: Final = 1000
CROWD_LEASE_MS: Final = 4000
"""A process from which nothing comes on a link for so long is gone: frozen or out of reach; one that ends is
seen to at once. In a crowd its threads wait for a processor for longer than the first, and each link that is
ended for that has a router make all anew that was declared over it."""

_ADDRESS: Final = r"[A-Za-z0-9]([A-Za-z0-9._-]{0,251}[A-Za-z0-9])?|\[[0-9A-Fa-f:.]{2,45}\]"

_ADDRESS_SAYS: Final = "a host name, an IPv4 address or an IPv6 address in [ ]"


@dataclass(frozen=True, slots=True)
class HostSection:
    """One ``[host.NAME]``."""

    name: str = field(
        metadata=about(
            "",
            pattern=r"[A-Za-z0-9]([A-Za-z0-9._-]{0,61}[A-Za-z0-9])?",
            pattern_says="1 to 63 letters, digits, -, _ or ., as a host name has them",
        )
    )
    address: str | None = setting(
        None,
        "Where other robots and the operator reach it. Left out: the NAME, or the `HostName` that your ssh "
        "configuration has for it.",
        pattern=_ADDRESS,
        pattern_says=_ADDRESS_SAYS,
        example='"192.168.1.11"',
    )
    listen: str | None = setting(
        None,
        "Address that its processes listen on. Left out: `address`. For a computer whose own name means "
        '127.0.1.1 to itself, or behind a forwarded address: "0.0.0.0".',
        pattern=_ADDRESS,
        pattern_says=_ADDRESS_SAYS,
        example='"0.0.0.0"',
    )
    user: str | None = setting(
        None,
        "User to log in as. Left out, as are port, key and jump hosts: as your ssh "
        "configuration has it for NAME.",
        pattern=r"[A-Za-z_][A-Za-z0-9_.-]{0,31}\$?",
        pattern_says="a user name",
        example='"robot"',
    )


@dataclass(frozen=True, slots=True)
class NetworkSection:
    """``[network]``: how processes reach each other, and who may give orders."""

    address: str = setting(
        "127.0.0.1",
        "Host name or address on which every process listens that has no `[host.NAME]`.",
        pattern=_ADDRESS,
        pattern_says=_ADDRESS_SAYS,
    )
    base_port: int = setting(
        7600,
        "First TCP port. The k-th robot of the file (from 0) listens on `base_port` + 2 k (agent) and "
        f"+ 2 k + 1 (plant); all must lie within {PORT_MIN} and {PORT_MAX}. Where one of them is taken, "
        "`handfast run` takes others, and says which.",
        ge=PORT_MIN,
        le=PORT_MAX - 1,
    )
    security: Literal["mtls", "off"] | None = setting(
        None,
        '`"mtls"`: every link is encrypted and both its ends prove who they are, orders are signed '
        '(docs/security.md). Left out: `"mtls"` for robots with a host, `"off"` where all runs on one '
        "machine (`handfast run`).",
    )
    operators: tuple[str, ...] = setting(
        (MAIN,),
        "Names of those whose orders robots take, where links are secured: `handfast keys --operator NAME` "
        "makes each a certificate.",
        example='["main", "anna"]',
    )
    topology: Literal["mesh", "routed"] | None = setting(
        None,
        '`"mesh"`: every robot is linked to every other one; nobody is in the middle. `"routed"`: each is '
        "linked to a router, which passes on to each what it listens to. Left out: routed where `routers` "
        f"are named, and for more than {MESH_ROBOTS_MAX} robots; else a mesh.",
    )
    routers: tuple[str, ...] = setting(
        (),
        "Routers. With them robots do not connect to each other but to the first of these that answers: for "
        "large fleets, and across subnets. The NAME of a `[host.NAME]`, with robots or without: `handfast "
        "up` starts one there, on the first port after those of the robots. Or `HOST:PORT`: there you have "
        "started one (`handfast router`, or a zenohd). `handfast run` starts as many on this machine. Left "
        "out in a fleet that is routed: one on each of the first two hosts that have robots; one with "
        "`handfast run`, where there are no hosts.",
        example='["rover1", "rover2"]',
    )
    link_timeout_s: float = setting(
        0.4,
        "A link between robots on which nothing comes for so long while it is opened is tried anew, and one "
        "to a router that is not open by then: so soon do robots find each other again. One takes four round "
        "trips to open; with radios that need longer for these, raise it. Who lets others connect and does "
        "not answer is given more time each time, four times as much in the end. (Operators' commands wait "
        "longer.)",
        unit="s",
        ge=0.1,
        le=10.0,
    )


@dataclass(frozen=True, slots=True)
class RecordingSection:
    """``[recording]``: what robots' computers record."""

    max_mb: int = setting(
        256,
        "Largest size of what a robot with a host records of itself for `handfast fetch`, 10^6 bytes; the "
        "oldest goes first. 0: it records nothing.",
        ge=0,
        le=1_000_000,
    )


_ROUTER = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]{0,252}|\[[0-9A-Fa-f:.]{2,45}\]):([1-9][0-9]{0,4})")


def check_hosts(values: Mapping[str, Any], reader: Reader) -> None:
    """Adds to `reader` what is wrong with hosts, who is on them, and routers."""
    _check_operators(values.get("fleet", {}).get("name"), values.get("network", {}).get("operators"), reader)
    network = values.get("network", {})
    hosts, robots = values.get("hosts"), values.get("robots")
    _check_routers(network.get("routers") or (), hosts, reader)
    _check_topology(network, reader)
    if hosts is None or robots is None:
        return  # they have problems of their own
    _check_addresses(hosts, reader)
    names = [host.get("name") for host in hosts]
    given = [row["host"] for row in robots if row.get("host") is not None]
    for number, row in enumerate(robots, 1):
        if "host" not in row:
            continue
        host, place = row["host"], f"robot[{number}].host"
        if host is None:
            if given:
                reader.add(
                    place,
                    f"is missing: other robots have a host, so all must have one, such as {show(given[0])}",
                )
        elif host not in names and None not in names:
            there_are = f"hosts are {', '.join(names)}" if names else "there is none"
            reader.add(place, f"there is no [host.{host}]; {there_are}")


def _check_addresses(hosts: Sequence[Mapping[str, Any]], reader: Reader) -> None:
    """Two names for one computer would have two sets of processes fight for its files."""
    first: dict[str, str] = {}
    for host in hosts:
        name, address = host.get("name"), host.get("address")
        if name is None or "address" not in host:
            continue
        address = (address or name).lower()
        if first.setdefault(address, name) != name:
            reader.add(
                f"host.{name}.address",
                f"host {first[address]} has the address {address} already: robots may share a host by its "
                "name",
            )


def _check_operators(fleet: str | None, operators: Sequence[str | None] | None, reader: Reader) -> None:
    if operators is None or fleet is None:
        return
    if not operators:
        reader.add("network.operators", f"names nobody: nobody could drive or stop it, write [{show(MAIN)}]")
    for number, name in enumerate(operators, 1):
        try:
            of_operator(fleet, name or MAIN)
        except IdentityError as error:
            reader.add(f"network.operators[{number}]", str(error))


def _check_topology(network: Mapping[str, Any], reader: Reader) -> None:
    if network.get("topology") == "mesh" and network.get("routers"):
        reader.add("network.topology", "is a mesh, which has no routers: leave out topology or routers")


def has_host_routers(network: Mapping[str, Any], robots: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a fleet of these tables has routers on hosts of its own (`agent.fleet.routers`)."""
    if routers := network.get("routers"):
        return any(router is not None and names_host(router) for router in routers)
    topology = network.get("topology")
    is_routed = topology == "routed" or (topology is None and len(robots) > MESH_ROBOTS_MAX)
    return is_routed and any(row.get("host") is not None for row in robots)


def names_host(router: str) -> bool:
    """Whether an entry of `network.routers` is the name of one of the fleet's hosts."""
    return ":" not in router


def _check_routers(
    routers: Sequence[str | None], hosts: Sequence[Mapping[str, Any]] | None, reader: Reader
) -> None:
    names = None if hosts is None else [host.get("name") for host in hosts]
    for number, router in enumerate(routers, 1):
        if router is None:
            continue
        place = f"network.routers[{number}]"
        if routers.index(router) + 1 < number:
            reader.add(place, f"{show(router)} is network.routers[{routers.index(router) + 1}] already")
            continue
        found = _ROUTER.fullmatch(router)
        if names_host(router):
            if names is not None and None not in names and router not in names:
                there_are = f"hosts are {', '.join(map(str, names))}" if names else "there is none"
                reader.add(
                    place,
                    f"there is no [host.{router}]; {there_are}. A router elsewhere is HOST:PORT, such as "
                    '"192.168.1.2:7447"',
                )
        elif found is None or int(found[2]) > 65535:
            reader.add(place, f'must be HOST:PORT, such as "192.168.1.2:7447", got {show(router)}')
        elif int(found[2]) > PORT_MAX:
            reader.add(
                place,
                f"port {found[2]} must be at most {PORT_MAX}: Linux gives those above to outgoing links",
            )


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
