"""Requests for certificates, before anything is signed: they may come from anybody."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from handfast.agent.security.certificates import common_name_of

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePublicKey

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
