"""The simulated rover's own fence: it stops before it and stays in GUIDED, or goes into its failsafe."""

from __future__ import annotations

from math import hypot, pi
from typing import Any

import pytest

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.navigation import Fence
from tests.unit.bridges.mavlink.rover_bench import Bench, ready

FENCED = {"FENCE_ENABLE": 1.0, "FENCE_RADIUS": 10.0, "FENCE_ACTION": 2.0}


def driven(seconds: float = 40.0, **parameters: float) -> Bench:
    bench = ready(parameters={**FENCED, **parameters})
    bench.run(seconds, lambda: bench.drive(0.8))
    return bench


def held_back(bench: Bench) -> int:
    bench.command(constants.CMD_REQUEST_MESSAGE, constants.MESSAGE_FENCE_STATUS)
    return int(bench.last("FENCE_STATUS").breach_mitigation)


def test_it_stops_before_its_fence_and_stays_in_guided() -> None:
    bench = driven()
    rover = bench.rover
    assert (rover.mode, rover.armed) == ("GUIDED", True)
    assert rover.speed == pytest.approx(0.0, abs=0.05)
    assert 7.5 < hypot(rover.north, rover.east) < 8.5, "FENCE_MARGIN, 2 m, before it"
    bench.drive(0.8)
    assert held_back(bench) == constants.MITIGATE_SPEED
    bench.run(5.0, lambda: bench.drive(-0.5))
    assert hypot(rover.north, rover.east) < 7.0, "the way back is free"
    assert held_back(bench) == constants.MITIGATE_NONE


def test_without_avoidance_the_fence_acts() -> None:
    bench = driven(AVOID_ENABLE=0.0)
    assert bench.rover.mode == "HOLD"
    assert hypot(bench.rover.north, bench.rover.east) > 9.9
    assert bench.command(constants.CMD_REQUEST_MESSAGE, constants.MESSAGE_FENCE_STATUS) == 0
    assert bench.last("FENCE_STATUS").breach_status == 1


@pytest.mark.parametrize("off", [{"FENCE_ENABLE": 0.0}, {"FENCE_ACTION": 0.0, "AVOID_ENABLE": 2.0}])
def test_without_a_fence_it_drives_on(off: dict[str, float]) -> None:
    bench = driven(**off)
    assert bench.rover.mode == "GUIDED"
    assert hypot(bench.rover.north, bench.rover.east) > 20.0


def test_a_vehicle_without_a_fence_says_nothing_of_it() -> None:
    bench = driven(1.0, FENCE_ENABLE=0.0)
    assert bench.command(constants.CMD_REQUEST_MESSAGE, constants.MESSAGE_FENCE_STATUS) == 0
    assert bench.of("FENCE_STATUS") == []


@pytest.mark.parametrize(
    ("speed", "yaw", "place", "left"),
    [
        (1.0, 0.0, (0.0, 0.0), 1.0),
        (1.0, 0.0, (8.0, 0.0), 0.0),
        (-1.0, 0.0, (8.0, 0.0), -1.0),
        (-1.0, pi, (8.0, 0.0), 0.0),
        (1.0, pi / 2, (0.0, 7.5), (2 * 0.5 * 0.5) ** 0.5),
        (-1.0, -pi / 2, (0.0, 7.5), -((2 * 0.5 * 0.5) ** 0.5)),
        (0.0, 0.0, (9.0, 0.0), 0.0),
    ],
)
def test_the_speed_that_is_left(speed: float, yaw: float, place: tuple[float, float], left: float) -> None:
    fence = Fence()
    values: Any = {**FENCED, "AVOID_ENABLE": 3.0, "FENCE_MARGIN": 2.0, "ATC_ACCEL_MAX": 1.0}
    assert fence.slowed(values, speed, yaw, place, 1) == pytest.approx(left)
    assert fence.limits(1) is (abs(left - speed) > 1e-9)
    assert not fence.limits(600_000_001)
