"""The bridge as a plant: what it tells its agent, how often it speaks, and what it keeps from the log.

Who has the vehicle, and what becomes of it when something fails, is in tests/simulation/test_rovers.py.
"""

from __future__ import annotations

from typing import Any

import pytest

from handfast.bridges.mavlink.ardupilot.frames import datum_of
from handfast.bridges.mavlink.bridge.backend import BRAKE_NS_MAX, session
from handfast.plant.backend import Command
from tests.rover_scene import MASS, Scene, rovers

GO = Command(MASS * 0.3, 0.0)


def test_before_anything_is_heard_it_says_so() -> None:
    scene = Scene()
    scene.bridge.port.cut = True
    scene.run(1.0)
    reading = scene.bridge.reading
    assert (reading.healthy, reading.obeying, reading.note) == (False, False, "no heartbeat of a vehicle yet")
    assert list(scene.bridge.blocking) == ["link"]


def test_trouble_with_the_connection_comes_first() -> None:
    scene = Scene()
    scene.drive()
    refused = scene.bridge.port.trouble = "cannot open tcp:1.2.3.4:5760: connection refused"
    scene.tick()
    assert scene.bridge.reading.note == f"waiting for it: {refused}"
    assert not scene.bridge.reading.healthy
    assert scene.bridge.log[-1] == f"waiting for it: {refused}"
    scene.bridge.port.transient = False  # as of a port that another program has
    scene.tick()
    assert scene.bridge.reading.note == refused


def test_it_says_what_its_vehicle_goes_on_by_when_it_is_gone() -> None:
    """What it asked for last: a speed that is more than the vehicle has by now; then to stand."""
    scene = Scene()
    scene.drive(0.1)
    scene.bridge.command = GO
    scene.tick()
    reading = scene.bridge.reading
    assert reading.asked is not None
    assert reading.asked[0] > reading.pose.speed + 0.04
    scene.bridge.command = None
    scene.tick()
    assert scene.bridge.reading.asked == (0.0, 0.0)
    scene.rover.set_mode("MANUAL")
    scene.run(0.2)
    assert scene.bridge.reading.asked is None


def test_while_it_drives_the_agent_is_told_of_the_reference_else_of_what_is_measured() -> None:
    """Force and torque are those that act on the reference, so that a law that integrates them is right."""
    scene = Scene()
    scene.drive(0.3)
    scene.bridge.command = GO
    scene.tick()
    before = scene.bridge.reading
    scene.tick()
    reading = scene.bridge.reading
    assert (reading.force, reading.torque) == (GO.force, GO.torque)
    gained = reading.pose.speed - before.pose.speed
    assert gained == pytest.approx(0.3 * 0.05, abs=1e-9)
    scene.rover.set_mode("MANUAL")
    scene.run(0.2)
    reading = scene.bridge.reading
    assert (reading.force, reading.torque) == (0.0, 0.0)
    assert reading.pose.speed == pytest.approx(scene.rover.speed, abs=0.08)


@pytest.mark.parametrize(("rate_hz", "least", "most"), [(20, 19, 21), (100, 45, 50)])
def test_setpoints_go_out_at_every_tick_but_no_faster_than_the_vehicle_can_use(
    rate_hz: int, least: int, most: int
) -> None:
    scene = Scene(f"fleet.rate_hz={rate_hz}")
    scene.drive(0.2)
    since_ns = scene.now_ns
    scene.run(1.0)
    assert least <= len(scene.bridge.setpoints(since_ns + 1)) <= most


def test_braking_ends_though_the_vehicle_seems_to_move(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    scene.drive(0.3)
    truth = scene.rover._vehicle.truth
    step = truth.step

    def rolls(*arguments: Any, **named: Any) -> None:
        step(*arguments, **named)
        truth.speed = 0.12  # down a slope

    monkeypatch.setattr(truth, "step", rolls)
    scene.bridge.command = None
    since_ns = scene.now_ns
    scene.run(6.0)
    sent = scene.bridge.setpoints(since_ns + 1)
    assert {speed for _, speed, _ in sent} == {0.0}
    assert 0.9 * BRAKE_NS_MAX < sent[-1][0] - since_ns < 1.1 * BRAKE_NS_MAX


@pytest.mark.parametrize(("parameter", "value"), [("WP_SPEED", 0.3), ("ATC_STR_RAT_MAX", 15.0)])
def test_the_vehicles_own_limits_hold_as_well(parameter: str, value: float) -> None:
    scene = Scene(parameters={parameter: value})
    scene.until(lambda: scene.bridge.link.parameters_done)
    scene.bridge.clear_to_drive()
    scene.bridge.command = Command(MASS * 5.0, 5.0)
    scene.run(4.0)
    sent = scene.bridge.setpoints()
    if parameter == "WP_SPEED":
        assert max(speed for _, speed, _ in sent) == pytest.approx(value)
    else:
        assert max(rate for _, _, rate in sent) == pytest.approx(0.2618, abs=1e-3)


def test_who_has_it_is_in_the_log_when_it_changes() -> None:
    scene = Scene()
    scene.drive()
    scene.rover.set_mode("HOLD")
    scene.run(2.0)
    scene.rover.set_mode("GUIDED")
    scene.run(1.0)
    waits = scene.bridge.reading.note
    scene.bridge.clear_to_drive()
    scene.run(0.2)
    told = [line for line in scene.bridge.log if not line.startswith("the vehicle says")]
    assert told == [
        "waiting for other bridges to be heard, if there are any",
        "armed and in GUIDED: it obeys",
        "its operator has it: mode HOLD, not GUIDED",
        waits,
        "told to resume",
        "armed and in GUIDED: it obeys",
    ]


def test_the_session_is_that_of_the_fleet_file() -> None:
    link = session(
        rovers(
            "robot.1.mavlink.system=7",
        ),
        1,
        None,
        5,
    )
    assert link.own == (7, 191)
    settings = link.settings
    assert (settings.system, settings.token) == (7, 5)
    assert settings.datum == datum_of(rovers())
