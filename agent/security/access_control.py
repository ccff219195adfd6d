"""Zenoh's settings for mutual TLS and access control: who may publish what on the bus (PURE).

Every process checks what comes in over each of its links, by the common name of the certificate at the other
end: all is denied but what is listed here. Rules that deny leak (wildcards go round them), so there are none.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from handfast.agent.messages import key_expressions
from handfast.agent.security.identity import MAIN, Identity, of_operator, of_robot, of_router

_OUT: Final = "out"
_LISTEN: Final = "listen"
_EVERYTHING: Final = (
    "put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Security:
    """What a process needs to take part in a secured fleet: who it is, its files, and who else there is.

    Args:
        identity: its own.
        authority, certificate, key: paths of its files; `agent.security.credentials.load` finds them whole.
        robots: ids of the fleet's robots.
        operators, routers: names of those that there may be.
    """

    identity: Identity
    authority: str
    certificate: str
    key: str
    robots: tuple[int, ...]
    operators: tuple[str, ...] = (MAIN,)
    routers: tuple[str, ...] = (MAIN,)

    def settings(self) -> dict[str, Any]:
        """Zenoh's settings, by their paths in its configuration."""
        return {
            "transport/link/tls": tls_settings(self.authority, self.certificate, self.key),
            "access_control": access_settings(self.identity.fleet, self.robots, self.operators, self.routers),
        }


def tls_settings(authority: str, certificate: str, key: str) -> dict[str, Any]:
    """TLS on every link, where both ends prove who they are; the one that dials checks the address, too."""
    return {
        "root_ca_certificate": authority,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "enable_mtls": True,  # left out, a listener lets those in who have no certificate
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def access_settings(
    fleet: str,
    robots: Iterable[int],
    operators: Sequence[str] = (MAIN,),
    routers: Sequence[str] = (MAIN,),
) -> dict[str, Any]:
    """What each of the fleet's certificates may publish; the same for agents, plants, operators and routers.

    A robot publishes on its own keys (`agent.messages.key_expressions.published`; none that nobody takes, no
    wildcards), and that it is alive. Operators give orders. A router passes on what others publish: it has
    the same list, and has looked already. All may listen to all of the fleet.

    Raises:
        handfast.agent.security.identity.IdentityError: a name or id that no certificate can have.
    """
    rules: list[dict[str, Any]] = [
        # Nothing is held back from those of the fleet. All others get nothing, whoever has signed their
        # certificates: Zenoh trusts the web's authorities besides ours, where a link is dialled.
        _rule(_OUT, _EVERYTHING, ["**", *key_expressions.batches(fleet)], flow="egress"),
        _rule(
            _LISTEN,
            ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"),
            [key_expressions.everything(fleet), *key_expressions.batches(fleet)],
        ),
    ]
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def allow(
        group: str, members: Sequence[Identity], may_put: Sequence[str], may_live: Sequence[str]
    ) -> None:
        if not members:
            return
        names = [member.common_name for member in members]
        subjects.append({"id": group, "cert_common_names": names})
        allowed = [_OUT, _LISTEN]
        for kind, where in (("put", may_put), ("liveliness_token", may_live)):
            if where:
                rules.append(_rule(f"{group} {kind}", (kind,), where))
                allowed.append(f"{group} {kind}")
        policies.append({"rules": allowed, "subjects": [group]})

    for robot in robots:
        allow(
            f"robot {robot}",
            [of_robot(fleet, robot)],
            key_expressions.published(fleet, robot),
            [key_expressions.alive(fleet, robot, role) for role in key_expressions.ROLES],
        )
    allow("operators", [of_operator(fleet, name) for name in operators], _orders(fleet), [])
    all_of_it = [key_expressions.everything(fleet)]
    may_put = [*all_of_it, *key_expressions.batches(fleet)]
    allow("routers", [of_router(fleet, name) for name in routers], may_put, all_of_it)
    return {
        "enabled": True,  # left out, there is no access control, and no warning
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _orders(fleet: str) -> list[str]:
    return [
        key(fleet)
        for key in (
            key_expressions.mission,
            key_expressions.stop,
            key_expressions.resume,
            key_expressions.faults,
            key_expressions.heartbeat,
            key_expressions.ask,
            key_expressions.events,
        )
    ]


def _rule(name: str, messages: Sequence[str], where: Sequence[str], flow: str = "ingress") -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(where),
    }
