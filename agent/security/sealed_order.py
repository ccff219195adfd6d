"""Operators' orders, signed: whoever passes them on, they are known to be an operator's, and unchanged.

A sealed order is one MessagePack array ``[1, time, certificate, signature, payload]``: when it was sealed
(wall time, ns), the operator's certificate (DER), an ECDSA signature (P-256, SHA-256, DER) over `DOMAIN`, the
time (8 bytes, the highest first) and the payload, and the order as `agent.messages.codec` made it. Whether
an order is older than another is the receiver's to find out, by the version in the payload.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection
from struct import Struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgpack

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import MISSION_BYTES_MAX, TIME_NS_MAX
from handfast.agent.security.certificates import DER_BYTES_MAX, Certificate, CertificateError, issued
from handfast.agent.security.credentials import Credentials

if TYPE_CHECKING:
    from cryptography import x509

VERSION: Final = 1
"""Version of the seal, the first field of a sealed order."""
DOMAIN: Final = b"handfast order 1\0"
"""Goes before what is signed: the same key proves who its holder is on TLS links, and neither of the two
kinds of signature must pass for the other."""
SIGNATURE_BYTES_MAX: Final = 72
SEALED_BYTES_MAX: Final = MISSION_BYTES_MAX + DER_BYTES_MAX + SIGNATURE_BYTES_MAX + 32
CERTIFICATES_MAX: Final = 16
"""Operators' certificates that are remembered as verified."""
ORDERS_MAX: Final = 32
"""Orders that are remembered as verified: many robots relay the same one."""
REASONS: Final = (
    "oversized", "malformed", "unknown_authority", "not_yet_valid", "expired", "not_an_operator",
    "bad_signature",
)  # fmt: skip
_TYPES: Final = (int, int, bytes, bytes, bytes)
_TIME: Final = Struct(">Q")


