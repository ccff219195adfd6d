"""The fleet's certificate authority on the operator's machine, and the certificates that it makes.

Its private key never leaves this folder. There are no lists of revoked certificates, which robots in a field
could not fetch: a new authority revokes all certificates of the previous one.
"""

from __future__ import annotations

import fcntl
import json
import os
import threading
import time
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from handfast.agent.common.closing import Closing
from handfast.agent.security import private_files
from handfast.agent.security.certificates import (
    DAY_S,
    Certificate,
    CertificateError,
    authority_from_pem,
    common_name_of,
    fingerprint,
    issued_from_pem,
    key_from_pem,
    new_key,
    pem_of,
    pem_of_key,
)
from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE, authority_of
from handfast.agent.security.identity import Identity, IdentityError, addresses, parse
from handfast.agent.security.private_files import KeyFileError
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, RequestError, examined, short

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey, EllipticCurvePublicKey


AUTHORITY_DAYS: Final = 3650
CERTIFICATE_DAYS: Final = 365
BACK_S: Final = 600
"""Certificates are valid from so long ago: clocks of robots may be behind."""


def self_signed(key: EllipticCurvePrivateKey, name: str, now_s: float) -> x509.Certificate:
    """An authority's own certificate."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

    subject = _name(name)
    return (
        _dated(now_s, AUTHORITY_DAYS)
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )


def signed(
    key: EllipticCurvePrivateKey,
    authority: x509.Certificate,
    identity: Identity,
    public_key: EllipticCurvePublicKey,
    where: Iterable[str],
    now_s: float,
) -> bytes:
    """A certificate (PEM) for `public_key` that holds for the addresses `where`; `key` is the authority's."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.x509.oid import ExtendedKeyUsageOID

    names: list[x509.GeneralName] = [
        x509.IPAddress(ip_address(address)) if is_ip(address) else x509.DNSName(address) for address in where
    ]
    certificate = (
        _dated(now_s, CERTIFICATE_DAYS, authority.not_valid_after_utc)
        .subject_name(_name(identity.common_name))
        .issuer_name(authority.subject)
        .public_key(public_key)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        # Of two agents either may dial, and either listen.
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
            critical=False,
        )
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    return pem_of(certificate)


def _dated(now_s: float, days: int, at_most: datetime | None = None) -> x509.CertificateBuilder:
    from cryptography import x509

    now = datetime.fromtimestamp(int(now_s), UTC)
    until = now + timedelta(days=days)
    return (
        x509.CertificateBuilder()
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(seconds=BACK_S))
        .not_valid_after(until if at_most is None else min(until, at_most))
    )


def _name(common_name: str) -> x509.Name:
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def is_ip(address: str) -> bool:
    """Whether an address of `agent.security.identity.addresses` is an IP address, not a host name."""
    try:
        ip_address(address)
    except ValueError:
        return False
    return True


WAIT_S: Final = 10.0
"""How long another command that uses the keys is waited for."""
LOOPBACK: Final = ("127.0.0.1", "::1", "localhost")
"""Agent and plant of one robot may talk over these, wherever they are."""
INDEX_FILE: Final = "index.json"
INDEX_BYTES_MAX: Final = 64_000_000
_INDEX_VERSION: Final = 1


class AuthorityError(ValueError):
    """What the authority cannot or will not do; the text says why, and what would be right."""


@dataclass(frozen=True, slots=True)
class Issued:
    """One certificate that was signed. Times are seconds since the Unix epoch."""

    identity: str
    generation: int
    serial: str
    not_before_s: int
    not_after_s: int
    addresses: tuple[str, ...]
    fingerprint: str

    def days_left(self, now_s: float) -> float:
        return (self.not_after_s - now_s) / DAY_S


