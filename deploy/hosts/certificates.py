"""Certificates for robots and routers on hosts, whose private keys are made there and stay there."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Final

from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.security.certificates import (
    PEM_BYTES_MAX,
    CertificateError,
    authority_from_pem,
    fingerprint,
)
from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE
from handfast.agent.security.identity import Identity, of_robot, of_router
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.inventory.certificate_authority import Authority, AuthorityError
from handfast.deploy.inventory.hosts import robots_on
from handfast.deploy.inventory.operator_credentials import short

MODULE: Final = "handfast.agent.security"
WHY_MAX: Final = 200


def identities_on(fleet: Fleet, host: HostSection) -> dict[str, Identity]:
    """Who on a host needs a certificate: its robots ("1"), then its router ("router.1"), if it has one."""
    name = fleet.fleet.name
    found = {str(robot): of_robot(name, robot) for robot in robots_on(fleet, host)}
    if router := fleet.router_on(host.name):
        found[f"router.{router.number}"] = of_router(name, router.identity_name)
    return found


def naming(identity: Identity) -> list[str]:
    """How `agent.security` is told whose certificate is meant."""
    return [f"--{identity.role}", identity.name]


class AnotherAuthorityError(HostError):
    """The robots of a host have certificates of an authority that is not this machine's."""


def refusal(found: str, own: str, file: str) -> str:
    """Why robots that have another authority are left as they are, and what to do.

    Args:
        found, own: fingerprints of their authority, and of this machine's.
        file: the fleet's, as it is named in commands.
    """
    return (
        f"left as it was: its robots have another authority, {short(found)}; this machine's is {short(own)}. "
        f"Ask for a certificate of theirs (`handfast keys {file} --request`), or, where theirs was replaced "
        f"or is lost, `handfast down {file}` first"
    )


class HostKeys:
    """Gives robots, and routers on hosts, certificates where they have none that will do. Hosts may be served
    side by side.

    Args:
        fleet: located.
        authority: of the fleet; None where it is on another computer: then robots that need a certificate
            are refused.
        own: the certificate of the authority that this operator knows (PEM).
        file: the fleet's, as it is named in commands.
    """

    def __init__(self, fleet: Fleet, authority: Authority | None, own: bytes, file: str) -> None:
        self._fleet, self._authority, self._file = fleet, authority, file
        self._addresses = {host.name: host.address or host.name for host in fleet.hosts}
        self._own_pem, self._own = own.decode("ascii"), fingerprint(authority_from_pem(own))

    @property
    def is_first(self) -> bool:
        """Whether no robot has been given a certificate by this authority yet, as far as is known here."""
        return self._authority is not None and not self._authority.has_robots

    def look(self, connection: HostConnection) -> str:
        """Look which authority the robots of a host have, before anything changes there.

        Returns:
            The fingerprint of another authority that this one is to replace, "" for none: no process of the
            fleet runs on that host.

        Raises:
            AnotherAuthorityError: another one, which stays.
            HostError: the host does not answer.
        """
        fleet, name = self._fleet.fleet.name, AUTHORITY_CERTIFICATE
        keys = f"fleets/{fleet}/keys"
        if name not in connection.ask("listing", folder=keys, pattern=name, most=1):
            return ""
        pem = connection.exchange(
            "get", None, data_bytes=PEM_BYTES_MAX, path=f"{keys}/{name}", most=PEM_BYTES_MAX
        )[1]
        try:
            found = fingerprint(authority_from_pem(pem))
        except CertificateError:  # one that is damaged rules nobody
            return ""
        if found == self._own:
            return ""
        units = connection.ask("status", fleet=fleet)["units"]
        runs = any(about.get("ActiveState") == "active" for about in units.values())
        if runs or self._authority is None:
            raise AnotherAuthorityError(refusal(found, self._own, self._file))
        return found

    def __call__(self, connection: HostConnection, version: str, folder: str, *, robots: bool = True) -> None:
        """Sees to the robots and the router of one host.

        Args:
            version: what is installed there.
            folder: where their keys are, there.
            robots: False for the router alone.

        Raises:
            HostError: one cannot be made there, or the authority does not sign.
        """
        # A connection's own host may have no address: it is as ssh's configuration says.
        addresses = [self._addresses[connection.host.name]]
        identities = [
            identity
            for identity in identities_on(self._fleet, connection.host).values()
            if robots or identity.robot is None
        ]
        if not identities:
            return
        who = ["--folder", folder, "--fleet", self._fleet.fleet.name]
        asked = ["request", *who, "--addresses", ",".join(addresses), "--ca", "-"]
        asked += [word for identity in identities for word in naming(identity)]
        output = connection.ask("run", module=MODULE, arguments=asked, version=version, text=self._own_pem)
        for identity, line in zip(identities, output.splitlines(), strict=True):
            answer = json.loads(line)
            if answer["wanting"]:
                text = self._signed(identity, answer["request"], addresses, answer["wanting"])
                words = ["store", *who, *naming(identity)]
                connection.ask("run", module=MODULE, arguments=words, version=version, text=text)

    def _signed(self, identity: Identity, request: str, addresses: Sequence[str], why: str) -> str:
        if self._authority is None:
            raise HostError(
                f"{identity} needs a certificate ({printable(why)[:WHY_MAX]}), and the authority "
                f"{short(self._own)} is not on this machine: `handfast up` where it is"
            )
        try:
            signed = self._authority.sign(identity, request.encode("ascii"), addresses, time.time())
        except AuthorityError as error:
            raise HostError(str(error)) from None
        return signed.decode("ascii")
