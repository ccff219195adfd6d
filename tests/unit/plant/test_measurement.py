"""What a plant's sensors get wrong: the noise of the body and the sensor faults of the rules."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from scipy import stats

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.points import Floats
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.messages.types import Faults
from handfast.plant.node import JUMP_SHARE, Measurement

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0%s }, { id = 2, x_m = 2, y_m = 0%s }]
fleet = { name = "two", seed = %d }
formation = { edges = [[1, 2]], distance_m = 1.0, safe_distance_m = 0.2 }
faults = { rule = [%s] }
"""
NOISY = ", position_noise_m = 0.01, heading_noise_rad = 0.02"
DEVIATIONS = np.array([0.01, 0.01, 0.02])
POSE = Pose(1.0, -2.0, 0.5, 0.3, -0.1)
COUNT = 5000


def fleet(body: str = "", rules: str = "", seed: int = 1) -> Fleet:
    return parse_fleet(FLEET % (body, body, seed, rules), source="here")


def sensors(made: Fleet, robot: int = 1) -> tuple[Measurement, FaultPlan]:
    plan = FaultPlan(made)
    return Measurement(made.fleet.seed, made.robot(robot), plan), plan


def errors(made: Fleet, robot: int = 1, count: int = COUNT) -> Floats:
    """Measured minus true pose, (count, 5)."""
    measurement, _ = sensors(made, robot)
    rows = []
    for sequence in range(count):
        told = measurement.measured(POSE, 0, sequence)
        assert told is not None
        rows.append(np.subtract(told, POSE))
    return np.array(rows)


# ---------------------------------------------------------------------- noise


def test_noise_has_its_deviations_and_no_bias():
    found = errors(fleet(NOISY))[:, :3]
    assert found.std(axis=0) == pytest.approx(DEVIATIONS, rel=0.04)
    assert np.all(np.abs(found.mean(axis=0)) < 4.0 * DEVIATIONS / np.sqrt(COUNT))
    for column, deviation in zip(found.T, DEVIATIONS, strict=True):
        assert stats.kstest(column / deviation, "norm").pvalue > 1e-3


def test_a_draw_depends_on_the_seed_and_the_number_alone():
    made = fleet(NOISY)
    measurement, _ = sensors(made)
    backwards = [measurement.measured(POSE, 5 * k, k) for k in reversed(range(50))]
    assert np.array_equal(np.subtract(backwards[::-1], POSE), errors(made, count=50))
    assert not np.array_equal(errors(made, count=50), errors(fleet(NOISY, seed=2), count=50))


# ---------------------------------------------------------------------- biases, jumps


def test_jumps_are_of_their_length_and_share_in_every_direction():
    found = errors(fleet("", "{ jump_m = 0.5 }"), count=4 * COUNT)
    assert np.all(found[:, 2:] == 0.0)
    lengths = np.hypot(found[:, 0], found[:, 1])
    jumped = lengths > 0.0
    assert lengths[jumped] == pytest.approx(0.5)
    low, high = stats.binom.interval(0.999, 4 * COUNT, JUMP_SHARE)
    assert low <= jumped.sum() <= high
    angles = np.arctan2(found[jumped, 1], found[jumped, 0])
    assert stats.kstest((angles + pi) / (2 * pi), "uniform").pvalue > 1e-3
    # One jump tells nothing of the next measurement.
    assert abs(np.corrcoef(jumped[:-1], jumped[1:])[0, 1]) < 4.5 / np.sqrt(4 * COUNT)


# ---------------------------------------------------------------------- when it is exact


def test_without_noise_and_rules_the_pose_is_told_as_it_is():
    measurement, _ = sensors(fleet())
    assert measurement.exact
    assert measurement.measured(POSE, 0, 0) is POSE


def test_a_rule_acts_while_it_holds_and_on_its_robots():
    made = fleet("", "{ robot = 1, at = 1, for = 2, heading_bias_rad = 0.5 }")
    for robot, wanted in ((1, [0.5, 1.0, 1.0, 0.5]), (2, [0.5] * 4)):
        measurement, plan = sensors(made, robot)
        plan.begin(NS_PER_S)
        told = [measurement.measured(POSE, time_s * NS_PER_S, 0) for time_s in (1, 2, 3, 4)]
        assert [pose.heading for pose in told] == wanted
        assert measurement.exact == (robot == 2)


def test_live_rules_count_from_when_they_come_until_they_go():
    measurement, plan = sensors(fleet())
    assert measurement.exact
    text = "[[faults.rule]]\nrobot = 1\nheading_bias_rad = 0.5"
    assert plan.take(Faults(1, 0, "ana@lab:1", 0, NS_PER_S, text), 0) is None
    assert not measurement.exact
    assert measurement.measured(POSE, 5, 0) == POSE._replace(heading=1.0)
    assert plan.expire(NS_PER_S)
    assert measurement.exact
    assert measurement.measured(POSE, NS_PER_S, 0) == POSE
