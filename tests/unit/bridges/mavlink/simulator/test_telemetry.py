"""What a simulated rover says of itself, how often, and when it knows where it is."""

from __future__ import annotations

from itertools import pairwise
from math import hypot
from statistics import mean

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, geodetic_to_local
from tests.unit.bridges.mavlink.rover_bench import ACCEPTED, DENIED, HOME, START_NS, Bench, ready

# Streams


@pytest.mark.parametrize(
    ("rate", "result"), [(25.0, ACCEPTED), (40.0, ACCEPTED), (41.0, DENIED), (50.0, DENIED)]
)
def test_forty_a_second_are_granted_and_no_more(rate: float, result: int) -> None:
    bench = Bench(boot="warm")
    assert bench.interval(constants.MESSAGE_LOCAL_POSITION_NED, rate) == result
    since = bench.time
    bench.run(10.0)
    expected = rate if result == ACCEPTED else 1.0
    assert len(bench.of("LOCAL_POSITION_NED", since)) / 10.0 == pytest.approx(expected, rel=0.11)


def gaps(bench: Bench, rate: float) -> list[float]:
    assert bench.interval(constants.MESSAGE_ATTITUDE, rate) == ACCEPTED
    bench.run(0.2)
    since = bench.time
    bench.run(60.0)
    return [b - a for a, b in pairwise(bench.times("ATTITUDE", since))]


def test_25_hz_is_steady_and_40_hz_alternates() -> None:
    steady = gaps(Bench(boot="warm"), 25.0)
    assert mean(steady) == pytest.approx(0.04, abs=0.001)
    assert 0.055 < max(steady) <= 0.0651
    assert sum(abs(gap - 0.04) < 0.006 for gap in steady) > 0.9 * len(steady)
    alternating = gaps(Bench(boot="warm"), 40.0)
    assert mean(alternating) == pytest.approx(0.025, abs=0.001)
    assert sum(abs(gap - 0.02) < 0.006 for gap in alternating) > 0.5 * len(alternating)
    assert sum(abs(gap - 0.04) < 0.006 for gap in alternating) > 0.15 * len(alternating)


def test_a_change_of_mode_is_said_at_once() -> None:
    bench = ready()
    bench.run(3.3)
    since = bench.time
    bench.rover.set_mode("HOLD")
    bench.run(0.03)
    assert [m.custom_mode for m in bench.of("HEARTBEAT", since)][-1] == constants.MODE_HOLD


def test_a_change_of_arming_waits_for_the_next_heartbeat() -> None:
    bench = ready()
    bench.until(lambda: len(bench.of("HEARTBEAT")) > 3)
    since = bench.time
    bench.rover.disarm()
    bench.run(0.7)
    assert bench.of("HEARTBEAT", since + 0.001) == []
    assert "Throttle disarmed" in bench.texts(since)
    bench.run(0.5)
    assert not bench.last("HEARTBEAT").base_mode & constants.FLAG_ARMED


def test_timesync_answers_by_the_boot_clock_and_asks_too() -> None:
    bench = Bench(boot="warm")
    bench.run(1.0)
    bench.send(mavlink.MAVLink_timesync_message(0, 1234))
    bench.run(0.05)
    (answer,) = bench.of("TIMESYNC")
    assert answer.ts1 == 1234
    assert START_NS + NS_PER_S <= bench.rover.boot_ns + answer.tc1 <= bench.now_ns
    bench.run(12.0)
    assert bench.last("TIMESYNC").tc1 == 0
    stamp = bench.last("ATTITUDE").time_boot_ms
    assert 0.0 <= (bench.now_ns - bench.rover.boot_ns) / 1e9 - stamp / 1e3 < 1.1


# Estimate


def test_a_cold_boot() -> None:
    bench = Bench(home=HOME)
    bench.run(0.5)
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"WP_SPEED", -1))
    bench.run(0.4)
    assert bench.heard == []
    assert bench.until(lambda: bench.heard) < 2.0
    assert bench.of("PARAM_VALUE") == []
    assert bench.until(lambda: bench.rover.origin) == pytest.approx(17.0, abs=0.1)
    bench.run(0.1)
    assert len(bench.of("GPS_GLOBAL_ORIGIN")) == 1
    assert bench.until(lambda: bench.rover.ready) == pytest.approx(40.0, abs=0.1)
    bench.run(2.0)
    assert bench.of("EKF_STATUS_REPORT")[0].flags == constants.EKF_UNINITIALIZED
    assert any(m.flags == 0xA7 for m in bench.of("EKF_STATUS_REPORT"))
    assert bench.last("EKF_STATUS_REPORT").flags == 0x33F
    assert bench.of("GPS_RAW_INT")[0].fix_type == constants.GPS_NO_FIX
    assert bench.of("GLOBAL_POSITION_INT")[0].lat == 0
    assert bench.last("GPS_RAW_INT").fix_type == constants.GPS_3D_FIX


def test_positions_count_from_its_own_origin() -> None:
    bench = ready(home=HOME, yaw=0.7)
    bench.run(20.0, lambda: bench.drive(0.8, 0.1))
    at = bench.last("LOCAL_POSITION_NED")
    origin = bench.rover.origin
    assert origin is not None
    before = bench.rover.place
    north, east = geodetic_to_local(origin, before)
    assert (at.x, at.y) == pytest.approx((north, east), abs=1.0)
    bench.run(3.0, lambda: bench.drive(0.0))
    bench.run(2.0)
    at, seen = bench.last("LOCAL_POSITION_NED"), bench.last("GLOBAL_POSITION_INT")
    assert (at.x, at.y) == pytest.approx(geodetic_to_local(origin, bench.rover.place), abs=0.04)
    place = Geodetic(seen.lat * 1e-7, seen.lon * 1e-7)
    assert geodetic_to_local(origin, place) == pytest.approx((at.x, at.y), abs=0.02)


@pytest.mark.slow
def test_a_phantom_speed_at_rest() -> None:
    speeds = []
    for seed in range(5):
        bench = ready(seed=seed)
        bench.run(60.0)
        speeds += [hypot(m.vx, m.vy) for m in bench.of("LOCAL_POSITION_NED")]
        assert bench.rover.speed == 0.0
    assert 0.02 <= min(speeds) < 0.025
    assert 0.045 < max(speeds) <= 0.05


def origin_message(place: Geodetic) -> mavlink.MAVLink_set_gps_global_origin_message:
    return mavlink.MAVLink_set_gps_global_origin_message(
        1, round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), round(place.altitude_m * 1e3)
    )


def test_an_origin_that_is_sent_early_is_taken_and_said() -> None:
    datum = Geodetic(47.3981, 8.5460, 488.0)
    bench = Bench(home=HOME)
    bench.run(45.0, lambda: bench.send(origin_message(datum)), period_s=1.0)
    assert bench.rover.origin == pytest.approx(datum)
    (said,) = bench.of("GPS_GLOBAL_ORIGIN")
    assert (said.latitude, said.longitude) == (473981000, 85460000)
    bench.run(2.0)
    at = bench.last("LOCAL_POSITION_NED")
    assert (at.x, at.y) == pytest.approx(geodetic_to_local(datum, bench.rover.place), abs=0.05)
