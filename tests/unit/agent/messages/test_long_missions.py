"""A mission of a large fleet, which all hear again and again until all have it."""

from __future__ import annotations

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.codec import LONG, decode, encode, mark_of, newer
from handfast.agent.messages.types import Mission

MISSION = Mission(
    1, 10**18, 10**18, 60 * NS_PER_S, "ab" * 32, robots=tuple((k, float(k), 0.5) for k in range(1, 61))
)


def test_the_same_bytes_are_read_once() -> None:
    payload = encode(MISSION)
    assert len(payload) > LONG
    first = decode(payload)
    assert first == MISSION
    assert decode(bytes(bytearray(payload))) is first
    assert decode(encode(MISSION._replace(version=2))) == MISSION._replace(version=2)


def test_whether_it_is_newer_is_known_by_its_content() -> None:
    assert not newer(MISSION, MISSION)
    said_again = MISSION._replace(time_ns=MISSION.time_ns + 1)
    assert not newer(said_again, MISSION)
    assert mark_of(said_again) == mark_of(MISSION)
    assert newer(MISSION._replace(version=2), MISSION)
    other = MISSION._replace(duration_ns=1)
    assert newer(other, MISSION) != newer(MISSION, other)
