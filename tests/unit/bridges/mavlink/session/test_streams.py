"""Message rates: asked one at a time, the next lower on refusal, again when they are not kept."""

from __future__ import annotations

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.session.streams import Streams, Wanted

ATTITUDE = Wanted(constants.MESSAGE_ATTITUDE, "ATTITUDE", (25.0, 20.0, 12.5))
GPS = Wanted(constants.MESSAGE_GPS_RAW_INT, "GPS_RAW_INT", (1.0,))


def feed(streams: Streams, message: int, since_ns: int, until_ns: int, rate_hz: float) -> None:
    count = round((until_ns - since_ns) / NS_PER_S * rate_hz)
    for index in range(1, count + 1):
        streams.heard(message, since_ns + round(index * NS_PER_S / rate_hz))


def test_one_request_at_a_time_in_whole_microseconds() -> None:
    streams = Streams((ATTITUDE, GPS))
    assert streams.ask(0) == (constants.MESSAGE_ATTITUDE, 40_000)
    assert streams.ask(0) is None
    streams.answered(5, constants.RESULT_ACCEPTED)
    assert streams.ask(5) == (constants.MESSAGE_GPS_RAW_INT, 1_000_000)
    streams.answered(9, constants.RESULT_ACCEPTED)
    assert streams.ask(9) is None


def test_a_refused_rate_is_lowered_until_one_is_granted() -> None:
    streams = Streams((ATTITUDE,))
    asked = []
    for result in (constants.RESULT_DENIED, constants.RESULT_FAILED, constants.RESULT_ACCEPTED):
        wanted = streams.ask(0)
        assert wanted is not None
        asked.append(wanted[1])
        streams.answered(0, result)
    assert asked == [40_000, 50_000, 80_000]
    (row,) = streams.rows(0)
    assert (row.asked_hz, row.granted_hz, row.answer) == (25.0, 12.5, "accepted")


def test_what_is_refused_for_good_is_not_asked_again() -> None:
    streams = Streams((GPS,))
    assert streams.ask(0)
    streams.answered(0, constants.RESULT_DENIED)
    assert streams.ask(3600 * NS_PER_S) is None
    assert streams.rows(0)[0].answer == "denied"
    assert streams.rows(0)[0].granted_hz is None


def test_without_an_answer_it_is_asked_again_later() -> None:
    streams = Streams((GPS,))
    assert streams.ask(0)
    streams.answered(0, None)
    assert streams.rows(0)[0].answer == "no answer"
    assert streams.ask(3 * NS_PER_S - 1) is None
    assert streams.ask(3 * NS_PER_S)


def test_a_rate_that_is_kept_is_left_alone_and_measured() -> None:
    streams = Streams((ATTITUDE,))
    assert streams.ask(0)
    streams.answered(0, constants.RESULT_ACCEPTED)
    feed(streams, constants.MESSAGE_ATTITUDE, 0, 10 * NS_PER_S, 25.0)
    assert streams.ask(10 * NS_PER_S) is None
    row = streams.rows(10 * NS_PER_S)[0]
    assert abs(row.measured_hz - 25.0) < 0.5


def test_less_than_seven_tenths_for_three_seconds_is_asked_again_ever_more_rarely() -> None:
    streams = Streams((ATTITUDE,))
    assert streams.ask(0)
    streams.answered(0, constants.RESULT_ACCEPTED)
    asked, now_ns = [], 0
    while now_ns < 60 * NS_PER_S:
        now_ns += NS_PER_S // 10
        streams.heard(constants.MESSAGE_ATTITUDE, now_ns)
        if streams.ask(now_ns) is not None:
            asked.append(round(now_ns / NS_PER_S))
            streams.answered(now_ns, constants.RESULT_ACCEPTED)
    assert asked == [3, 9, 18, 33, 60]
    row = streams.rows(now_ns)[0]
    assert abs(row.measured_hz - 10.0) < 0.5
