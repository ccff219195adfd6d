"""Certificates as this project makes them: an authority's own, and those that it signs."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from typing import TYPE_CHECKING, Final

from handfast.agent.security.certificates import pem_of
from handfast.agent.security.identity import Identity

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
