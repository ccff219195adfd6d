"""``python -m agent.credentials``: a robot's part in getting its certificate, called over ssh.

    request   says as JSON whether a certificate is needed, and then the request for it
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

from agent.certificates import PEM_BYTES_MAX
from agent.credentials import CredentialsError, Files, load, make_request, store, wanting
from agent.identity import Identity, IdentityError, addresses, of_robot

DONE, FAILED = 0, 2
_INPUT_MAX: Final = 2 * PEM_BYTES_MAX


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command; returns the exit status: 0, or 2 with one line on standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m agent.credentials", description="Credentials of one robot."
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
        command.add_argument("--robot", required=True, type=int, metavar="ID", help="id of the robot")
    options = parser.parse_args(argv)
    try:
        identity = of_robot(options.fleet, options.robot)
        told = options.command(options, identity, Path(options.folder).expanduser())
    except (CredentialsError, IdentityError) as error:
        print(error, file=sys.stderr)
        return FAILED
    print(json.dumps(told))
    return DONE


def _request(options: argparse.Namespace, identity: Identity, folder: Path) -> dict[str, object]:
    wanted = addresses(filter(None, options.addresses.split(",")))
    authority = None
    if options.ca is not None:
        try:
            authority = _input() if options.ca == "-" else Path(options.ca).read_bytes()
        except OSError as error:
            raise CredentialsError(f"cannot read {options.ca}: {(error.strerror or '').lower()}") from None
    why = wanting(folder, identity, wanted, authority, time.time())
    told: dict[str, object] = {"identity": identity.common_name, "wanting": why}
    if why:
        told["request"] = make_request(folder, identity).decode("ascii")
    else:
        told |= _present(folder, identity)
    return told


def _store(_options: argparse.Namespace, identity: Identity, folder: Path) -> dict[str, object]:
    store(folder, identity, _input(), time.time())
    return {"identity": identity.common_name, "wanting": ""} | _present(folder, identity)


def _present(folder: Path, identity: Identity) -> dict[str, object]:
    found = load(folder, identity, time.time())
    return {
        "not_after_s": found.certificate.not_after_s,
        "addresses": list(found.certificate.addresses),
        "fingerprint": found.certificate.fingerprint,
        "authority": found.authority_fingerprint,
        "key": str(Files(folder, identity).key),
    }


def _input() -> bytes:
    data = sys.stdin.buffer.read(_INPUT_MAX + 1)
    if len(data) > _INPUT_MAX:
        raise CredentialsError(f"over {_INPUT_MAX} bytes came on standard input: these are no certificates")
    return data
