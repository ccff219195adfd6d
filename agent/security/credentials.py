"""Credentials of one process: a private key, the certificate for it, the fleet's authority.

Three files in a folder that only one user can look into. The private key is made where it is used and stays
there; a request for a certificate goes to the operator's authority
(`deploy.inventory.certificate_authority`), which signs it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from handfast.agent.security import private_files
from handfast.agent.security.certificates import (
    Certificate,
    CertificateError,
    authority_from_pem,
    fingerprint,
    issued_from_pem,
    key_from_pem,
    needs_cryptography,
    new_key,
    new_request,
    pem_of,
    pem_of_key,
    same_key,
)
from handfast.agent.security.identity import Identity
from handfast.agent.security.private_files import KeyFileError

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

AUTHORITY_CERTIFICATE: Final = "ca.crt"
"""File of the certificate of the authority that all in a folder have."""
RENEW_DAYS: Final = 30
"""A certificate with fewer days left is renewed when there is an opportunity."""
ANOTHER_AUTHORITY: Final = "the authority is another one now"
"""Why a certificate is wanted where there is a good one, of another authority."""
T = TypeVar("T")
PEM_CERTIFICATE: Final = re.compile(
    rb"-----BEGIN CERTIFICATE-----[A-Za-z0-9+/=\s]{1,16000}-----END CERTIFICATE-----"
)


class CredentialsError(ValueError):
    """Credentials that cannot be used or made; the text says which file, and what to do."""


class MissingError(CredentialsError):
    """There are no credentials, or not all of them: they have to be made."""


class NotValidNowError(CredentialsError):
    """Credentials that are good but for the time: not yet, or no more. A clock that is set mends it, or a
    certificate that is renewed."""


@dataclass(frozen=True, slots=True)
class Files:
    """Where the credentials of `identity` are."""

    folder: Path
    identity: Identity

    @property
    def authority(self) -> Path:
        """The certificate of the fleet's authority."""
        return self.folder / AUTHORITY_CERTIFICATE

    @property
    def certificate(self) -> Path:
        """Its own certificate."""
        return self.folder / f"{self.identity.common_name}.crt"

    @property
    def key(self) -> Path:
        """Its private key."""
        return self.folder / f"{self.identity.common_name}.key"

    @property
    def next_certificate(self) -> Path:
        """The certificate that `store` is about to take, and beside it the authority's."""
        return self.folder / f"{self.identity.common_name}.next.crt"

    @property
    def next_authority(self) -> Path:
        """The authority's certificate beside `next_certificate`."""
        return self.folder / "ca.next.crt"

    @property
    def next_key(self) -> Path:
        """The key of a request that has not been answered."""
        return self.folder / f"{self.identity.common_name}.next.key"


@dataclass(frozen=True, slots=True)
class Credentials:
    """Credentials that were found to be whole and valid."""

    files: Files
    certificate: Certificate
    key: EllipticCurvePrivateKey = field(repr=False)
    authority: x509.Certificate = field(repr=False)

    @property
    def identity(self) -> Identity:
        """Whose they are, as the certificate says."""
        return self.certificate.identity

    @property
    def authority_fingerprint(self) -> str:
        """Tells one authority, or generation of it, from another: SHA-256 of its certificate."""
        return fingerprint(self.authority)


def load(folder: Path, identity: Identity, now_s: float) -> Credentials:
    """The credentials of `identity` in `folder`.

    Args:
        now_s: the present, wall time.

    Raises:
        CredentialsError: a file is missing, can be read by others, does not belong to the others, is not the
            authority's work, or the certificate is not valid now; `MissingError` when a file is missing,
            `NotValidNowError` when only the time is wrong.
    """
    found = load_whenever(folder, identity)
    try:
        found.certificate.check_time(now_s)
    except CertificateError as error:
        raise NotValidNowError(f"{found.files.certificate}: {error}") from None
    return found


def load_whenever(folder: Path, identity: Identity) -> Credentials:
    """As `load`, whether they are valid now or not."""
    return _load(Files(folder, identity))


def authority_of(folder: Path) -> str:
    """Fingerprint of the authority whose certificate is in `folder`, "" where none is that can be read."""
    path = folder / AUTHORITY_CERTIFICATE
    try:
        if private_files.exists(path):
            return fingerprint(authority_from_pem(private_files.read(path)))
    except (KeyFileError, CertificateError):
        pass
    return ""


def make_request(folder: Path, identity: Identity) -> bytes:
    """A certificate signing request (PEM) for a new key of `identity`; the folder is made if need be.

    The key waits beside the one in use until `store` brings the certificate; asked again meanwhile, the
    request is for the same key.

    Raises:
        CredentialsError: a file cannot be read or written.
    """
    files = Files(folder, identity)
    try:
        needs_cryptography()
        private_files.private_directory(folder)
        key = _waiting(files)
        if key is None:
            key = new_key()
            private_files.write(files.next_key, pem_of_key(key), private=True)
        return new_request(key, identity)
    except (KeyFileError, CertificateError) as error:
        raise CredentialsError(str(error)) from None


