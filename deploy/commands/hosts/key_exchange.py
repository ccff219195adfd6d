"""What `handfast keys` passes between the authority's computer and another operator's."""

from __future__ import annotations

import argparse
from pathlib import Path

from handfast.agent.fleet.model import Fleet
from handfast.agent.security import private_files
from handfast.agent.security.credentials import authority_of
from handfast.agent.security.identity import of_operator
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory import operator_credentials
from handfast.deploy.inventory.certificate_authority import Authority
from handfast.deploy.inventory.operator_credentials import (
    AUTHORITY_FILE,
    OPERATOR,
    REQUEST_BYTES_MAX,
    SIGNED_BYTES_MAX,
    operator_name,
    requested_by,
    short,
)


def existing(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> Authority:
    """The authority in `folder`, which makes none where there is none."""
    name = fleet.fleet.name
    if not private_files.exists(folder / AUTHORITY_FILE) and not authority_of(folder):
        raise InputError(f"{name} has no authority in {folder}: `handfast keys {options.fleet}` makes it")
    return Authority(folder, name, fleet.ids, now_s)


def request(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    """Makes a request for this operator's certificate, for the authority elsewhere."""
    identity, out = of_operator(fleet.fleet.name, options.operator), Path(options.out).expanduser()
    private_files.write(out, operator_credentials.request(folder, identity))
    print(
        f"{identity}: wrote {out}; where the authority is, `handfast keys {options.fleet} --sign {out.name} "
        f"--out FILE`; then here, `handfast keys {options.fleet} --install FILE`"
    )


def sign(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    """Signs an operator's request."""
    data = _read(options.sign, REQUEST_BYTES_MAX)
    who = requested_by(data, fleet.fleet.name, fleet.network.operators, f"the request in {options.sign}")
    with existing(options, fleet, folder, now_s) as authority:
        signed = authority.sign(who, data, (), now_s)
        if options.out is None:
            print(signed.decode("ascii"), end="")
            return
        private_files.write(Path(options.out).expanduser(), signed)
        digits = short(authority.fingerprint)
        print(f"{who}: wrote {options.out}; say to whom it is for that the authority is {digits}")


def _read(file: str, most: int) -> bytes:
    """Contents of a file, at most one byte more than `most`."""
    try:
        with Path(file).expanduser().open("rb") as stream:
            return stream.read(most + 1)
    except OSError as error:
        raise InputError(f"cannot read {file}: {private_files.reason(error)}") from None


def install(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    """Takes an operator's certificate that the authority elsewhere has signed."""
    bundle = _read(options.install, SIGNED_BYTES_MAX)
    found = operator_credentials.install(folder, bundle, fleet.fleet.name, fleet.network.operators, now_s)
    who = found.identity
    print(
        f"{who}: installed {found.files.certificate}, of the authority {short(found.authority_fingerprint)}: "
        "it must be what was said where it was signed"
    )
    if who.name != operator_name():
        print(f"commands are given as {who.name} with {OPERATOR}={who.name} in the environment")
