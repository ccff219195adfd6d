"""Simulates the sensors of a body: their noise, and the sensor faults of the rules (PURE)."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Final

from handfast.agent.common import random_streams
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.fault_rules import SENSOR_FIELDS
from handfast.agent.fleet.sections import Robot
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.timed_rules import SensorFaults

_NONE: Final = SensorFaults()
JUMP_SHARE: Final = 0.01
"""Share of measurements that a rule's `jump_m` strikes."""


class Measurement:
    """The sensors of one robot: measured = pose + bias + noise, and now and then a jump or nothing.

    Noise is normal. That of the body and that of a fault are independent: their variances add. Each draw is a
    function of the seed, the robot, the quantity and the sequence number of the plant's state.

    Args:
        seed: of every draw.
        body: with its own noise: m, rad, m/s, rad/s.
        plan: the rules; they may change.
    """

    def __init__(self, seed: int, body: Robot, plan: FaultPlan) -> None:
        self._robot = body.id
        self._plan = plan
        self._changes = -1
        self._noise = (
            body.position_noise_m, body.position_noise_m, body.heading_noise_rad, body.speed_noise_mps,
            body.yaw_rate_noise_radps,
        )  # fmt: skip
        self._streams = [
            random_streams.stream(seed, "plant", body.id, quantity)
            for quantity in ("x", "y", "heading", "speed", "yaw rate")
        ]
        self._jump, self._direction = (
            random_streams.stream(seed, "plant", body.id, purpose) for purpose in ("jump", "direction")
        )
        self._ruled = False

    @property
    def exact(self) -> bool:
        """Whether no measurement differs from the pose: no noise, and no sensor rule at any time."""
        if self._changes != self._plan.changes:
            self._changes = self._plan.changes
            rules = self._plan.rules()
            self._ruled = any(
                rule.given(SENSOR_FIELDS) and (rule.robots is None or self._robot in rule.robots)
                for rule in rules
            )
        return not (self._ruled or any(self._noise))

    def measured(self, pose: Pose, time_ns: int, sequence: int) -> Pose | None:
        """The pose (W) as measured, None for a dropout.

        Args:
            pose: the true one (W) at `time_ns`, as the backend has it.
            time_ns: ns of the wall clock: which rules hold.
            sequence: number of the plant's state that will carry it.
        """
        if self.exact:
            return pose
        faults = (self._plan.sensor(self._robot, time_ns) if self._ruled else None) or _NONE
        bias_x, bias_y = faults.position_bias_m
        if faults.jump_m and random_streams.uniform(self._jump, sequence) < JUMP_SHARE:
            angle = 2.0 * pi * random_streams.uniform(self._direction, sequence)
            bias_x, bias_y = bias_x + faults.jump_m * cos(angle), bias_y + faults.jump_m * sin(angle)
        biases = bias_x, bias_y, faults.heading_bias_rad, 0.0, 0.0
        measured = []
        for value, bias, deviation, stream in zip(pose, biases, self._noise, self._streams, strict=True):
            error = deviation * random_streams.normal(stream, sequence) if deviation else 0.0
            measured.append(value + bias + error)
        return Pose._make(measured)
