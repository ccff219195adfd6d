"""How long an operator waits, by what the fleet is made of."""

from __future__ import annotations

from handfast.deploy.drive.timing import Timing


def test_a_fleet_may_take_longer_the_larger_it_is_and_vehicles_as_long_as_they_do() -> None:
    timing = Timing(ready_s=10.0, ready_per_process_s=0.5, vehicles_ready_s=120.0)
    assert timing.ready_timeout_s(4, has_vehicles=False) == 12.0
    assert timing.ready_timeout_s(4, has_vehicles=True) == 120.0
    assert timing.ready_timeout_s(400, has_vehicles=True) == 210.0


def test_who_ends_with_the_run_may_take_less_time_to_stand_but_a_vehicle_may_not() -> None:
    timing = Timing(stop_s=2.0, interrupt_stop_s=0.3, vehicles_stop_s=4.0)
    for is_hurried, stands_s in ((False, 2.0), (True, 0.3)):
        assert timing.standstill_timeout_s(has_vehicles=False, is_hurried=is_hurried) == stands_s
        assert timing.standstill_timeout_s(has_vehicles=True, is_hurried=is_hurried) == 4.0


def test_on_its_own_machine_a_mission_begins_sooner_the_fewer_have_to_hear_of_it() -> None:
    few, many = Timing.of_own_machine(12, 0), Timing.of_own_machine(200, 0)
    assert few.epoch_ahead_ns < Timing().epoch_ahead_ns < many.epoch_ahead_ns
    assert Timing.of_own_machine(200, 9_000_000_000).epoch_ahead_ns == 9_000_000_000, "all have listened"
    assert few.stopped_ahead_ns == Timing().stopped_ahead_ns
