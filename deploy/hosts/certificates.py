"""Certificates for robots and routers on hosts: their keys are made there, what goes to and fro is public.

`HostKeys` brings requests and certificates itself, over ssh. `read_requests` and `answer` are for programs
that carry them (`handfast keys --sign`).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from agent.common.wording import printable
from agent.fleet.hosts import HostSection
from agent.fleet.model import Fleet
from agent.security.certificates import PEM_BYTES_MAX, CertificateError, authority_from_pem, fingerprint
from agent.security.credentials import AUTHORITY_CERTIFICATE
from agent.security.identity import Identity, of_robot, of_router
from agent.security.private_files import reason
from deploy.console.arguments import InputError
from deploy.hosts.connection import HostConnection, HostError
from deploy.inventory.certificate_authority import Authority, AuthorityError
from deploy.inventory.hosts import located, robots_on, used_hosts
from deploy.inventory.operator_credentials import short

MODULE: Final = "agent.security"
REQUESTS_BYTES_MAX: Final = 4_000_000
REQUEST_BYTES_MAX: Final = 8_192
"""One robot's, with what it says beside it, as JSON."""
REQUESTS_SHAPE: Final = (
    "must be JSON, by robot what `agent.security request` says of it (by router.1 for a router): "
    '{"1": {"request": "-----BEGIN ...", "authority": FINGERPRINT}}'
)
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
        f"Ask for a certificate of theirs (`handfast keys {file} --request`), or, where theirs is lost for "
        f"good, replace it (`handfast up {file} --take-over`)"
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
        take_over: whether robots of another authority are given certificates of this one.
    """

    def __init__(
        self, fleet: Fleet, authority: Authority | None, own: bytes, file: str, *, take_over: bool = False
    ) -> None:
        self._fleet, self._authority, self._file, self._take_over = fleet, authority, file, take_over
        self._addresses = {host.name: host.address or host.name for host in fleet.hosts}
        self._own_pem, self._own = own.decode("ascii"), fingerprint(authority_from_pem(own))
        self._found: dict[str, str] = {}

    @property
    def is_first(self) -> bool:
        """Whether no robot has been given a certificate by this authority yet, as far as is known here."""
        return self._authority is not None and not self._authority.has_robots and not self._take_over

    def look(self, connection: HostConnection) -> None:
        """Looks which authority the robots of a host have, before anything changes there.

        Raises:
            AnotherAuthorityError: one that this machine's has not replaced.
            HostError: the host does not answer.
        """
        keys, name = f"fleets/{self._fleet.fleet.name}/keys", AUTHORITY_CERTIFICATE
        found = ""
        if name in connection.ask("listing", folder=keys, pattern=name, most=1):
            pem = connection.exchange(
                "get", None, data_bytes=PEM_BYTES_MAX, path=f"{keys}/{name}", most=PEM_BYTES_MAX
            )[1]
            with suppress(CertificateError):  # one that is damaged rules nobody
                found = fingerprint(authority_from_pem(pem))
        self._found[connection.host.name] = found
        if self._authority is not None:
            refuse_another(self._authority, found, self._file, take_over=self._take_over)
        elif found not in ("", self._own):
            raise AnotherAuthorityError(refusal(found, self._own, self._file))

    def replaces(self, host: str) -> bool:
        """Whether the robots of a host that was looked at have another authority, and are to get this one."""
        return self._found[host] not in ("", self._own)

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


def refuse_another(authority: Authority, found: str, file: str, *, take_over: bool) -> None:
    """Raises `AnotherAuthorityError` where `found`, the fingerprint of robots' authority ("" for none), is
    neither this one's nor one's that this one has replaced; unless they are to be taken over."""
    if found and not take_over and not authority.has_been(found):
        raise AnotherAuthorityError(refusal(found, authority.fingerprint, file))


class Asked(NamedTuple):
    """A request (PEM), and the fingerprint of the authority that who asks has, "" for none; or why it is no
    request."""

    request: str
    authority: str
    trouble: str = ""


def read_input(file: str, most: int = REQUESTS_BYTES_MAX) -> bytes:
    """What is in a file, and one byte more than `most` of one that is too large; ``-`` is standard input.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with open(sys.stdin.fileno() if file == "-" else Path(file), "rb", closefd=file != "-") as stream:
            return stream.read(most + 1)
    except OSError as error:
        raise InputError(f"cannot read {file}: {reason(error)}") from None


def read_requests(data: bytes, what: str, fleet: Fleet) -> dict[str, Asked]:
    """Requests, as `REQUESTS_SHAPE` says. What one says is wrong with its own alone.

    Args:
        what: where they are from, for messages.

    Raises:
        InputError: the whole is something else.
    """
    try:
        found = json.loads(data) if len(data) <= REQUESTS_BYTES_MAX else None
    except ValueError:  # no JSON, or no UTF-8
        found = None
    if not isinstance(found, dict):
        raise InputError(
            f"{what} is no request: neither an operator's (PEM, of --request) nor robots', "
            f"which {REQUESTS_SHAPE}"
        )
    there_are = _identities(fleet)
    for name in found:
        if name not in there_are:
            raise InputError(f"{what}: there is no robot {name[:20]} in {fleet.fleet.name}")
    return {name: _asked(each, f"{what}: {there_are[name]}") for name, each in found.items()}


def _identities(fleet: Fleet) -> dict[str, Identity]:
    """All that may ask for a certificate; robots without a host, too."""
    found = {str(robot): of_robot(fleet.fleet.name, robot) for robot in fleet.ids}
    for host in used_hosts(fleet):
        found |= identities_on(fleet, host)
    return found


def _asked(value: object, who: str) -> Asked:
    texts = [value.get(name) for name in ("request", "authority")] if isinstance(value, dict) else [None]
    if all(isinstance(text, str) and text.isascii() and len(text) <= REQUEST_BYTES_MAX for text in texts):
        return Asked(*map(str, texts))
    return Asked("", "", f"{who} {REQUESTS_SHAPE}")


class Answer(NamedTuple):
    """By who has asked, what ``agent.security store`` takes (PEM), and why there is no certificate."""

    signed: dict[str, str]
    refused: dict[str, str]

    def as_json(self, authority: Authority) -> str:
        """With the authority's own certificate, for who carries it."""
        about = {"authority": authority.certificate_pem.decode("ascii"), **self._asdict()}
        return json.dumps(about)


def answer(
    fleet: Fleet,
    authority: Authority,
    requests: Mapping[str, Asked],
    now_s: float,
    file: str,
    *,
    take_over: bool = False,
) -> Answer:
    """What the authority says to requests; one that it refuses takes nothing from the others.

    A certificate holds for the address of the host.

    Args:
        file: the fleet's, as it is named in commands.
        take_over: whether robots of another authority are given certificates of this one.
    """
    fleet = located(fleet)
    identities = _identities(fleet)
    hosts = {name: host for host in used_hosts(fleet) for name in identities_on(fleet, host)}
    found = Answer({}, {})
    for name, asked in requests.items():
        try:
            if asked.trouble:
                raise AuthorityError(asked.trouble)
            if name not in hosts:
                raise AuthorityError(
                    f"robot {name} has no host: `handfast keys --robot {name} --out DIR` makes its key"
                )
            refuse_another(authority, asked.authority, file, take_over=take_over)
            where = [hosts[name].address or hosts[name].name]
            signed = authority.sign(identities[name], asked.request.encode(), where, now_s)
            found.signed[name] = signed.decode("ascii")
        except (AnotherAuthorityError, AuthorityError) as error:
            found.refused[name] = str(error)
    return found
