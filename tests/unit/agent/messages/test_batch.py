"""Batches of what several robots say."""

from __future__ import annotations

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.messages.batch import EACH_MAX, packed, unpacked
from handfast.agent.messages.types import BYTES_MAX
from handfast.agent.messages.validation import Malformed
from handfast.agent.transport.bus import PAYLOAD_BYTES_MAX

Said = list[tuple[int, bytes]]


class Named(dict[int, str]):
    """Each robot's key is its number."""

    def get(self, robot: int, default: object = None) -> str:  # type: ignore[override]
        return str(robot)


def opened(batch: bytes, robots: int) -> Said:
    return [(int(key), payload) for key, payload in unpacked(batch, robots, Named())]


@given(st.lists(st.tuples(st.integers(1, 2**32 - 1), st.binary(max_size=300)), max_size=40))
def test_what_was_said_comes_as_it_was_said_and_in_order(said: Said) -> None:
    for robots in (1, 3, 40):  # one may say far more than its share
        found = [each for made in packed(said, robots) for each in opened(made, robots)]
        assert found == said


def test_nothing_is_an_empty_batch() -> None:
    (made,) = packed([], 1)
    assert opened(made, 1) == []


def test_no_batch_is_larger_than_a_link_lets_through() -> None:
    said = [(k, bytes(BYTES_MAX)) for k in range(200)]
    made = packed(said, 200)
    assert max(map(len, made)) <= PAYLOAD_BYTES_MAX
    assert len(made) < 200
    assert [each for batch in made for each in opened(batch, 200)] == said


def test_what_is_not_asked_for_is_left_out() -> None:
    (made,) = packed([(1, b"one"), (2, b"two"), (1, b"again")], 2)
    assert unpacked(made, 2, {1: "first"}) == [("first", b"one"), ("first", b"again")]


@pytest.mark.parametrize(
    "row",
    [
        5,
        {1: b""},
        [1],
        [1, "text"],
        ["1", b""],
        [True, b""],
        [1.0, b""],
        [1, b"", 2],
        [1, [b""]],
        [1, b""] * (EACH_MAX + 1),
        [1, bytes(BYTES_MAX + 1)],
    ],
)
def test_what_is_no_batch_is_refused(row: object) -> None:
    with pytest.raises(Malformed):
        unpacked(msgpack.packb(row), 1, {})


@given(st.binary(max_size=60))
def test_any_bytes_are_a_batch_or_are_refused(payload: bytes) -> None:
    try:
        found = opened(payload, 3)
    except Malformed:
        return
    assert len(found) <= 3 * EACH_MAX
    assert all(type(robot) is int and type(said) is bytes for robot, said in found)
