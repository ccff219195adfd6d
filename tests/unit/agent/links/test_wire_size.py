"""Bytes of a message on a link. That they are the real ones the benchmark `radio` shows."""

from __future__ import annotations

import pytest

from agent.links.wire_size import (
    ACKNOWLEDGED,
    HEADERS_BYTES,
    KEEP_ALIVE_BYTES,
    KEEP_ALIVE_HZ,
    acknowledged_bytes,
    carried_bytes,
    joined_bytes,
    keep_alive_bytes,
)
from agent.transport.bus import KEEP_ALIVES, LEASE_MS


def test_a_message_has_what_zenoh_tls_tcp_and_ip_put_around_it() -> None:
    assert carried_bytes(200, secured=False) == 200 + 12 + 52
    assert carried_bytes(200, secured=True) == 200 + 12 + 22 + 52
    assert joined_bytes(200) == 205


@pytest.mark.parametrize(("size", "packets"), [(1436, 1), (1437, 2), (2884, 2), (2885, 3)])
def test_a_large_one_takes_more_packets(size: int, packets: int) -> None:
    assert carried_bytes(size, secured=False) == size + 12 + packets * 52
    assert acknowledged_bytes(size, secured=False) == pytest.approx(packets * ACKNOWLEDGED * HEADERS_BYTES)


def test_signs_of_life_come_four_times_in_a_lease() -> None:
    assert KEEP_ALIVE_HZ * LEASE_MS / 1000 == KEEP_ALIVES
    assert keep_alive_bytes(secured=False) == KEEP_ALIVE_BYTES + HEADERS_BYTES
    assert keep_alive_bytes(secured=True) == KEEP_ALIVE_BYTES + HEADERS_BYTES + 22
