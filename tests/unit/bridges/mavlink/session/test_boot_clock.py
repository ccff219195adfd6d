"""The vehicle's boot clock: bounds by exchanges and stamps, drift, reboots, clocks off their rate."""

from __future__ import annotations

from random import Random

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.session.boot_clock import BootClock
from tests.unit.bridges.mavlink.session.clock_error import error_ns

MS = 1_000_000
BOOT_NS = 1_700_000_000 * NS_PER_S
"""Wall time at which the vehicle booted."""


class Vehicle:
    """A vehicle whose boot clock runs at `rate` of the wall clock."""

    def __init__(self, rate: float = 1.0, boot_ns: int = BOOT_NS) -> None:
        self.rate, self.boot_ns = rate, boot_ns

    def boot_time_ns(self, wall_ns: int) -> int:
        return round((wall_ns - self.boot_ns) * self.rate)

    def exchange(self, clock: BootClock, wall_ns: int, there_ns: int, back_ns: int) -> None:
        clock.exchange(wall_ns, self.boot_time_ns(wall_ns + there_ns), wall_ns + there_ns + back_ns)

    def stamp(self, clock: BootClock, wall_ns: int, delay_ns: int) -> int:
        """Error (ns) of the wall time of a message that is stamped at `wall_ns`."""
        return clock.take(self.boot_time_ns(wall_ns) // MS, wall_ns + delay_ns) - wall_ns


def at(seconds: float) -> int:
    return BOOT_NS + round(seconds * NS_PER_S)


def test_without_exchanges_the_quickest_message_counts():
    clock, vehicle = BootClock(), Vehicle()
    assert vehicle.stamp(clock, at(10.0), 90 * MS) == 90 * MS
    assert vehicle.stamp(clock, at(10.1), 20 * MS) == 20 * MS
    assert vehicle.stamp(clock, at(10.2), 70 * MS) == pytest.approx(20 * MS, abs=MS)
    assert error_ns(clock) is None


def test_an_exchange_bounds_the_offset():
    clock, vehicle = BootClock(), Vehicle()
    vehicle.exchange(clock, at(10.0), 10 * MS, 30 * MS)
    assert error_ns(clock) == 20 * MS
    assert clock.round_trip_ns == 40 * MS
    assert abs(vehicle.stamp(clock, at(10.05), 60 * MS)) <= 20 * MS


def test_bounds_intersect():
    clock, vehicle = BootClock(), Vehicle()
    vehicle.exchange(clock, at(10.0), 2 * MS, 50 * MS)  # low is good
    vehicle.exchange(clock, at(10.1), 50 * MS, 2 * MS)  # high is good
    assert error_ns(clock) is not None
    assert error_ns(clock) <= 2 * MS + 20_000
    assert abs(vehicle.stamp(clock, at(10.2), 60 * MS)) <= 2 * MS


@pytest.mark.parametrize("drift", [-80e-6, 0.0, 80e-6])
def test_drift_is_followed(drift: float):
    clock, vehicle, random = BootClock(), Vehicle(1.0 + drift), Random(1)
    worst = 0
    for k in range(600 * 5):
        wall = at(10.0 + 0.2 * k)
        if k % 5 == 0:
            vehicle.exchange(clock, wall, random.randrange(2, 40) * MS, random.randrange(2, 40) * MS)
        error = vehicle.stamp(clock, wall, random.randrange(3, 60) * MS)
        if k > 100:
            worst = max(worst, abs(error))
            assert error_ns(clock) is not None
            assert abs(error) <= error_ns(clock) + MS  # stamps are cut to ms
    assert worst < 8 * MS
    assert clock.note == ""


@pytest.mark.parametrize("rate", [0.7, 0.93, 1.05])
def test_a_clock_that_does_not_keep_time(rate: float):
    clock, vehicle = BootClock(), Vehicle(rate)
    worst = 0
    for k in range(20 * 25):
        wall = at(10.0 + 0.04 * k)
        if k % 25 == 0:
            vehicle.exchange(clock, wall, 2 * MS, 3 * MS)
        error = abs(vehicle.stamp(clock, wall, 5 * MS))
        worst = max(worst, error) if k > 100 else 0
    assert worst < 12 * MS  # without the rate: 300 ms at 0.7
    assert clock.rate == pytest.approx(rate, abs=0.005)
    assert clock.note == f"its clock runs at {rate:.2f} of ours"


def test_reboot_by_a_stamp():
    clock, first = BootClock(), Vehicle()
    first.exchange(clock, at(100.0), 2 * MS, 2 * MS)
    first.stamp(clock, at(100.0), 5 * MS)
    second = Vehicle(boot_ns=at(101.0))
    assert second.stamp(clock, at(103.0), 5 * MS) == 5 * MS
    assert clock.reboots == 1
    assert error_ns(clock) is None
    second.stamp(clock, at(103.1), 5 * MS)
    second.exchange(clock, at(103.2), 2 * MS, 2 * MS)
    assert clock.reboots == 1
    assert abs(second.stamp(clock, at(103.3), 9 * MS)) <= 3 * MS


def test_reboot_by_an_exchange():
    clock = BootClock()
    Vehicle().stamp(clock, at(100.0), 5 * MS)
    Vehicle(boot_ns=at(101.0)).exchange(clock, at(103.0), 2 * MS, 2 * MS)
    assert clock.reboots == 1
    assert error_ns(clock) == 2 * MS


def test_messages_out_of_order_are_no_reboot():
    clock, vehicle = BootClock(), Vehicle()
    for seconds in (100.0, 99.8, 99.2, 100.1):
        vehicle.stamp(clock, at(seconds), 5 * MS)
    assert clock.reboots == 0


def test_the_stamp_wraps_every_49_days():
    clock, vehicle = BootClock(), Vehicle()
    for k in range(1, 12):
        wall = BOOT_NS + k * 2**32 * MS * 3 // 10
        stamp = vehicle.boot_time_ns(wall) // MS % 2**32
        assert clock.take(stamp, wall + 5 * MS) - wall == pytest.approx(5 * MS, abs=MS)
    assert clock.reboots == 0


@pytest.mark.parametrize("step_s", [0.5, 3600.0, -0.5, -7200.0])
def test_own_clock_is_set(step_s: float):
    clock, vehicle = BootClock(), Vehicle()
    for k in range(20):
        if k == 10:
            vehicle.boot_ns += round(step_s * NS_PER_S)
        wall = at(100.0 + k) + vehicle.boot_ns - BOOT_NS
        vehicle.exchange(clock, wall, 2 * MS, 4 * MS)
        error = vehicle.stamp(clock, wall + MS, 9 * MS)
        if k not in (10, 11):
            assert abs(error) <= 5 * MS, k
            assert clock.note == ""
    assert clock.reboots == 0


def test_an_answer_before_its_question_is_not_taken():
    clock = BootClock()
    clock.exchange(at(10.0), 10 * NS_PER_S, at(9.0))
    assert clock.round_trip_ns is None


def test_a_time_is_never_after_its_arrival():
    clock, vehicle = BootClock(), Vehicle()
    vehicle.exchange(clock, at(10.0), 0, 100 * MS)
    for k in range(50):
        assert vehicle.stamp(clock, at(10.0 + 0.04 * k), 2 * MS) <= 2 * MS
