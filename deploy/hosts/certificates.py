"""Certificates for robots on hosts: their keys are made there, what goes to and fro is public.

`HostKeys` brings requests and certificates itself, over ssh. `read_requests` and `answer` are for programs
that carry them (`handfast keys --sign`).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from agent.fleet.model import Fleet
from agent.security.identity import of_robot
from agent.security.private_files import reason
from deploy.console.arguments import InputError
from deploy.hosts.connection import HostConnection, HostError
from deploy.inventory.certificate_authority import Authority, AuthorityError
from deploy.inventory.hosts import located, robots_on

MODULE: Final = "agent.security"
REQUESTS_BYTES_MAX: Final = 4_000_000
REQUESTS_SHAPE: Final = 'must be JSON, a certificate request (PEM) by robot: {"1": "-----BEGIN ..."}'


class HostKeys:
    """Gives robots certificates where they have none that will do. Hosts may be served side by side.

    Args:
        fleet: located.
        authority: of the fleet.
    """

    def __init__(self, fleet: Fleet, authority: Authority) -> None:
        self._fleet, self._authority = fleet, authority
        self._addresses = {host.name: host.address or host.name for host in fleet.hosts}

    def __call__(self, connection: HostConnection, version: str, folder: str) -> None:
        """Sees to the robots of one host.

        Args:
            version: what is installed there.
            folder: where their keys are, there.

        Raises:
            HostError: one cannot be made there, or the authority does not sign.
        """
        # A connection's own host may have no address: it is as ssh's configuration says.
        addresses = [self._addresses[connection.host.name]]
        robots = robots_on(self._fleet, connection.host)
        who = ["--folder", folder, "--fleet", self._fleet.fleet.name]
        asked = ["request", *who, "--addresses", ",".join(addresses), "--ca", "-"]
        asked += [word for robot in robots for word in ("--robot", str(robot))]
        authority = self._authority.certificate_pem.decode("ascii")
        output = connection.ask("run", module=MODULE, arguments=asked, version=version, text=authority)
        for robot, line in zip(robots, output.splitlines(), strict=True):
            answer = json.loads(line)
            if answer["wanting"]:
                text = self._signed(robot, answer["request"], addresses)
                words = ["store", *who, "--robot", str(robot)]
                connection.ask("run", module=MODULE, arguments=words, version=version, text=text)

    def _signed(self, robot: int, request: str, addresses: Sequence[str]) -> str:
        identity = of_robot(self._fleet.fleet.name, robot)
        try:
            signed = self._authority.sign(identity, request.encode("ascii"), addresses, time.time())
        except AuthorityError as error:
            raise HostError(str(error)) from None
        return signed.decode("ascii")


def read_requests(file: str, fleet: Fleet) -> dict[int, str]:
    """Requests by robot, from a file; ``-`` is standard input.

    Raises:
        InputError: it cannot be read, or is something else.
    """
    what = "standard input" if file == "-" else file
    try:
        with open(sys.stdin.fileno() if file == "-" else Path(file), "rb", closefd=file != "-") as stream:
            data = stream.read(REQUESTS_BYTES_MAX + 1)
    except OSError as error:
        raise InputError(f"cannot read {file}: {reason(error)}") from None
    try:
        found = json.loads(data) if len(data) <= REQUESTS_BYTES_MAX else None
    except ValueError:  # no JSON, or no UTF-8
        found = None
    if not isinstance(found, dict) or not all(map(_is_text, found.values())):
        raise InputError(f"{what} {REQUESTS_SHAPE}")
    for name in found:
        if name not in map(str, fleet.ids):
            raise InputError(f"{what}: there is no robot {name[:20]} in {fleet.fleet.name}")
    return {int(name): request for name, request in found.items()}


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isascii()


def answer(fleet: Fleet, authority: Authority, requests: dict[int, str], now_s: float) -> str:
    """JSON: the authority's own certificate, and for each robot what ``agent.security store``
    takes.

    A certificate holds for the address of the robot's host.

    Raises:
        deploy.inventory.certificate_authority.AuthorityError: a request is not one of its robot.
    """
    hosts = {host.name: host for host in located(fleet).hosts}
    signed = {}
    for robot, request in requests.items():
        host = hosts.get(fleet.robot(robot).host or "")
        if host is None:
            raise InputError(
                f"robot {robot} has no host: `handfast keys --robot {robot} --out DIR` makes its key"
            )
        where = [host.address or host.name]
        name = of_robot(fleet.fleet.name, robot)
        signed[str(robot)] = authority.sign(name, request.encode(), where, now_s).decode("ascii")
    return json.dumps({"authority": authority.certificate_pem.decode("ascii"), "signed": signed})
