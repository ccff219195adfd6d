"""Certificates for the robots of a host: their keys are made there, what goes to and fro is public."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Final

from agent.fleet import Fleet
from agent.identity import of_robot
from deploy.authority import Authority, AuthorityError
from deploy.host_connection import HostConnection, HostError
from deploy.hosts import robots_on

MODULE: Final = "agent.credentials"


class HostKeys:
    """Gives robots certificates where they have none that will do. Hosts may be served side by side.

    Args:
        fleet: located.
        authority: of the fleet.
    """

    def __init__(self, fleet: Fleet, authority: Authority) -> None:
        self._fleet, self._authority = fleet, authority

    def __call__(self, connection: HostConnection, version: str, folder: str) -> list[int]:
        """Sees to the robots of one host; returns those that got new ones.

        Args:
            version: what is installed there.
            folder: where their keys are, there.

        Raises:
            HostError: one cannot be made there, or the authority does not sign.
        """
        host = connection.host
        return [
            robot
            for robot in robots_on(self._fleet, host)
            if self._provide(connection, robot, version, folder, [host.address or host.name])
        ]

    def _provide(
        self, connection: HostConnection, robot: int, version: str, folder: str, addresses: Sequence[str]
    ) -> bool:
        name = self._fleet.fleet.name
        who = ["--folder", folder, "--fleet", name, "--robot", str(robot)]
        asked = ["request", *who, "--addresses", ",".join(addresses), "--ca", "-"]
        authority = self._authority.certificate_pem.decode("ascii")
        told = json.loads(
            connection.ask("run", module=MODULE, arguments=asked, version=version, text=authority)
        )
        if not told["wanting"]:
            return False
        try:
            signed = self._authority.sign(
                of_robot(name, robot), told["request"].encode("ascii"), addresses, time.time()
            )
        except AuthorityError as error:
            raise HostError(str(error)) from None
        text = signed.decode("ascii")
        connection.ask("run", module=MODULE, arguments=["store", *who], version=version, text=text)
        return True
