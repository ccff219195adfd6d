"""A certificate for an operator on another computer than the authority's: asked for, signed, installed.

The private key is made where it is used and stays there. What is carried is public, but must not be changed
on its way unseen: who installs compares the authority's fingerprint.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Final

from handfast.agent.security import private_files
from handfast.agent.security.certificates import (
    PEM_BYTES_MAX,
    CertificateError,
    authority_from_pem,
    fingerprint,
    issued_from_pem,
)
from handfast.agent.security.credentials import (
    PEM_CERTIFICATE,
    Credentials,
    CredentialsError,
    authority_of,
    make_request,
    store,
)
from handfast.agent.security.identity import Identity, IdentityError, parse
from handfast.deploy.inventory.certificate_requests import RequestError, examined
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, short

SIGNED_BYTES_MAX: Final = 2 * PEM_BYTES_MAX
"""Of what `install` takes: two certificates."""


def request(folder: Path, identity: Identity) -> bytes:
    """A request (PEM) for a certificate of an operator, whose key waits in `folder`.

    Raises:
        RequestError: the authority is in that folder: nobody need be asked.
        handfast.agent.security.credentials.CredentialsError,
        handfast.agent.security.private_files.KeyFileError: a file cannot
            be read or written.
    """
    if private_files.exists(folder / AUTHORITY_FILE):
        raise RequestError(
            f"the authority {short(authority_of(folder))} is in {folder}: it signs without a request; if "
            f"the fleet has another one elsewhere, put {folder / AUTHORITY_FILE} away first"
        )
    return make_request(folder, identity)


def requested_by(pem: bytes, fleet: str, operators: Collection[str], what: str) -> Identity:
    """Which operator's request it is.

    Args:
        operators: names of those who may give orders.
        what: the request is called this where it is refused.

    Raises:
        RequestError: it is none, of another fleet, or of somebody who gives no orders there.
    """
    name = examined(pem, what).common_name
    try:
        identity = parse(name)
    except IdentityError:
        raise RequestError(f"{what} is one for {name[:80]!r}, not for FLEET.operator.NAME") from None
    _refuse_stranger(identity, fleet, operators, what)
    return identity


def install(folder: Path, bundle: bytes, fleet: str, operators: Collection[str], now_s: float) -> Credentials:
    """Takes an operator's certificate and the authority's, as signed for a request from `folder`.

    Raises:
        RequestError: they are of another fleet, or of somebody who gives no orders there; or `folder` has
            another authority itself.
        handfast.agent.security.credentials.CredentialsError: the certificate is not the authority's work, not
        for the
            key that waits here, or not valid now.
        handfast.agent.security.private_files.KeyFileError: a file cannot be read or written.
    """
    if len(bundle) > SIGNED_BYTES_MAX:
        raise RequestError(f"it has over {SIGNED_BYTES_MAX} bytes: these are not two certificates")
    parts = PEM_CERTIFICATE.findall(bundle)
    if len(parts) != 2:
        raise RequestError(f"it has {len(parts)} certificates, not two: the operator's and the authority's")
    try:
        authority = authority_from_pem(parts[1])
        identity = issued_from_pem(parts[0], authority).identity
    except CertificateError as error:
        raise CredentialsError(f"the certificate to install: {error}") from None
    _refuse_stranger(identity, fleet, operators, "the certificate to install")
    if not private_files.exists(folder):
        raise CredentialsError(f"no request was made from {folder}: --request makes one")
    known, new = authority_of(folder), fingerprint(authority)
    if private_files.exists(folder / AUTHORITY_FILE) and known != new:
        raise RequestError(
            f"it is of the authority {short(new)}, and {folder} has another one itself, {short(known)}: put "
            f"{folder / AUTHORITY_FILE} away first"
        )
    return store(folder, identity, bundle, now_s)


def _refuse_stranger(identity: Identity, fleet: str, operators: Collection[str], what: str) -> None:
    if identity.fleet != fleet:
        raise RequestError(f"{what} is one for the fleet {identity.fleet}, not for {fleet}")
    if identity.role != "operator":
        raise RequestError(f"{what} is one for {identity}, not for an operator")
    if identity.name not in operators:
        raise RequestError(
            f"{what} is one for the operator {identity.name}; network.operators of {fleet} are "
            f"{', '.join(operators)}"
        )
