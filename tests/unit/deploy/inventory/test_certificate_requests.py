"""Requests that must not be signed."""

from __future__ import annotations

import base64

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.oid import NameOID

from handfast.agent.security.certificates import new_key, new_request
from handfast.agent.security.identity import of_operator
from handfast.deploy.inventory.operator_credentials import REQUEST_BYTES_MAX, RequestError, examined
from tests.trusted import FLEET

ANNA = of_operator(FLEET, "anna")


def by(key: ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey) -> bytes:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, ANNA.common_name)])
    made = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA256())
    return made.public_bytes(serialization.Encoding.PEM)


def with_bad_signature() -> bytes:
    body = new_request(new_key(), ANNA).splitlines()
    der = bytearray(base64.b64decode(b"".join(body[1:-1])))
    der[-3] ^= 0x01
    return b"\n".join((body[0], base64.b64encode(der), body[-1], b""))


def test_a_sound_one() -> None:
    key = new_key()
    name, found = examined(new_request(key, ANNA), "x")
    assert name == ANNA.common_name
    assert found == key.public_key()


@pytest.mark.parametrize(
    ("pem", "why"),
    [
        (b"", "x is not a certificate request"),
        (new_request(new_key(), ANNA) + b" " * REQUEST_BYTES_MAX, "x is too large"),
        (with_bad_signature(), "x is not (signed with|a certificate request)"),
        (by(rsa.generate_private_key(65537, 2048)), "x is not signed with a key of the right kind"),
        (by(ec.generate_private_key(ec.SECP384R1())), "x is for a key on secp384r1, not on P-256"),
    ],
)
def test_what_must_not_be_signed(pem: bytes, why: str) -> None:
    with pytest.raises(RequestError, match=why):
        examined(pem, "x")
