"""A firewall for a robot's computer that lets strangers open few connections to the fleet's ports (PURE).

nftables sees packets, not certificates: it cannot tell who was let in from who was not, as the proxy does
(`agent.admission`). So whoever is to be sure of a link, in a flood, has to be named.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final

from agent.admission.budgets import AGAIN_PER_S, FIRST_PER_S
from agent.fleet.model import Fleet

OWN: Final = ("127.0.0.1", "::1")
"""Where a robot's own processes dial each other from."""
PER_S: Final = round(FIRST_PER_S + AGAIN_PER_S)
"""Connections of all strangers together, a second: half of what Zenoh's acceptor stands if all fail."""
OF_ONE_PER_MINUTE: Final = 30
OF_ONE_BURST: Final = 8
REMEMBERED: Final = "size 65535; flags dynamic, timeout; timeout 5m"


def ruleset(fleet: Fleet, known: Iterable[str], devices: Sequence[str] = ()) -> str:
    """The rules as ``nft -f`` reads them: a table of their own, which takes the place of one from before.

    Args:
        known: addresses, as numbers, that may open as many connections as they like.
        devices: network devices through which alone connections may come, beside the loopback; none: any.

    Raises:
        ValueError: one is no address.
    """
    first = fleet.network.base_port
    has_routers = any(router.host is not None for router in fleet.routers)
    last = first + 2 * len(fleet.robots) - 1 + has_routers
    addresses = {ip_address(each.partition("%")[0]) for each in (*OWN, *known)}
    only = [f'"{device}"' for device in ("lo", *devices)] if devices else []
    table = f"handfast_{fleet.fleet.name.replace('-', '_')}"
    return "\n".join(
        (
            f"table inet {table}",
            f"delete table inet {table}",
            f"table inet {table} {{",
            _set("known4", "ipv4_addr", sorted(a for a in addresses if isinstance(a, IPv4Address))),
            _set("known6", "ipv6_addr", sorted(a for a in addresses if isinstance(a, IPv6Address))),
            *(f"  set strangers{which} {{ type ipv{which}_addr; {REMEMBERED}; }}" for which in (4, 6)),
            "  chain input {",
            "    type filter hook input priority filter; policy accept;",
            *([f"    tcp dport {first}-{last} iifname != {{ {', '.join(only)} }} drop"] if only else []),
            f"    tcp dport {first}-{last} tcp flags & (syn | ack) == syn jump opening",
            "  }",
            "  chain opening {",
            "    ip saddr @known4 accept",
            "    ip6 saddr @known6 accept",
            f"    add @strangers4 {{ ip saddr {_limit()} }} drop",
            f"    add @strangers6 {{ ip6 saddr & ffff:ffff:ffff:ffff:: {_limit()} }} drop",
            f"    limit rate over {PER_S}/second burst {PER_S} packets drop",
            "  }",
            "}",
            "",
        )
    )


def _set(name: str, kind: str, addresses: Iterable[object]) -> str:
    return f"  set {name} {{ type {kind}; elements = {{ {', '.join(map(str, addresses))} }}; }}"


def _limit() -> str:
    return f"limit rate over {OF_ONE_PER_MINUTE}/minute burst {OF_ONE_BURST} packets"
