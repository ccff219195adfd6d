"""Records of TLS as they are seen from outside, cut anywhere."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.admission.tls_records import (
    APPLICATION_DATA,
    HANDSHAKE,
    LENGTH_MAX,
    NotTlsError,
    RecordCounter,
    has_client_hello,
)
from tests.process.flood import client_hello


def record(kind: int, length: int) -> bytes:
    return bytes((kind, 3, 3)) + length.to_bytes(2, "big") + bytes(length)


def test_a_client_hello_is_known_once_it_is_whole():
    hello = client_hello()
    assert len(hello) > 100
    assert not any(has_client_hello(hello[:size]) for size in range(len(hello)))
    assert has_client_hello(hello)
    assert has_client_hello(hello + record(APPLICATION_DATA, 30))


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n",
        b"\x00",
        record(APPLICATION_DATA, 30),
        b"\x16\x02",
        b"\x16\x03\x01\x00\x00",
        b"\x16\x03\x01\xff\xff",
        b"\x16\x03\x01\x00\x10\x02",
    ],
)
def test_what_is_no_client_hello(data: bytes):
    with pytest.raises(NotTlsError):
        has_client_hello(data)


@given(
    st.lists(st.tuples(st.sampled_from((20, 21, HANDSHAKE, APPLICATION_DATA)), st.integers(1, 300))),
    st.integers(1, 400),
)
def test_records_are_counted_however_they_are_cut(records: list[tuple[int, int]], size: int):
    data = b"".join(record(kind, length) for kind, length in records)
    counter = RecordCounter()
    for at in range(0, len(data), size):
        counter.take(data[at : at + size])
    assert counter.count == sum(kind == APPLICATION_DATA for kind, _ in records)


@pytest.mark.parametrize("length", [0, LENGTH_MAX + 1])
def test_a_record_of_no_length_that_there_is(length: int):
    with pytest.raises(NotTlsError):
        RecordCounter().take(bytes((APPLICATION_DATA, 3, 3)) + length.to_bytes(2, "big"))
