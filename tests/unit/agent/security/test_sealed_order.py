"""Sealed orders: only those of the fleet's operators open, whoever passes them on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import MISSION_BYTES_MAX, Heartbeat
from handfast.agent.security import sealed_order
from handfast.agent.security.certificates import DER_BYTES_MAX
from handfast.agent.security.credentials import Credentials
from handfast.agent.security.identity import of_operator, of_robot, of_router
from handfast.agent.security.sealed_order import (
    DOMAIN,
    SEALED_BYTES_MAX,
    SIGNATURE_BYTES_MAX,
    VERSION,
    Forged,
    Opener,
    Order,
    Sealer,
)
from handfast.deploy.inventory.certificate_authority import CERTIFICATE_DAYS, Authority
from tests.trusted import FLEET, NOW_S, authority, credentials

PAYLOAD = encode(Heartbeat(int(NOW_S * 1e9), "ann"))
NOW_NS = int(NOW_S * 1e9)
OPERATORS = ("ann", "bob", *(f"op-{number}" for number in range(sealed_order.CERTIFICATES_MAX + 2)))
LATER_S = NOW_S + CERTIFICATE_DAYS * 86_400


@pytest.fixture
def by(tmp_path: Path) -> Iterator[Authority]:
    with authority(tmp_path / "authority") as made:
        yield made


@pytest.fixture
def ann(by: Authority, tmp_path: Path) -> Credentials:
    return credentials(by, tmp_path / "ann", of_operator(FLEET, "ann"))


@pytest.fixture
def opener(ann: Credentials) -> Opener:
    return Opener(FLEET, OPERATORS, ann.authority)


def reason(opener: Opener, sealed: bytes, now_s: float = NOW_S) -> str:
    """Why it does not open."""
    with pytest.raises(Forged) as raised:
        opener.open(sealed, now_s)
    assert raised.value.reason in sealed_order.REASONS
    assert len(str(raised.value).splitlines()) == 1
    return raised.value.reason


def parts(sealed: bytes) -> list[Any]:
    return list(msgpack.unpackb(sealed))


def test_what_an_operator_sealed_opens(ann: Credentials, opener: Opener) -> None:
    for payload in (PAYLOAD, b"", b"x" * MISSION_BYTES_MAX):
        sealed = Sealer(ann).seal(payload, NOW_NS)
        assert len(sealed) <= SEALED_BYTES_MAX
        for _ in range(2):
            assert opener.open(sealed, NOW_S) == Order(NOW_NS, payload)
    assert isinstance(decode(opener.open(Sealer(ann).seal(PAYLOAD, NOW_NS), NOW_S).payload), Heartbeat)


def test_the_largest_seal_passes_the_bus() -> None:
    from handfast.agent.transport.bus import PAYLOAD_BYTES_MAX

    assert SEALED_BYTES_MAX <= PAYLOAD_BYTES_MAX


def test_nobody_else_seals(by: Authority, tmp_path: Path, opener: Opener) -> None:
    for identity in (of_robot(FLEET, 1), of_router(FLEET)):
        his = credentials(by, tmp_path / "other", identity)
        with pytest.raises(ValueError, match="only an operator"):
            Sealer(his)
        assert reason(opener, forged(his, PAYLOAD)) == "not_an_operator"


def forged(his: Credentials, payload: bytes, domain: bytes = DOMAIN) -> bytes:
    """Sealed as `Sealer` does it, by whoever it may be."""
    from cryptography.hazmat.primitives.asymmetric.ec import ECDSA
    from cryptography.hazmat.primitives.hashes import SHA256

    signature = his.key.sign(domain + NOW_NS.to_bytes(8, "big") + payload, ECDSA(SHA256()))
    return bytes(msgpack.packb((VERSION, NOW_NS, his.certificate.der, signature, payload)))


def test_another_authority(tmp_path: Path, opener: Opener) -> None:
    """Of the same name, too: it is the key that counts."""
    with authority(tmp_path / "other") as other:
        his = credentials(other, tmp_path / "x", of_operator(FLEET, "ann"))
    assert reason(opener, Sealer(his).seal(PAYLOAD, NOW_NS)) == "unknown_authority"


def test_an_operator_of_another_fleet(by: Authority, tmp_path: Path, ann: Credentials) -> None:
    opener = Opener("another", OPERATORS, ann.authority)
    assert reason(opener, Sealer(ann).seal(PAYLOAD, NOW_NS)) == "not_an_operator"


def test_an_operator_who_is_none_any_more(ann: Credentials) -> None:
    """The certificate is still good."""
    opener = Opener(FLEET, ["bob"], ann.authority)
    assert reason(opener, Sealer(ann).seal(PAYLOAD, NOW_NS)) == "not_an_operator"


def test_an_order_is_written_in_one_way(ann: Credentials, opener: Opener) -> None:
    """Or each way would be a new one, and cost a verification."""
    sealed = Sealer(ann).seal(PAYLOAD, NOW_NS)
    version, when, certificate, signature, payload = parts(sealed)
    packed = msgpack.packb
    longer = b"".join(
        (
            b"\xdc\x00\x05",
            packed(version),
            packed(when),
            packed(certificate),
            packed(signature),
            packed(payload),
        )
    )
    assert parts(longer) == parts(sealed)
    assert reason(opener, longer) == "malformed"


def test_what_was_opened_is_known(ann: Credentials, opener: Opener) -> None:
    sealed, forged_one = Sealer(ann).seal(PAYLOAD, NOW_NS), forged(ann, PAYLOAD, b"")
    assert not opener.has_verified(sealed)
    opener.open(sealed, NOW_S)
    assert reason(opener, forged_one) == "bad_signature"
    assert opener.has_verified(sealed)
    assert not opener.has_verified(forged_one)


def test_dates_count_each_time(ann: Credentials, opener: Opener) -> None:
    """Also for a certificate, and an order, that are remembered."""
    sealed = Sealer(ann).seal(PAYLOAD, NOW_NS)
    assert reason(opener, sealed, LATER_S) == "expired"
    opener.open(sealed, NOW_S)
    assert reason(opener, sealed, LATER_S) == "expired"
    assert reason(opener, Sealer(ann).seal(b"another", NOW_NS), LATER_S) == "expired"
    assert reason(opener, sealed, NOW_S - 3600) == "not_yet_valid"


def test_a_payload_that_was_changed(ann: Credentials, opener: Opener) -> None:
    sealed = Sealer(ann).seal(PAYLOAD, NOW_NS)
    opener.open(sealed, NOW_S)
    version, when, certificate, signature, payload = parts(sealed)
    changed = bytes([payload[0] ^ 1]) + payload[1:]
    assert reason(opener, msgpack.packb([version, when, certificate, signature, changed])) == "bad_signature"
    assert (
        reason(opener, msgpack.packb([version, when, certificate, signature[:-1], payload]))
        == "bad_signature"
    )
    assert reason(opener, msgpack.packb([version, when, certificate, b"", payload])) == "bad_signature"
    assert (
        reason(opener, msgpack.packb([version, when + 1, certificate, signature, payload])) == "bad_signature"
    )


def test_a_signature_for_another_purpose(ann: Credentials, opener: Opener) -> None:
    for domain in (b"", b"handfast order 2\0", b" " * 64 + b"TLS 1.3, client CertificateVerify\0"):
        assert reason(opener, forged(ann, PAYLOAD, domain)) == "bad_signature"


def test_what_is_no_seal(ann: Credentials, opener: Opener) -> None:
    version, when, certificate, signature, payload = parts(Sealer(ann).seal(PAYLOAD, NOW_NS))
    for array in (
        [],
        [version, when, certificate, signature],
        [version, when, certificate, signature, payload, b""],
        [version + 1, when, certificate, signature, payload],
        [True, when, certificate, signature, payload],
        [version, when, certificate.hex(), signature, payload],
        [version, when, certificate, signature, [payload]],
        [version, when, b"", signature, payload],
        [version, when, certificate[:-1], signature, payload],
        [version, -1, certificate, signature, payload],
        [version, 2**63, certificate, signature, payload],
        [version, 1.0, certificate, signature, payload],
        {"a": 1},
        7,
    ):
        assert reason(opener, msgpack.packb(array)) == "malformed"
    assert reason(opener, PAYLOAD) == "malformed"
    assert reason(opener, b"") == "malformed"


def test_sizes(ann: Credentials, opener: Opener) -> None:
    version, when, certificate, signature, payload = parts(Sealer(ann).seal(PAYLOAD, NOW_NS))
    assert reason(opener, b"\x94" * (SEALED_BYTES_MAX + 1)) == "oversized"
    for array in (
        [version, when, bytes(DER_BYTES_MAX + 1), signature, payload],
        [version, when, certificate, bytes(SIGNATURE_BYTES_MAX + 1), payload],
    ):
        assert reason(opener, msgpack.packb(array)) == "oversized"


def test_what_is_remembered_is_bounded(by: Authority, tmp_path: Path, opener: Opener) -> None:
    for number in range(sealed_order.CERTIFICATES_MAX + 2):
        name = f"op-{number}"
        his = credentials(by, tmp_path / name, of_operator(FLEET, name))
        for payload in (b"a", b"b"):
            assert opener.open(Sealer(his).seal(payload, NOW_NS), NOW_S) == Order(NOW_NS, payload)
    assert len(opener._certificates) == sealed_order.CERTIFICATES_MAX
    assert len(opener._orders) == sealed_order.ORDERS_MAX


def test_a_refused_order_is_not_remembered(ann: Credentials, opener: Opener) -> None:
    sealed = forged(ann, PAYLOAD, b"")
    for _ in range(2):
        assert reason(opener, sealed) == "bad_signature"
