"""What `handfast keys` passes between the authority's computer and others: operators' requests, certificates,
a backup of the authority. Each function carries out one option."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from handfast.agent.fleet.model import Fleet
from handfast.agent.security import private_files
from handfast.agent.security.credentials import authority_of
from handfast.agent.security.identity import of_operator
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.passphrase import passphrase
from handfast.deploy.inventory import operator_requests
from handfast.deploy.inventory.authority_backup import BACKUP_BYTES_MAX, packed, unpack
from handfast.deploy.inventory.certificate_authority import Authority
from handfast.deploy.inventory.certificate_requests import REQUEST_BYTES_MAX
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, OPERATOR, operator_name, short
from handfast.deploy.inventory.operator_requests import SIGNED_BYTES_MAX, requested_by


def existing(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> Authority:
    """The authority in `folder`, which makes none where there is none."""
    name = fleet.fleet.name
    if not private_files.exists(folder / AUTHORITY_FILE) and not authority_of(folder):
        raise InputError(f"{name} has no authority in {folder}: `handfast keys {options.fleet}` makes it")
    return Authority(folder, name, fleet.ids, now_s)


def request(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    """Makes a request for this operator's certificate, for the authority elsewhere."""
    identity, out = of_operator(fleet.fleet.name, options.operator), Path(options.out).expanduser()
    private_files.write(out, operator_requests.request(folder, identity))
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
    found = operator_requests.install(folder, bundle, fleet.fleet.name, fleet.network.operators, now_s)
    who = found.identity
    print(
        f"{who}: installed {found.files.certificate}, of the authority {short(found.authority_fingerprint)}: "
        "it must be what was said where it was signed"
    )
    if who.name != operator_name():
        print(f"commands are given as {who.name} with {OPERATOR}={who.name} in the environment")


def backup(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    """Writes a backup of the authority."""
    out = Path(options.backup).expanduser()
    if os.path.lexists(out):
        raise InputError(f"{out} is there already: a backup takes the place of none; name a new file")
    with existing(options, fleet, folder, now_s) as authority:
        secret = passphrase(f"the backup of {fleet.fleet.name}'s authority", new=True)
        private_files.write(out, packed(folder, fleet.fleet.name, secret), private=True)
        print(
            f"wrote {out}: the authority {short(authority.fingerprint)}, generation {authority.generation}; "
            "keep it apart from its passphrase, and from this computer"
        )


def restore(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    """Brings the authority back from a backup."""
    data = _read(options.restore, BACKUP_BYTES_MAX)
    if len(data) > BACKUP_BYTES_MAX:
        raise InputError(f"{options.restore} is too large for a backup (over {BACKUP_BYTES_MAX} bytes)")
    secret = passphrase(f"the backup {options.restore}", new=False)
    found = unpack(folder, fleet.fleet.name, data, secret)
    print(f"restored the authority {short(found)} of {fleet.fleet.name} into {folder}")
