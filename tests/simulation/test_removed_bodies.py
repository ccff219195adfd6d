"""Whole fleets in virtual time: a dead robot's body is driven round until an operator says it is gone."""

from __future__ import annotations

from math import cos, hypot, sin
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import PlantState
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.sweep import run
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.orders.order_fleets import order

SAFE_M = 0.22
REACH_M = 0.1
DURATION_S = 84.0
FIELD = f"""
[fleet]
name = "field"
rate_hz = 25
duration_s = {DURATION_S}
[formation]
edges = [[1, 2]]
offsets = [[0, 0], [-0.9, 0.9]]
safe_distance_m = {SAFE_M}
[trajectory]
kind = "waypoints"
waypoints_m = [[0, 0], [7, 0], [0, 0], [7, 0], [0, 0]]
speed_mps = 0.35
[[robot]]
id = 1
x_m = 0
y_m = 0
[[robot]]
id = 2
x_m = -0.9
y_m = 0.9
[[robot]]
id = 6
x_m = 3.5
y_m = 0.05
reserve = true
[[faults.rule]]
robot = 6
kill = "agent"
"""
"""Robot 1 goes to and fro over the place in which robot 6 stands, whose agent dies."""
DEAD = "at = 2\nfor = 56\n"
"""From 2 s to 58 s."""
REMOVED = '[[order]]\nat = 21\nkind = "remove"\nrobots = [6]\n'
PASSES = {"first": (2.0, 20.0), "second": (21.0, 40.0), "third": (41.0, 58.0), "back": (62.0, DURATION_S)}
"""Times in which robot 1 goes by, s; in the last one the agent of robot 6 drives again."""


class Field:
    """A drive on the field, and where the bodies were."""

    def __init__(self, *tables: str, dead: str = DEAD) -> None:
        fleet = resolved(parse_fleet("\n".join((FIELD + dead, *tables)), source="here"))
        self.hands: dict[int, list[tuple[int, float, float]]] = {robot: [] for robot in fleet.ids}
        self._keys = {key_expressions.plant_state("field", robot) for robot in fleet.ids}
        self.simulation = Simulation(fleet, self._sink)
        assert self.simulation.start(round(DURATION_S * NS_PER_S))

    def _sink(self, time_ns: int, key: str, payload: bytes) -> None:
        if key in self._keys:
            state = decode(payload)
            assert type(state) is PlantState
            x, y = state.x + REACH_M * cos(state.heading), state.y + REACH_M * sin(state.heading)
            self.hands[state.robot].append((time_ns, x, y))

    def until(self, time_s: float) -> Field:
        self.simulation.run_until(self.simulation.epoch_ns + round(time_s * NS_PER_S))
        return self

    def closest_m(self, times: tuple[float, float]) -> float:
        """How near the hands of robots 1 and 6 came meanwhile; robot 1 must have gone by."""
        start_ns, end_ns = (self.simulation.epoch_ns + round(t * NS_PER_S) for t in times)
        _, x, y = self.hands[6][-1]
        seen = [(x1, y1) for time_ns, x1, y1 in self.hands[1] if start_ns <= time_ns < end_ns]
        assert min(x1 for x1, _ in seen) < x - 0.5 < x + 0.5 < max(x1 for x1, _ in seen)
        return min(hypot(x1 - x, y1 - y) for x1, y1 in seen)

    def given(self, what: str, **fields: Any) -> str:
        """Why an order cannot be given now, "" when it was."""
        try:
            self.simulation.give(order(what, **fields))
        except OrderError as error:
            return str(error)
        return ""


def test_a_dead_body_is_driven_round_as_long_as_nobody_says_that_it_is_gone() -> None:
    field = Field().until(DURATION_S)
    for name, times in PASSES.items():
        assert field.closest_m(times) > SAFE_M, name


@pytest.mark.parametrize(
    "clocks",
    [(), ("clock_skew = -12.0",)],
    ids=["right clocks", "its clock is behind"],
)
def test_its_place_is_free_once_it_is_removed_until_its_agent_is_back(clocks: tuple[str, ...]) -> None:
    """Nobody orders anything when it is back: being heard is enough."""
    wrong = [f"[[faults.rule]]\nrobot = 6\n{clock}\n" for clock in clocks]
    field = Field(*wrong, REMOVED).until(DURATION_S)
    assert field.simulation.reasons == []
    assert field.closest_m(PASSES["first"]) > SAFE_M
    assert field.closest_m(PASSES["second"]) < 0.5 * SAFE_M
    assert field.closest_m(PASSES["third"]) < 0.5 * SAFE_M
    assert field.closest_m(PASSES["back"]) > SAFE_M


def test_who_starts_again_learns_which_bodies_are_gone() -> None:
    again = '[[faults.rule]]\nrobot = 1\nrestart = "agent"\nat = 41\n'
    field = Field(REMOVED, again).until(PASSES["third"][1])
    assert field.closest_m(PASSES["third"]) < 0.5 * SAFE_M


def test_a_run_in_which_a_body_was_removed_passes() -> None:
    """The verdict counts no collision with what had been carried off."""
    fleet = resolved(parse_fleet(FIELD + DEAD + REMOVED, source="here"))
    result = RunResult(run.drive(fleet))
    assert result.reasons == []
    assert result.analysis.closest is not None
    assert result.analysis.closest.distance_m > SAFE_M
