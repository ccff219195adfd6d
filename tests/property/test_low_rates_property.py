"""Whatever `handfast check` lets pass stays bounded, at any rate and for any body: whole fleets, driven."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import cos, dist, exp, log, sin
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.check.check import check
from handfast.deploy.sweep import run

TICKS = 160
SHAPES: Mapping[int, tuple[list[list[float]], list[list[int]]]] = {
    1: ([[0.0, 0.0]], []),
    2: ([[-0.5, 0.0], [0.5, 0.0]], [[1, 2]]),
    3: ([[0.0, 0.577], [-0.5, -0.289], [0.5, -0.289]], [[1, 2], [2, 3], [1, 3]]),
}
FLEET = """
fleet = {{ name = "drawn", rate_hz = {rate}, duration_s = {duration} }}
formation = {{ edges = {edges}, offsets = {places}, safe_distance_m = {safe} }}
control = {{ {control}, {waits} }}
trajectory = {{ kind = "line", velocity_mps = [{speed}, 0.0] }}
robot_defaults = {{ hand_offset_m = {reach}, mass_kg = {mass}, inertia_kgm2 = {inertia} }}
robot = [{robots}]
"""


def drawn(seed: int, low_hz: float = 1.0, high_hz: float = 100.0) -> Fleet:
    """A few robots from starts all over the place: any rate, body and limits, some gains."""
    dice = Random(seed)

    def scale(low: float, high: float) -> float:
        return exp(dice.uniform(log(low), log(high)))

    rate, reach, distance = scale(low_hz, high_hz), scale(0.05, 2.0), scale(0.5, 8.0)
    shape, edges = SHAPES[dice.choice([1, 2, 2, 3])]
    safe, most = distance * dice.uniform(0.1, 0.5), scale(0.3, 4.0)
    control = f"max_acceleration = {scale(0.3, 10.0)}, max_speed_mps = {most}"
    if dice.random() < 0.3:
        control += f", kp = {dice.choice([0.3, 2.0, 4.0])}, kd = {dice.choice([1.0, 3.0, 6.0])}"
    if dice.random() < 0.2:
        control += f", c1 = {dice.choice([0.1, 1.0, 3.0])}, c2 = {dice.choice([0.3, 1.5, 4.0])}"
    wide = dice.uniform(1.0, 3.0) * distance + 2.0 * reach
    hands: list[tuple[float, float]] = []
    robots: list[str] = []
    while len(robots) < len(shape):
        x, y, heading = (dice.uniform(-each, each) for each in (wide, wide, 3.1))
        hand = x + reach * cos(heading), y + reach * sin(heading)
        if all(dist(hand, other) > 1.2 * safe + 0.1 for other in hands):
            hands.append(hand)
            robots.append(f"{{ id = {len(hands)}, x_m = {x}, y_m = {y}, heading_rad = {heading} }}")
    wait = max(0.2, 2.4 / rate)
    text = FLEET.format(
        rate=rate,
        duration=TICKS / rate,
        edges=edges,
        places=[[distance * x, distance * y] for x, y in shape],
        safe=safe,
        control=control,
        waits=f"plant_timeout_s = {wait}, wrench_timeout_s = {wait}, prediction_horizon_s = {10.0 * wait}",
        speed=most * dice.uniform(0.0, 0.7),
        reach=reach,
        mass=scale(2.0, 60.0),
        inertia=scale(0.02, 20.0),
        robots=", ".join(robots),
    )
    return parse_fleet(text, source="drawn.toml")


def fastest(fleet: Fleet) -> float:
    """Largest speed of a hand in a drive, as a share of the limit; inf where a body was driven to bits."""
    recording = run.drive(resolved(fleet))
    a = analyse(recording, resolve(recording.fleet))
    steps = np.diff(a.hands, axis=0)
    speeds = np.hypot(steps[..., 0], steps[..., 1]) / np.diff(a.grid)[:, None]
    return float(np.nanmax(speeds)) / fleet.control.max_speed_mps


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.sampled_from([4.0, 12.0, 100.0]))
@settings(max_examples=25, deadline=None)
def test_what_check_lets_pass_stays_bounded(seed: int, high_hz: float) -> None:
    fleet = drawn(seed, 1.0, high_hz)
    if not any(finding.level == "error" for finding in check(fleet)):
        assert fastest(fleet) < 1.25


RATE3 = """
fleet = { name = "rate3_cross", rate_hz = 2, duration_s = 60 }
formation = { edges = [[1, 2]], safe_distance_m = 0.6, offsets = [[0.0, 4.0], [0.0, -4.0]] }
control = { plant_timeout_s = 1.2, wrench_timeout_s = 1.2, prediction_horizon_s = 4.0 }
robot_defaults = { hand_offset_m = 1.6, inertia_kgm2 = 10.0 }
robot = [
    { id = 1, x_m = 0.0, y_m = -3.9, heading_rad = 1.57 },
    { id = 2, x_m = 0.05, y_m = 4.1, heading_rad = -1.57 },
]
"""


@pytest.mark.slow
def test_a_fleet_at_2_hz_with_a_long_hand_crosses_calmly() -> None:
    fleet = parse_fleet(RATE3, source="rate3.toml")
    assert "error" not in {finding.level for finding in check(fleet)}
    assert fastest(fleet) < 1.01


@pytest.mark.parametrize(("c2", "grows"), [(1.8, False), (2.2, True)])
def test_a_gain_of_one_in_a_period_is_the_limit_of_the_sampled_loop(c2: float, grows: bool) -> None:
    """(P2) sees the middle of its period as the last force would have it: a body at 2 Hz, straight on."""
    fleet = parse_fleet(RATE3, source="rate3.toml")
    alone = replace(
        fleet,
        formation=replace(fleet.formation, edges=(), offsets=((0.0, 0.0),)),
        robots=(replace(fleet.robots[0], x_m=0.0, y_m=-1.6 - 0.2),),
        avoidance=replace(fleet.avoidance, enabled=False),
        control=replace(fleet.control, c1=0.05, c2=c2),
    )
    places = {each.place for each in check(alone) if each.level == "error"}
    assert ("fleet.rate_hz" in places) == grows
    recording = run.drive(resolved(alone))
    a = analyse(recording, resolve(recording.fleet))
    assert a.hands[0, 0, 1] == pytest.approx(-0.2, abs=1e-3)
    assert (abs(a.hands[-1, 0, 1]) > 0.2) == grows
