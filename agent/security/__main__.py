"""``python -m handfast.agent.security``: a host's part in getting the certificates of its robots and its
router, called over ssh.

    request   says as JSON whether a certificate is needed, and then the request for it; a line for each
              robot, then for the router
    store     takes the certificate and the authority's from standard input

No secret passes through it: the private key is made here and stays.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from handfast.agent.common.errors import BAD_INPUT, PASSED
from handfast.agent.security.certificates import PEM_BYTES_MAX
from handfast.agent.security.credentials import CredentialsError, authority_of, make_request, store, wanting
from handfast.agent.security.identity import Identity, IdentityError, addresses, of_robot, of_router
from handfast.agent.security.private_files import reason

_INPUT_MAX: Final = 2 * PEM_BYTES_MAX


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command; returns the exit status: 0, or 2 with one line on standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m handfast.agent.security", description="Credentials of robots."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    request = commands.add_parser("request", help="whether a certificate is needed, and the request for it")
    request.add_argument(
        "--addresses", default="", metavar="A,B", help="what the certificate must hold for, by commas"
    )
    request.add_argument(
        "--ca", metavar="FILE", help="the authority's certificate of now; - reads it from standard input"
    )
    request.set_defaults(command=_request)
    take = commands.add_parser("store", help="take its certificate and the authority's, on standard input")
    take.set_defaults(command=_store)
    for command in (request, take):
        command.add_argument("--folder", required=True, metavar="DIR", help="where the credentials are")
        command.add_argument("--fleet", required=True, metavar="NAME", help="name of the fleet")
        command.add_argument("--router", metavar="NAME", help="name of the router")
    several = "id of a robot; may be given several times"
    request.add_argument("--robot", type=int, action="append", default=[], metavar="ID", help=several)
    take.add_argument("--robot", type=int, metavar="ID", help="id of the robot")
    options = parser.parse_args(argv)
    try:
        answers = options.command(options, Path(options.folder).expanduser())
    except (CredentialsError, IdentityError) as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    for each in answers:
        print(json.dumps(each))
    return PASSED


def _request(options: argparse.Namespace, folder: Path) -> list[dict[str, object]]:
    wanted = addresses(filter(None, options.addresses.split(",")))
    authority = None
    if options.ca is not None:
        try:
            authority = _input() if options.ca == "-" else Path(options.ca).read_bytes()
        except OSError as error:
            raise CredentialsError(f"cannot read {options.ca}: {reason(error)}") from None
    identities = [of_robot(options.fleet, robot) for robot in options.robot]
    if options.router is not None:
        identities.append(of_router(options.fleet, options.router))
    return [_requested(folder, identity, wanted, authority) for identity in identities]


def _requested(
    folder: Path, identity: Identity, wanted: Sequence[str], authority: bytes | None
) -> dict[str, object]:
    why = wanting(folder, identity, wanted, authority, time.time())
    # Whoever signs looks whether that is another's robot.
    answer: dict[str, object] = {
        "identity": identity.common_name,
        "wanting": why,
        "authority": authority_of(folder),
    }
    if why:
        answer["request"] = make_request(folder, identity).decode("ascii")
    return answer


def _store(options: argparse.Namespace, folder: Path) -> list[dict[str, object]]:
    if (options.robot is None) == (options.router is None):
        raise CredentialsError("name one: --robot ID or --router NAME")
    if options.robot is not None:
        identity = of_robot(options.fleet, options.robot)
    else:
        identity = of_router(options.fleet, options.router)
    store(folder, identity, _input(), time.time())
    return [{"identity": identity.common_name, "wanting": ""}]


def _input() -> bytes:
    data = sys.stdin.buffer.read(_INPUT_MAX + 1)
    if len(data) > _INPUT_MAX:
        raise CredentialsError(f"over {_INPUT_MAX} bytes came on standard input: these are no certificates")
    return data


if __name__ == "__main__":
    sys.exit(main())