def store(folder: Path, identity: Identity, bundle: bytes, now_s: float) -> Credentials:
    """Takes what the authority answered, once it is found to be right.

    Args:
        bundle: two certificates (PEM): the one for the key of `make_request`, or of the key that is in use,
            and the authority's.

    Raises:
        CredentialsError: it is not; what was there before is then still there.
    """
    files = Files(folder, identity)
    parts = PEM_CERTIFICATE.findall(bundle)
    if len(parts) != 2:
        raise CredentialsError(
            f"{identity}: {len(parts)} certificates came, not two: its own and the authority's"
        )
    try:
        authority = authority_from_pem(parts[1])
        certificate = issued_from_pem(parts[0], authority)
        certificate.check_time(now_s)
    except CertificateError as error:
        raise CredentialsError(f"the certificate for {identity}: {error}") from None
    if certificate.identity != identity:
        raise CredentialsError(f"the certificate for {identity} is one of {certificate.identity.common_name}")
    try:
        waiting = _waiting(files)
        is_new = waiting is not None and same_key(waiting, certificate)
        if not is_new:
            key = key_from_pem(private_files.read(files.key, private=True))
            if not same_key(key, certificate):
                raise CredentialsError(f"the certificate for {identity} is not for its key {files.key}")
        # All is on the disk, which may be full, before anything takes the place of what is used.
        private_files.write(files.next_certificate, parts[0] + b"\n")
        private_files.write(files.next_authority, pem_of(authority))
        if is_new:
            private_files.move(files.next_key, files.key)
        private_files.move(files.next_certificate, files.certificate)
        private_files.move(files.next_authority, files.authority)
    except (KeyFileError, CertificateError) as error:
        raise CredentialsError(str(error)) from None
    return load(folder, identity, now_s)


def wanting(
    folder: Path, identity: Identity, addresses: Sequence[str], authority_pem: bytes | None, now_s: float
) -> str:
    """Why `identity` needs a new certificate, "" when it does not.

    Args:
        addresses: what its certificate must hold for, as `agent.security.identity.addresses` gives it.
        authority_pem: the fleet's authority, None when it is the one that is known already.

    Raises:
        CredentialsError: `authority_pem` is none, or a file is there that others can read.
    """
    files = Files(folder, identity)
    wanted = None
    try:
        if authority_pem is not None:
            wanted = fingerprint(authority_from_pem(authority_pem))
    except CertificateError as error:
        raise CredentialsError(f"the authority's certificate: {error}") from None
    try:
        if not all(map(private_files.exists, (files.key, files.certificate, files.authority))):
            return "it has none yet"
    except KeyFileError as error:
        raise CredentialsError(str(error)) from None
    if files.key.stat().st_mode & 0o077:
        raise CredentialsError(f"others may read the private key {files.key}: chmod 600 {files.key}")
    try:
        found = _load(files)
    except CredentialsError as error:
        return f"what is there cannot be used: {error}"
    if wanted is not None and found.authority_fingerprint != wanted:
        return ANOTHER_AUTHORITY
    missing = sorted(set(addresses) - set(found.certificate.addresses))
    if missing:
        return f"it does not hold for {', '.join(missing)}"
    days = found.certificate.days_left(now_s)
    ends_s = found.authority.not_valid_after_utc.timestamp()
    if now_s < found.certificate.not_before_s:
        return "it is not valid yet by this machine's clock"
    if days <= 0:
        return "it has expired"
    if days <= RENEW_DAYS and found.certificate.not_after_s < ends_s:  # another one could last longer
        return f"it expires in {int(days)} days"
    return ""


def _load(files: Files) -> Credentials:
    authority = _parsed(files, files.authority, authority_from_pem)
    certificate = _parsed(files, files.certificate, lambda data: issued_from_pem(data, authority))
    key = _parsed(files, files.key, key_from_pem)
    if certificate.identity != files.identity:
        raise CredentialsError(f"{files.certificate} is one of {certificate.identity.common_name}")
    if not same_key(key, certificate):
        raise CredentialsError(f"{files.certificate} is not for the key {files.key}")
    return Credentials(files, certificate, key, authority)


def _parsed(files: Files, path: Path, parse: Callable[[bytes], T]) -> T:
    try:
        return parse(private_files.read(path, private=path == files.key))
    except KeyFileError as error:
        raise _advised(error, files) from None
    except CertificateError as error:
        raise CredentialsError(f"{path}: {error}") from None


def _advised(error: KeyFileError, files: Files) -> CredentialsError:
    try:
        if all(map(private_files.exists, (files.authority, files.certificate, files.key))):
            return CredentialsError(str(error))
        if private_files.exists(files.key):
            return MissingError(str(error))
    except KeyFileError as cannot:
        return CredentialsError(str(cannot))
    return MissingError(f"{files.identity} of {files.identity.fleet} has no certificate: {error}")


def _waiting(files: Files) -> EllipticCurvePrivateKey | None:
    if not private_files.exists(files.next_key):
        return None
    data = private_files.read(files.next_key, private=True)
    try:
        return key_from_pem(data)
    except CertificateError:
        return None  # nothing depends on it yet: another one is made
