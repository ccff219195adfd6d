"""An operator's credentials: their folder, and how an operator on another computer gets them.

That operator makes the private key where it is used, and it stays there. The request and the certificate are
public, but must not be changed unseen on their way: whoever installs compares the authority's fingerprint.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from handfast.agent.security import private_files
from handfast.agent.security.certificates import (
    PEM_BYTES_MAX,
    CertificateError,
    authority_from_pem,
    common_name_of,
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
from handfast.agent.security.identity import MAIN, Identity, IdentityError, parse
from handfast.agent.security.private_files import home_folder

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePublicKey


OPERATOR: Final = "HANDFAST_OPERATOR"
KEYS: Final = "HANDFAST_KEYS"
"""Variables of the environment: who gives orders here, and the folder of that operator's keys."""
AUTHORITY_FILE: Final = "authority.pem"
"""Key and certificate of the authority, where it is on this machine."""
SHORT: Final = 16
"""Digits of a fingerprint that people compare."""


def keys_folder(fleet: str) -> Path:
    """Return the folder of a fleet's keys: the environment's, or one in the user's configuration folder."""
    given = os.environ.get(KEYS, "")
    if given:
        return Path(given).expanduser()
    base = os.environ.get("XDG_CONFIG_HOME", "")
    root = Path(base) if base.startswith("/") else home_folder() / ".config"
    return root / "handfast" / "keys" / fleet


def operator_name() -> str:
    """Return the name of the operator who gives orders here."""
    return os.environ.get(OPERATOR, "") or MAIN


def short(digits: str) -> str:
    """Return the part of a fingerprint that people compare."""
    return digits[:SHORT]


REQUEST_BYTES_MAX: Final = 8192


class RequestError(ValueError):
    """What must not be signed; the text says why."""


class Request(NamedTuple):
    """A request that was found sound: whose it says to be, and the key that its sender has."""

    common_name: str
    key: EllipticCurvePublicKey


def examined(pem: bytes, what: str) -> Request:
    """A request, found to be signed with its own key, on the curve that all keys are on.

    Args:
        what: it is called this where it is refused.

    Raises:
        RequestError: it is not.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    if len(pem) > REQUEST_BYTES_MAX:
        raise RequestError(f"{what} is too large ({len(pem)} bytes, at most {REQUEST_BYTES_MAX})")
    try:
        asked = x509.load_pem_x509_csr(pem)
        sound = asked.is_signature_valid
        key = asked.public_key()
        name = common_name_of(asked.subject)
    except Exception:  # several unrelated types; each means the same here
        raise RequestError(f"{what} is not a certificate request") from None
    if not sound or not isinstance(key, ec.EllipticCurvePublicKey):
        raise RequestError(f"{what} is not signed with a key of the right kind")
    if not isinstance(key.curve, ec.SECP256R1):
        raise RequestError(f"{what} is for a key on {key.curve.name}, not on P-256")
    return Request(name, key)


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
