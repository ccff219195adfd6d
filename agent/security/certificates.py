"""Certificates: what one holds, once its authority has been found to have signed it.

Before that nothing in it is looked at: it may come from anybody. `cryptography` is imported when it is first
needed, as only the robots of a secured fleet have it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final

from handfast.agent.security.identity import Identity, IdentityError, parse

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey, EllipticCurvePublicKey

DER_BYTES_MAX: Final = 4096
"""Of one certificate: one with `agent.security.identity.ADDRESSES_MAX` long host names is the largest that
we make."""
PEM_BYTES_MAX: Final = 16_384
"""Of one certificate in PEM."""
DAY_S: Final = 86_400
REASONS: Final = ("oversized", "malformed", "unknown_authority", "not_yet_valid", "expired")
MISSING: Final = (
    "this fleet is secured, and the Python package cryptography is not installed: "
    "pip install 'handfast[security]', or set network.security = \"off\""
)


class CertificateError(ValueError):
    """A certificate that must not be trusted; `reason` is one of `REASONS`, the text is for people."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Certificate:
    """A certificate that the fleet's authority has signed.

    Times are seconds since the Unix epoch; `fingerprint` is the SHA-256 of its DER in hexadecimal digits.
    """

    identity: Identity
    addresses: tuple[str, ...]
    not_before_s: int
    not_after_s: int
    serial: int
    fingerprint: str
    der: bytes = field(repr=False)
    public_key: EllipticCurvePublicKey = field(repr=False)

    def check_time(self, now_s: float) -> None:
        """`CertificateError` when it is not valid at `now_s`, wall time."""
        if now_s < self.not_before_s:
            raise CertificateError(
                "not_yet_valid",
                f"the certificate of {self.identity} is not valid yet: is this machine's clock right?",
            )
        if now_s >= self.not_after_s:
            days = int((now_s - self.not_after_s) // DAY_S)
            when = f"expired {days} days ago" if days else "has expired"
            raise CertificateError("expired", f"the certificate of {self.identity} {when}")

    def days_left(self, now_s: float) -> float:
        """Days from `now_s` (wall time) until it expires; below 0 after that."""
        return (self.not_after_s - now_s) / DAY_S


def until(pem: bytes) -> float | None:
    """Until when a certificate holds (s since the Unix epoch), whoever signed it; None for what is none."""
    try:
        return _loaded_pem(pem).not_valid_after_utc.timestamp()
    except CertificateError:
        return None


def needs_cryptography() -> None:
    """`CertificateError` when the package is not there."""
    try:
        import cryptography  # noqa: F401
    except ImportError:
        raise CertificateError("malformed", MISSING) from None


def authority_from_pem(data: bytes) -> x509.Certificate:
    """An authority's own certificate.

    Raises:
        CertificateError: it is none.
    """
    needs_cryptography()
    from cryptography.x509 import BasicConstraints

    loaded = _loaded_pem(data)
    try:
        constraints = loaded.extensions.get_extension_for_class(BasicConstraints).value
        loaded.verify_directly_issued_by(loaded)
    except Exception:  # several unrelated types; each means the same here
        constraints = None
    if constraints is None or not constraints.ca:
        raise CertificateError("malformed", "it is not the certificate of an authority")
    return loaded


def issued_from_pem(data: bytes, authority: x509.Certificate) -> Certificate:
    """As `issued`, from a PEM file's bytes."""
    return _examined(_loaded_pem(data), authority)


def issued(der: bytes, authority: x509.Certificate) -> Certificate:
    """The certificate in `der`, whatever its dates are.

    Raises:
        CertificateError: it is none that `authority` has signed.
    """
    from cryptography import x509

    if len(der) > DER_BYTES_MAX:
        raise CertificateError(
            "oversized", f"a certificate of {len(der)} bytes, at most {DER_BYTES_MAX} are accepted"
        )
    try:
        loaded = x509.load_der_x509_certificate(der)
    except Exception:  # as above
        raise CertificateError("malformed", "it is not a certificate") from None
    return _examined(loaded, authority)


def fingerprint(certificate: x509.Certificate) -> str:
    """SHA-256 of the DER, hexadecimal digits."""
    return sha256(_der(certificate)).hexdigest()


def key_from_pem(data: bytes) -> EllipticCurvePrivateKey:
    """A private key on P-256. `CertificateError` when it is none; the text says nothing of what it is."""
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key: Any = load_pem_private_key(data, password=None)
    except Exception:  # as above
        key = None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or not isinstance(key.curve, ec.SECP256R1):
        raise CertificateError("malformed", "it is not a private key on the curve P-256 without a password")
    return key


def new_key() -> EllipticCurvePrivateKey:
    """A new private key on P-256."""
    needs_cryptography()
    from cryptography.hazmat.primitives.asymmetric import ec

    return ec.generate_private_key(ec.SECP256R1())


def pem_of_key(key: EllipticCurvePrivateKey) -> bytes:
    """PKCS 8, as Zenoh takes it, without a password: processes start with nobody there to type one."""
    from cryptography.hazmat.primitives import serialization

    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def new_request(key: EllipticCurvePrivateKey, identity: Identity) -> bytes:
    """A certificate signing request (PEM) for `identity`."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.x509.oid import NameOID

    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, identity.common_name)])
    request = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA256())
    return request.public_bytes(serialization.Encoding.PEM)


def pem_of(certificate: x509.Certificate) -> bytes:
    """The certificate in PEM."""
    from cryptography.hazmat.primitives import serialization

    return certificate.public_bytes(serialization.Encoding.PEM)


def same_key(one: EllipticCurvePrivateKey, certificate: Certificate) -> bool:
    """Whether the certificate is for this key."""
    return one.public_key().public_numbers() == certificate.public_key.public_numbers()


def common_name_of(name: x509.Name) -> str:
    """The one common name in a subject. `CertificateError` when there is none or more than one."""
    from cryptography.x509.oid import NameOID

    found = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    if len(found) != 1:
        raise CertificateError("malformed", "it must have exactly one common name")
    return str(found[0].value)


def _loaded_pem(data: bytes) -> x509.Certificate:
    needs_cryptography()
    from cryptography import x509

    if len(data) > PEM_BYTES_MAX:
        raise CertificateError("oversized", f"{len(data)} bytes, at most {PEM_BYTES_MAX} are accepted")
    try:
        return x509.load_pem_x509_certificate(data)
    except Exception:  # as above
        raise CertificateError("malformed", "it is not a certificate") from None


def _der(certificate: x509.Certificate) -> bytes:
    from cryptography.hazmat.primitives import serialization

    return certificate.public_bytes(serialization.Encoding.DER)


def _examined(loaded: x509.Certificate, authority: x509.Certificate) -> Certificate:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    try:
        loaded.verify_directly_issued_by(authority)
    except Exception:  # as above
        raise CertificateError(
            "unknown_authority", "it is not signed by this fleet's authority of now"
        ) from None
    try:
        identity = parse(common_name_of(loaded.subject))
        constraints = loaded.extensions.get_extension_for_class(x509.BasicConstraints).value
        names = loaded.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        key = loaded.public_key()
        if constraints.ca or not isinstance(key, ec.EllipticCurvePublicKey):
            raise CertificateError("malformed", "it is not a certificate of a robot, operator or router")
    except (IdentityError, x509.ExtensionNotFound, ValueError) as error:
        raise CertificateError("malformed", f"it is not one of ours: {error}") from None
    return Certificate(
        identity=identity,
        addresses=tuple(
            sorted(
                [
                    *map(str, names.get_values_for_type(x509.IPAddress)),
                    *names.get_values_for_type(x509.DNSName),
                ]
            )
        ),
        not_before_s=int(loaded.not_valid_before_utc.timestamp()),
        not_after_s=int(loaded.not_valid_after_utc.timestamp()),
        serial=loaded.serial_number,
        fingerprint=fingerprint(loaded),
        der=_der(loaded),
        public_key=key,
    )
