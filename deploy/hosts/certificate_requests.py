"""Has a fleet's authority sign what robots ask for, for programs that bring it to and fro themselves."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Final

from agent.fleet.fleet import Fleet
from agent.security.identity import of_robot
from agent.security.private_files import reason
from deploy.console.arguments import InputError
from deploy.inventory.certificate_authority import Authority
from deploy.inventory.hosts import located

REQUESTS_BYTES_MAX: Final = 4_000_000
SHAPE: Final = 'must be JSON, a certificate request (PEM) by robot: {"1": "-----BEGIN ..."}'


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
        raise InputError(f"{what} {SHAPE}")
    for name in found:
        if name not in map(str, fleet.ids):
            raise InputError(f"{what}: there is no robot {name[:20]} in {fleet.fleet.name}")
    return {int(name): request for name, request in found.items()}


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isascii()


def answer(fleet: Fleet, authority: Authority, requests: dict[int, str], now_s: float) -> str:
    """JSON: the authority's own certificate, and for each robot what ``agent.security.credentials store``
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