class Forged(ValueError):
    """What is not an order of one of the fleet's operators; `reason` is one of `REASONS`."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class Order(NamedTuple):
    """An order that was found to be genuine: when it was sealed (wall time, ns), and its bytes."""

    sealed_ns: int
    payload: bytes


class Sealer:
    """Seals the orders of one operator.

    Raises:
        ValueError: the credentials are not an operator's.
    """

    def __init__(self, credentials: Credentials) -> None:
        from cryptography.hazmat.primitives.asymmetric.ec import ECDSA
        from cryptography.hazmat.primitives.hashes import SHA256

        if credentials.identity.role != "operator":
            raise ValueError(f"only an operator seals orders, not {credentials.identity}")
        self._certificate = credentials.certificate.der
        self._key = credentials.key
        self._algorithm = ECDSA(SHA256())

    def seal(self, payload: bytes, now_ns: int) -> bytes:
        """The sealed order of an encoded message; `now_ns`: the present, wall time."""
        signature = self._key.sign(_signed(now_ns, payload), self._algorithm)
        return _packed((VERSION, now_ns, self._certificate, signature, payload))


def payload_of(sealed: bytes) -> bytes:
    """The order in `sealed`, whoever has sealed it.

    Raises:
        Forged: it is no sealed order.
    """
    return _parts(sealed)[3]


class Opener:
    """Opens sealed orders, of operators of one fleet.

    Args:
        fleet: its name.
        operators: names of those who may give it orders; a certificate alone is not enough, as it outlives
            being one of them.
        authority: the certificate of its authority.
    """

    def __init__(self, fleet: str, operators: Collection[str], authority: x509.Certificate) -> None:
        from cryptography.hazmat.primitives.asymmetric.ec import ECDSA
        from cryptography.hazmat.primitives.hashes import SHA256

        self._fleet = fleet
        self._operators = frozenset(operators)
        self._authority = authority
        self._algorithm = ECDSA(SHA256())
        self._certificates: OrderedDict[bytes, Certificate] = OrderedDict()
        self._orders: OrderedDict[bytes, tuple[Certificate, int, bytes]] = OrderedDict()

    def has_verified(self, sealed: bytes) -> bool:
        """Whether these bytes were verified of late: then `open` verifies no signature."""
        return sealed in self._orders

    def open(self, sealed: bytes, now_s: float) -> Order:
        """The order in `sealed`.

        Args:
            now_s: the present, wall time.

        Raises:
            Forged: it is none, or its operator's certificate is not valid at `now_s`.
        """
        if len(sealed) > SEALED_BYTES_MAX:
            raise Forged("oversized", f"{len(sealed)} bytes, at most {SEALED_BYTES_MAX} are accepted")
        known = self._orders.get(sealed)
        if known is not None:
            self._orders.move_to_end(sealed)
            certificate, sealed_ns, payload = known
            self._check_time(certificate, now_s)
        else:
            sealed_ns, der, signature, payload = _parts(sealed)
            certificate = self._certificate(der, now_s)
            self._check_signature(certificate, signature, _signed(sealed_ns, payload))
            _remember(self._orders, sealed, (certificate, sealed_ns, payload), ORDERS_MAX)
        return Order(sealed_ns, payload)

    def open_recorded(self, sealed: bytes) -> Order:
        """The order in `sealed`, recorded or kept: its operator's certificate must have been valid
        then, not now. Raises as `open`."""
        if len(sealed) > SEALED_BYTES_MAX:
            raise Forged("oversized", f"{len(sealed)} bytes, at most {SEALED_BYTES_MAX} are accepted")
        return self.open(sealed, _parts(sealed)[0] / NS_PER_S)

    def _certificate(self, der: bytes, now_s: float) -> Certificate:
        certificate = self._certificates.get(der)
        if certificate is None:
            try:
                certificate = issued(der, self._authority)
            except CertificateError as error:
                raise Forged(error.reason, str(error)) from None
            identity = certificate.identity
            is_his = identity.fleet == self._fleet and identity.name in self._operators
            if identity.role != "operator" or not is_his:
                raise Forged("not_an_operator", f"sealed by {identity.common_name}")
            self._check_time(certificate, now_s)
            _remember(self._certificates, der, certificate, CERTIFICATES_MAX)
        else:
            self._certificates.move_to_end(der)
            self._check_time(certificate, now_s)
        return certificate

    def _check_signature(self, certificate: Certificate, signature: bytes, signed: bytes) -> None:
        from cryptography.exceptions import InvalidSignature

        try:
            certificate.public_key.verify(signature, signed, self._algorithm)
        except InvalidSignature:
            raise Forged("bad_signature", f"not what {certificate.identity.common_name} has signed") from None

    def _check_time(self, certificate: Certificate, now_s: float) -> None:
        try:
            certificate.check_time(now_s)
        except CertificateError as error:
            raise Forged(error.reason, str(error)) from None


def unverified(sealed: bytes) -> bytes:
    """The payload of what looks like a sealed order: nothing says who made it.

    Raises:
        Forged: it is none.
    """
    if len(sealed) > SEALED_BYTES_MAX:
        raise Forged("oversized", f"{len(sealed)} bytes, at most {SEALED_BYTES_MAX} are accepted")
    return _parts(sealed)[3]


def _packed(parts: tuple[int, int, bytes, bytes, bytes]) -> bytes:
    packed: bytes = msgpack.packb(parts, use_bin_type=True)
    return packed


def _signed(sealed_ns: int, payload: bytes) -> bytes:
    return DOMAIN + _TIME.pack(sealed_ns) + payload


def _parts(sealed: bytes) -> tuple[int, bytes, bytes, bytes]:
    """Time, certificate, signature and payload, of sizes that they may have."""
    try:
        array: Any = msgpack.unpackb(
            sealed,
            use_list=False,
            max_array_len=5,
            max_bin_len=MISSION_BYTES_MAX,
            max_map_len=0,
            max_str_len=0,
            max_ext_len=0,
        )
    except Exception as error:  # msgpack raises a dozen unrelated types; each means the same here
        raise Forged("malformed", f"not one MessagePack array ({type(error).__name__})") from None
    if type(array) is not tuple or tuple(map(type, array)) != _TYPES:
        raise Forged("malformed", "not a MessagePack array [version, time, certificate, signature, payload]")
    version, sealed_ns, der, signature, payload = array
    if version != VERSION:
        raise Forged("malformed", f"a seal of version {version}, this program makes {VERSION}")
    if not 0 <= sealed_ns <= TIME_NS_MAX:
        raise Forged("malformed", "sealed at a time that cannot be")
    for part, what, most in (
        (der, "a certificate", DER_BYTES_MAX),
        (signature, "a signature", SIGNATURE_BYTES_MAX),
    ):
        if len(part) > most:
            raise Forged("oversized", f"{what} of {len(part)} bytes, at most {most} are accepted")
    if _packed(array) != sealed:  # else one order could be written in many ways, each to be verified
        raise Forged("malformed", "not written as short as it can be")
    return sealed_ns, der, signature, payload


def _remember(known: OrderedDict[bytes, Any], name: bytes, value: Any, most: int) -> None:
    """Keeps the `most` that were used last."""
    if len(known) >= most:
        known.popitem(last=False)
    known[name] = value
