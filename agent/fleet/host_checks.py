"""What is wrong with where a fleet's processes run (PURE); see `agent.fleet.checks`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from agent.common.schema import Reader, show
from agent.fleet.host_sections import PORT_MAX
from agent.security.identity import MAIN, IdentityError, of_operator

_ROUTER = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]{0,252}|\[[0-9A-Fa-f:.]{2,45}\]):([1-9][0-9]{0,4})")


def check_hosts(values: Mapping[str, Any], reader: Reader) -> None:
    """Adds to `reader` what is wrong with hosts, who is on them, and routers."""
    _check_operators(values.get("fleet", {}).get("name"), values.get("network", {}).get("operators"), reader)
    _check_routers(values.get("network", {}).get("routers") or (), reader)
    hosts, robots = values.get("hosts"), values.get("robots")
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


def _check_routers(routers: Sequence[str | None], reader: Reader) -> None:
    for number, router in enumerate(routers, 1):
        if router is None:
            continue
        found = _ROUTER.fullmatch(router)
        if found is None or int(found[2]) > 65535:
            reader.add(
                f"network.routers[{number}]",
                f'must be HOST:PORT, such as "192.168.1.2:7447", got {show(router)}',
            )
        elif int(found[2]) > PORT_MAX:
            reader.add(
                f"network.routers[{number}]",
                f"port {found[2]} must be at most {PORT_MAX}: Linux gives those above to outgoing links",
            )
