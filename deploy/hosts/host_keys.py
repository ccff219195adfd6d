"""Certificates for the robots of a host: their keys are made there, what goes to and fro is public."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Final

from agent.fleet.fleet import Fleet
from agent.security.identity import of_robot
from deploy.hosts.connection import HostConnection, HostError
from deploy.inventory.certificate_authority import Authority, AuthorityError
from deploy.inventory.hosts import robots_on

MODULE: Final = "agent.security.credentials"


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
        told = connection.ask("run", module=MODULE, arguments=asked, version=version, text=authority)
        for robot, line in zip(robots, told.splitlines(), strict=True):
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
