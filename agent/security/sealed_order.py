"""Operators' orders and their seals, which prove that an order is an operator's and unchanged (PURE).

A sealed order is one MessagePack array ``[1, time, certificate, signature, payload]``: when it was sealed
(wall time, ns), the operator's certificate (DER), an ECDSA signature (P-256, SHA-256, DER) over `DOMAIN`, the
time (8 bytes, the highest first) and the payload, and the order as `agent.messages.codec` made it. Whether
an order is older than another is the receiver's to find out, by the version in the payload.

Behind the gate, between bus and process, an order is what its codec made, without its seal: the
gate opens the seal, and lets nothing in that is no operator's.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterable
from struct import Struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgpack

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import head
from handfast.agent.messages.types import MISSION_BYTES_MAX, TIME_NS_MAX, Mission, Resume, Stop
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


AGE_NS_MAX: Final = 2 * NS_PER_S
"""Of what is sent once and not relayed (heartbeats, faults, questions) a seal is not older, nor that much
ahead: who has overheard one cannot use it later. Missions, stops and resumes have versions, and are
relayed."""
SEALS_BYTES_MAX: Final = 2_097_152
"""Of orders that may be relayed: thousands of stops, or some twenty of the largest missions."""
NEW_MAX: Final = 4
NEW_PERIOD_NS: Final = NS_PER_S // 10
"""Within such a period so many seals that one robot relays are verified, and then no more, genuine or not:
to verify one costs ten times as much as to make one up, and old orders can be repeated for nothing. Those
that were verified of late are remembered, and cost nothing. What operators send is always looked at."""
_LASTING: Final = tuple(map(head, (Mission, Stop, Resume)))
"""How the orders begin that robots relay (`agent.messages.codec`)."""


class OrderGate:
    """Opens what comes as an order, and puts its seal on what goes out as one.

    Args:
        fleet: its name.
        robots: ids of its robots.
        opener: of that fleet.
        sealer: of the operator whose process this is, None for those who only pass on what operators said.
        refused: called with a few words for each order that is not let in.
    """

    def __init__(
        self,
        fleet: str,
        robots: Iterable[int],
        opener: Opener,
        sealer: Sealer | None,
        refused: Callable[[str], None],
    ) -> None:
        self._orders: Final = frozenset(key_expressions.orders(fleet))
        self._relayed: Final = frozenset(key_expressions.relayed(fleet, robot) for robot in robots)
        self._like_relayed: Final = tuple(key_expressions.relayed(fleet, "*").split("*"))
        self._opener, self._sealer, self._refused = opener, sealer, refused
        self._sealed: OrderedDict[bytes, bytes] = OrderedDict()
        self._size = 0
        self._new: Counter[str] = Counter()
        self._new_ns = 0

    def is_order(self, key: str) -> bool:
        """Whether only what an operator has sealed is let through on `key`."""
        before, after = self._like_relayed
        return key in self._orders or (key.startswith(before) and key.endswith(after))

    def let_in(self, key: str, payload: bytes, now_ns: int) -> bytes | None:
        """What came on `key`, opened if it is an order; None when it is not let in.

        Args:
            now_ns: the present, wall time.
        """
        if not self.is_order(key):
            return payload
        is_relayed = key in self._relayed
        if not is_relayed and key not in self._orders:
            self._refused("an order where no robot of the fleet relays any")  # whoever sent it chose the key
            return None
        if is_relayed and not self._opener.has_verified(payload) and self._is_too_much(key, now_ns):
            self._refused(f"an order on {key}: after too many that were new")
            return None
        try:
            order = self._opener.open(payload, now_ns / NS_PER_S)
        except Forged as error:
            self._refused(f"an order on {key}: {error.reason.replace('_', ' ')}")
            return None
        lasts = order.payload.startswith(_LASTING)
        if is_relayed and not lasts:
            self._refused(f"an order on {key}: not one that robots relay")
            return None
        if not lasts and abs(now_ns - order.sealed_ns) > AGE_NS_MAX:
            when = "long ago" if now_ns > order.sealed_ns else "in the future"
            self._refused(f"an order on {key}: sealed {when} (by this computer's clock)")
            return None
        self._remember(order.payload, payload)
        return order.payload

    def let_out(self, key: str, payload: bytes, now_ns: int) -> bytes | None:
        """What is to go out on `key`; None for an order that no operator has given.

        An order that is relayed goes out as the same bytes, which receivers may have verified already.

        Args:
            now_ns: the present, wall time.
        """
        if not self.is_order(key):
            return payload
        sealed = self._sealed.get(payload)
        if sealed is None and self._sealer is not None:
            sealed = self._sealer.seal(payload, now_ns)
            self._remember(payload, sealed)
        if sealed is None:
            self._refused(f"to say an order on {key}: the operator's seal of it is no longer known here")
        return sealed

    def seal_of(self, payload: bytes) -> bytes | None:
        """The sealed order that these bytes came in, None where that is no longer known."""
        return self._sealed.get(payload)

    def recall(self, sealed: bytes) -> bytes:
        """The order that was let in once, and kept since as it came: relayed again it goes out so.

        Raises:
            Forged: it is none of an operator's, or not one that lasts.
        """
        payload = self._opener.open_recorded(sealed).payload
        if not payload.startswith(_LASTING):
            raise Forged("malformed", "not an order that lasts")
        self._remember(payload, sealed)
        return payload

    def _is_too_much(self, key: str, now_ns: int) -> bool:
        """Counts a seal that is new; whether too many of these have come on `key` of late."""
        if not 0 <= now_ns - self._new_ns < NEW_PERIOD_NS:
            self._new_ns = now_ns
            self._new.clear()
        self._new[key] += 1
        return self._new[key] > NEW_MAX

    def _remember(self, payload: bytes, sealed: bytes) -> None:
        if not payload.startswith(_LASTING):
            return  # heartbeats would soon be all that is remembered
        if payload in self._sealed:
            self._sealed.move_to_end(payload)
            return
        self._sealed[payload] = sealed
        self._size += len(payload) + len(sealed)
        while self._size > SEALS_BYTES_MAX:
            oldest = self._sealed.popitem(last=False)
            self._size -= sum(map(len, oldest))
