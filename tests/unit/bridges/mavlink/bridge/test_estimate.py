"""The rover's pose at a tick, from samples that are older, late, jumping or missing."""

from __future__ import annotations

from math import cos, inf, nan, radians, sin

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.bridges.mavlink.ardupilot.dynamics import DEFAULTS, RoverDynamics
from handfast.bridges.mavlink.bridge.estimate import JUMP_M, STALE_S, Estimate, Prediction

MS = 1_000_000
T0 = 1_700_000_000 * NS_PER_S


def at(seconds: float) -> int:
    return T0 + round(seconds * NS_PER_S)


class Driven:
    """A rover under commands of 25 Hz, told to an estimate late and at different instants."""

    def __init__(self, start: Pose, ages_ms: tuple[int, int] = (90, 60), tick_ms: int = 40) -> None:
        self.rover = RoverDynamics(start.x, start.y, start.heading)
        self.estimate = Estimate()
        self.now_ns = T0
        self._tick_ms = tick_ms
        self._ages_ms = ages_ms
        self._past: list[Pose] = []

    @property
    def pose(self) -> Pose:
        rover = self.rover
        return Pose(rover.north, rover.east, rover.yaw, rover.speed, rover.yaw_rate)

    def tick(self, speed: float, yaw_rate: float, *, told: bool = True) -> Pose:
        """One tick; the command is told to the estimate, or is somebody else's. Returns the error."""
        self.estimate.command(self.now_ns, *((speed, yaw_rate) if told else (0.0, 0.0)))
        for _ in range(self._tick_ms):
            self.rover.step(0.001, speed, yaw_rate)
            self._past.append(self.pose)
        self.now_ns += self._tick_ms * MS
        position, attitude = (self._past[max(0, len(self._past) - 1 - age)] for age in self._ages_ms)
        if len(self._past) > max(self._ages_ms):
            self.estimate.position(
                self.now_ns - self._ages_ms[0] * MS, position.x, position.y, position.speed
            )
            self.estimate.attitude(self.now_ns - self._ages_ms[1] * MS, attitude.heading, attitude.yaw_rate)
        found = self.estimate.pose_at(self.now_ns).pose
        truth = self.pose
        return Pose(*(a - b for a, b in zip(found, truth, strict=True)))


def test_a_heading_of_another_instant_than_the_position():
    """The position is carried by the heading it had, not by the newest."""
    speed, yaw_rate = 1.0, 1.0
    estimate = Estimate()
    estimate.position(at(0.0), 0.0, 0.0, speed)
    estimate.attitude(at(0.1), 0.1, yaw_rate)
    found = estimate.pose_at(at(0.1)).pose
    assert (found.x, found.y) == pytest.approx((sin(0.1), 1.0 - cos(0.1)), abs=2e-4)


def test_a_known_command_is_seen_before_it_is_measured():
    driven = Driven(Pose(1.0, -2.0, 0.7, 0.0, 0.0))
    for _ in range(10):
        driven.tick(0.0, 0.0)
    worst = [0.0] * 5
    for k in range(200):
        speed, yaw_rate = (0.5, 0.4) if k % 50 < 25 else (-0.3, -0.2)
        worst = [max(w, abs(e)) for w, e in zip(worst, driven.tick(speed, yaw_rate), strict=True)]
    assert worst[0] < 0.002
    assert worst[1] < 0.002
    assert worst[2] < 0.005
    assert worst[3] < 0.02
    assert worst[4] < 0.05


def test_somebody_elses_commands_are_measured_all_the_same():
    driven = Driven(Pose(0.0, 0.0, 0.0, 0.0, 0.0))
    for _ in range(10):
        driven.tick(0.0, 0.0, told=False)
    errors = [driven.tick(1.0, 0.5, told=False) for _ in range(100)]
    assert driven.estimate.pose_at(driven.now_ns).healthy
    assert max(abs(error.x) for error in errors) < 0.02
    assert max(abs(error.heading) for error in errors[10:]) < 0.02


def test_surprise_is_not_lag():
    driven = Driven(Pose(0.0, 0.0, 0.0, 0.0, 0.0))
    for _ in range(50):
        driven.tick(0.8, 0.5)
        assert abs(driven.estimate.residual.speed) < 0.02
        assert abs(driven.estimate.residual.yaw_rate) < 0.03


