"""Whatever bytes come, a seal opens or is refused by a reason; and only what was sealed opens."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.security import sealed_order
from handfast.agent.security.identity import of_operator
from handfast.agent.security.sealed_order import Forged, Opener, Sealer
from tests.trusted import FLEET, NOW_S, authority, credentials

PAYLOADS = (b"drive", b"\x00" * 200, bytes(range(256)))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Opener, tuple[bytes, ...]]]:
    """Who opens, and genuine orders."""
    folder: Path = tmp_path_factory.mktemp("trusted")
    with authority(folder / "authority") as by:
        ann = credentials(by, folder / "ann", of_operator(FLEET, "ann"))
        sealer = Sealer(ann)
        sealed = tuple(sealer.seal(payload, int(NOW_S * 1e9)) for payload in PAYLOADS)
        yield Opener(FLEET, ["ann"], ann.authority), sealed


def opened(opener: Opener, sealed: bytes) -> bytes | None:
    try:
        return opener.open(sealed, NOW_S).payload
    except Forged as error:
        return None if error.reason in sealed_order.REASONS else b"refused without a reason"


@given(garbage=st.binary(max_size=400))
def test_garbage(scene: tuple[Opener, tuple[bytes, ...]], garbage: bytes) -> None:
    assert opened(scene[0], garbage) is None


@given(
    version=st.integers(-1, 3),
    when=st.integers(-1, 2**64 - 1),
    certificate=st.binary(max_size=300) | st.none() | st.text(max_size=9),
    signature=st.binary(max_size=90),
    payload=st.binary(max_size=90) | st.integers(-9, 9),
    whole=st.booleans(),
)
def test_garbage_in_shape(
    scene: tuple[Opener, tuple[bytes, ...]],
    version: int,
    when: int,
    certificate: bytes | str | None,
    signature: bytes,
    payload: bytes | int,
    whole: bool,
) -> None:
    """`whole`: with a genuine certificate, so that all depends on the signature."""
    given_certificate = msgpack.unpackb(scene[1][0])[2] if whole else certificate
    assert opened(scene[0], msgpack.packb([version, when, given_certificate, signature, payload])) is None


@given(data=st.data())
def test_damaged_orders_open_unchanged_or_not_at_all(
    scene: tuple[Opener, tuple[bytes, ...]], data: st.DataObject
) -> None:
    opener, orders = scene
    number = data.draw(st.integers(0, len(orders) - 1))
    damaged = bytearray(orders[number])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    cut = data.draw(st.integers(0, len(damaged)))
    for sealed in (bytes(damaged), bytes(orders[number][:cut]), orders[number] + bytes(damaged[:cut])):
        assert opened(opener, sealed) in (None, PAYLOADS[number])
