"""The law in time: what a controller is given by the fleet file."""

from __future__ import annotations

import pytest

from agent.controller import Controller
from agent.fleet import load_fleet
from agent.formation import resolve
from agent.messages import HandState
from deploy.arguments import fleet_path

S = 1_000_000_000
T0 = 1000 * S


@pytest.mark.parametrize("prediction", [True, False])
def test_prediction_is_as_the_fleet_file_has_it(prediction: bool):
    fleet = load_fleet(fleet_path("delta"), [f"control.prediction={str(prediction).lower()}"])
    controller = Controller(fleet, resolve(fleet), 1)
    for robot in controller.neighbours.ids:
        state = HandState(robot, 0, T0, True, 1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, (), ())
        assert controller.neighbours.accept(state, T0 + fleet.period_ns) is None
    shown = controller.neighbours.predict(T0 + S, lambda _: (0.0,) * 6, T0)
    assert all((where.position == (1.0, 2.0)) is not prediction for where in shown)