def test_surprise_is_what_a_stuck_rover_lacks():
    estimate = Estimate()
    for k in range(100):
        now = at(0.04 * k)
        estimate.position(now - 60 * MS, 0.0, 0.0, 0.0)
        estimate.attitude(now - 60 * MS, 0.0, 0.0)
        estimate.pose_at(now)
        estimate.command(now, 0.5, 0.3)
    assert estimate.residual == pytest.approx((-0.5, -0.3), abs=0.03)
    assert estimate.pose_at(at(4.0)).pose.speed == pytest.approx(0.0, abs=0.03)


def filled(seconds: float = 1.0) -> Estimate:
    """At rest in the origin for a while."""
    estimate = Estimate()
    for k in range(round(25 * seconds) + 1):
        estimate.position(at(0.04 * k), 0.0, 0.0, 0.0)
        estimate.attitude(at(0.04 * k), 0.0, 0.0)
    return estimate


@pytest.mark.parametrize(
    ("name", "attitude", "position"), [("position", True, False), ("attitude", False, True)]
)
def test_stale(name: str, attitude: bool, position: bool):
    estimate = filled()
    for k in range(26, 38):
        if attitude:
            estimate.attitude(at(0.04 * k), 0.0, 0.0)
        if position:
            estimate.position(at(0.04 * k), 0.0, 0.0, 0.0)
    assert estimate.pose_at(at(1.0 + STALE_S)).healthy
    found = estimate.pose_at(at(1.0 + STALE_S + 0.05))
    assert not found.healthy
    assert found.note.startswith(f"its {name} is 0.")
    assert found.note.endswith("s old")


def test_a_jump_of_the_position():
    estimate = filled()
    estimate.position(at(1.04), JUMP_M - 0.1, 0.0, 0.0)
    assert estimate.pose_at(at(1.04)).healthy
    estimate.position(at(1.08), JUMP_M + 0.9, 0.0, 0.0)
    found = estimate.pose_at(at(1.08))
    assert (found.healthy, found.note) == (False, "its position jumped by 1.00 m")
    for k in range(28, 60):
        now = at(0.04 * k)
        estimate.position(now, JUMP_M + 0.9, 0.0, 0.0)
        estimate.attitude(now, 0.0, 0.0)
        assert estimate.pose_at(now).healthy == (now >= at(1.08) + NS_PER_S)


def test_a_jump_of_the_heading():
    estimate = filled()
    estimate.attitude(at(1.04), radians(-30.0), 0.0)
    found = estimate.pose_at(at(1.04))
    assert (found.healthy, found.note) == (False, "its heading jumped by 30 degrees")


def test_a_gap_forgives_more():
    estimate = filled()
    now = at(3.0)
    estimate.position(now, 1.3, 0.0, 0.0)  # 2 s: up to 1.5 m
    estimate.attitude(now, 0.0, 0.0)
    assert estimate.pose_at(now).healthy


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_what_is_not_a_number_is_not_used(bad: float):
    estimate = filled()
    estimate.position(at(1.04), bad, 0.0, 0.0)
    estimate.attitude(at(1.04), 0.0, bad)
    found = estimate.pose_at(at(1.04))
    assert found.pose == (0.0, 0.0, 0.0, 0.0, 0.0)
    assert (found.healthy, found.note) == (False, "not a number in its attitude and position")
    estimate.position(at(1.08), 0.0, 0.0, 0.0)
    estimate.attitude(at(1.08), 0.0, 0.0)
    assert estimate.pose_at(at(1.08)).healthy


def test_a_clock_set_back_begins_anew():
    estimate = filled(10.0)
    estimate.position(at(5.0), 2.0, 1.0, 0.0)
    estimate.attitude(at(5.0), 1.0, 0.0)
    found = estimate.pose_at(at(5.0))
    assert found.healthy
    assert found.pose == (2.0, 1.0, 1.0, 0.0, 0.0)


def test_prediction_between_its_steps_and_beyond():
    prediction = Prediction()
    assert prediction.at(at(0.0)) == (0.0, 0.0, 0.0, 0.0, 0.0)
    rover = RoverDynamics()
    for k in range(26):
        prediction.command(at(0.04 * k), 0.6, 0.0, DEFAULTS)
    for _ in range(25):
        rover.step(0.04, 0.6, 0.0)
    end = prediction.at(at(1.0))
    assert end == (rover.north, rover.east, rover.yaw, rover.speed, rover.yaw_rate)
    assert prediction.at(at(2.0)) == end
    before, after = prediction.at(at(0.48)), prediction.at(at(0.52))
    assert prediction.at(at(0.50)).x == pytest.approx(0.5 * (before.x + after.x))
    assert prediction.at(at(-1.0)) == prediction.at(at(0.0))