class Authority(Closing):
    """The authority of one fleet, held for one command at a time: a context manager. Threads may share it.

    Args:
        folder: where its files are; made, with a new authority, if there is none.
        fleet: name of the fleet.
        robots: ids of the robots that may have certificates.
        now_s: the present, wall time.
        new: makes a new authority in place of the one that the folder has or knows, which revokes its
            certificates.

    Attributes:
        created: whether the authority is a new one.
        generation: 1, and one more for each that took the place of another.

    Raises:
        AuthorityError: the files cannot be used, or another command uses them; or the folder has
            certificates of an authority that is elsewhere.
    """

    def __init__(
        self, folder: Path, fleet: str, robots: Collection[int], now_s: float, *, new: bool = False
    ) -> None:
        self.folder, self.fleet = folder, fleet
        self._robots = frozenset(robots)
        self._thread_lock = threading.Lock()
        self.created = False
        self.generation = 1
        self._issued: list[Issued] = []
        try:
            private_files.private_directory(folder)
            self._lock = _locked(folder, fleet)
        except KeyFileError as error:
            raise AuthorityError(str(error)) from None
        try:
            self._open(now_s, new)
        except (KeyFileError, CertificateError) as error:
            self.close()
            raise AuthorityError(str(error)) from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Lets others use it; safe to call twice."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def certificate_pem(self) -> bytes:
        """Its own certificate, which all of the fleet know it by."""
        return pem_of(self._certificate)

    @property
    def fingerprint(self) -> str:
        return fingerprint(self._certificate)

    @property
    def not_after_s(self) -> float:
        """When it ends, and at the latest what it signs; seconds since the Unix epoch."""
        return self._certificate.not_valid_after_utc.timestamp()

    def days_left(self, now_s: float) -> float:
        return (self.not_after_s - now_s) / DAY_S

    def issued(self) -> tuple[Issued, ...]:
        """All that it has signed, the oldest first, of earlier generations too."""
        return tuple(self._issued)

    @property
    def has_robots(self) -> bool:
        """True if it, or one before it, has ever signed a robot's certificate."""
        return any(parse(entry.identity).role == "robot" for entry in self._issued)

    def sign(self, identity: Identity, request: bytes, where: Iterable[str], now_s: float) -> bytes:
        """A certificate for the key of a request, and the authority's own after it (PEM).

        Args:
            identity: who has asked, as the caller knows; a request for another one is refused. Nothing else
                of what a request says is taken over.
            where: addresses that others reach it at.

        Raises:
            AuthorityError: the fleet has no such robot, the request is not one of `identity`, or the
                authority has expired.
        """
        try:
            asked = examined(request, f"the request of {identity}")
        except RequestError as error:
            raise AuthorityError(str(error)) from None
        if asked.common_name != identity.common_name:
            raise AuthorityError(f"the request of {identity} is one for {asked.common_name[:80]!r}")
        return self._sign(identity, asked.key, where, now_s)

    def _open(self, now_s: float, new: bool) -> None:
        self._read_index()
        if new or not private_files.exists(self._file):
            if not new:
                self._refuse_second()
            used = [entry.generation for entry in self._issued]
            self._make(1 + max([*used, self._generation_known()]), now_s)
            self.created = True
            return
        data = private_files.read(self._file, private=True)
        try:
            self._key = key_from_pem(data)
            self._certificate = authority_from_pem(data)
            name = common_name_of(self._certificate.subject)
        except CertificateError as error:
            raise AuthorityError(f"{self._file}: {error}") from None
        fleet, _, generation = name.rpartition(".authority.")
        if fleet != self.fleet or not generation.isdecimal():
            raise AuthorityError(f"{self._file} is the authority {name!r}, not one of {self.fleet}")
        if self._certificate.public_key() != self._key.public_key():
            raise AuthorityError(f"{self._file}: the key and the certificate in it do not belong together")
        self.generation = int(generation)
        self._write_certificate()

    def _refuse_second(self) -> None:
        """Refuses to make an authority beside one that is known here, but kept elsewhere."""
        known = authority_of(self.folder)
        if known:
            raise AuthorityError(
                f"{self.folder} has certificates of the authority {short(known)}, which is not here: ask for "
                "new ones where it is (--request), or, if it is lost, make another (--new-authority)"
            )
        if any(self.folder.glob("*.next.key")):
            raise AuthorityError(
                f"a request from {self.folder} waits to be signed by the fleet's authority: --install what "
                "it has signed; to make an authority here instead, remove that folder first"
            )

    def _generation_known(self) -> int:
        """Generation of the authority whose certificate is here, 0 for none."""
        if not authority_of(self.folder):
            return 0
        found = authority_from_pem(private_files.read(self.folder / AUTHORITY_CERTIFICATE))
        generation = common_name_of(found.subject).rpartition(".")[2]
        return int(generation) if generation.isdecimal() else 0

    @property
    def _file(self) -> Path:
        """Key and certificate in one file: one of them alone can never be there."""
        return self.folder / AUTHORITY_FILE

    @property
    def _index(self) -> Path:
        return self.folder / INDEX_FILE

    def _make(self, generation: int, now_s: float) -> None:
        key = new_key()
        certificate = self_signed(key, f"{self.fleet}.authority.{generation}", now_s)
        try:
            private_files.write(self._file, pem_of_key(key) + pem_of(certificate), private=True)
            self._key, self._certificate, self.generation = key, certificate, generation
            self._write_certificate()
        except KeyFileError as error:
            raise AuthorityError(str(error)) from None

    def _write_certificate(self) -> None:
        path, wanted = self.folder / AUTHORITY_CERTIFICATE, self.certificate_pem
        if not private_files.exists(path) or private_files.read(path) != wanted:
            private_files.write(path, wanted)

    def _sign(
        self, identity: Identity, key: EllipticCurvePublicKey, where: Iterable[str], now_s: float
    ) -> bytes:
        if identity.fleet != self.fleet:
            raise AuthorityError(f"{identity.common_name} is not of the fleet {self.fleet}")
        if identity.robot is not None and identity.robot not in self._robots:
            raise AuthorityError(f"there is no robot {identity.robot} in {self.fleet}")
        if self.days_left(now_s) <= 0:
            raise AuthorityError(
                f"the authority of {self.fleet} has expired: `handfast keys {self.fleet} --new-authority`"
            )
        try:
            holds_for = addresses((*where, *LOOPBACK))
        except IdentityError as error:
            raise AuthorityError(f"{identity}: {error}") from None
        with self._thread_lock:
            if self._lock is None:
                raise AuthorityError("the authority is closed")
            made = signed(self._key, self._certificate, identity, key, holds_for, now_s)
            certificate = issued_from_pem(made, self._certificate)
            # First the index: nobody has a certificate that is not in it.
            self._issued.append(self._entry(certificate))
            self._write_index()
            return made + self.certificate_pem

    def _entry(self, certificate: Certificate) -> Issued:
        return Issued(
            identity=certificate.identity.common_name,
            generation=self.generation,
            serial=f"{certificate.serial:x}",
            not_before_s=certificate.not_before_s,
            not_after_s=certificate.not_after_s,
            addresses=certificate.addresses,
            fingerprint=certificate.fingerprint,
        )

    def _read_index(self) -> None:
        if not private_files.exists(self._index):
            return
        try:
            tables: Any = json.loads(private_files.read(self._index, most=INDEX_BYTES_MAX))
            if tables["version"] != _INDEX_VERSION:
                raise ValueError
            found = [Issued(**row | {"addresses": tuple(row["addresses"])}) for row in tables["issued"]]
            for entry in found:
                parse(entry.identity)
        except (ValueError, TypeError, KeyError):  # not JSON, or not as we write it
            raise AuthorityError(
                f"{self._index} is damaged: put it away; certificates that were signed stay valid"
            ) from None
        self._issued = found

    def _write_index(self) -> None:
        table = {
            "version": _INDEX_VERSION,
            "fleet": self.fleet,
            "issued": [*map(asdict, self._issued)],
        }
        try:
            private_files.write(self._index, json.dumps(table, indent=1).encode() + b"\n", private=True)
        except KeyFileError as error:
            raise AuthorityError(str(error)) from None


def _locked(folder: Path, fleet: str) -> int | None:
    try:
        handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise KeyFileError(f"cannot write in {folder}: {private_files.reason(error)}") from None
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return handle
        except OSError:
            if time.monotonic() > deadline:
                os.close(handle)
                raise KeyFileError(f"another handfast command uses the keys of {fleet}: try again") from None
            time.sleep(0.05)
