"""The law in time: what a controller is given by the fleet file."""

from __future__ import annotations

from math import cos, sin, tau

import pytest

from agent.controller import Controller
from agent.fleet import load_fleet, parse_fleet
from agent.formation import resolve
from agent.hand import Pose, advance, hand
from agent.messages import NEIGHBOURS_MAX, HandState, PlantState
from deploy.arguments import fleet_path

S = 1_000_000_000
T0 = 1000 * S


@pytest.mark.parametrize("prediction", [True, False])
def test_prediction_is_as_the_fleet_file_has_it(prediction: bool):
    fleet = load_fleet(fleet_path("delta"), [f"control.prediction={str(prediction).lower()}"])
    controller = Controller(fleet, resolve(fleet), 1)
    controller.look(T0)
    assert controller.edges
    for _, peer in controller.edges:
        state = HandState(peer.robot, 0, T0, True, 2, 1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, (), ())
        assert controller.peers.accept(state, T0 + fleet.period_ns) is None
        shown = controller.peers.predict(peer, T0 + S)
        assert (shown.position == (1.0, 2.0)) is not prediction


@pytest.mark.parametrize(("rate_hz", "timeout_s"), [(50, 0.2), (50, 1.0), (1000, 0.2)])
def test_as_many_wrenches_are_remembered_as_the_oldest_plant_state_needs(rate_hz: int, timeout_s: float):
    """A sensor's link may be as late as `plant_timeout_s`: all that was sent since has acted on the body."""
    fleet = load_fleet(
        fleet_path("delta"), [f"fleet.rate_hz={rate_hz}", f"control.plant_timeout_s={timeout_s}"]
    )
    controller, body = Controller(fleet, resolve(fleet), 1), fleet.robot(1)
    period_ns = fleet.period_ns
    age_ns = round(timeout_s * S)
    now_ns = T0 + period_ns // 2 + age_ns // period_ns * period_ns - period_ns
    for tick_ns in range(T0 - 10 * period_ns + period_ns // 2, now_ns, period_ns):
        controller.sent(tick_ns, 2.0 if tick_ns > T0 else 0.0, 0.0)
    state = PlantState(1, 0, T0, 0.0, 0.0, 0.3, 0.1, 0.0, 0.0, 0.0, True, True, True, "")
    pushed_s = (now_ns - T0 - period_ns) / S  # the wrench of T0's round acts from the next on
    pose = advance(Pose(0.0, 0.0, 0.3, 0.1, 0.0), 0.0, 0.0, body.mass_kg, body.inertia_kgm2, period_ns / S)
    pose = advance(pose, 2.0, 0.0, body.mass_kg, body.inertia_kgm2, pushed_s)
    assert tuple(controller.hand_at(state, now_ns)) == pytest.approx(
        tuple(hand(pose, body.hand_offset_m)), abs=1e-9
    )


def test_no_more_multipliers_are_told_than_a_message_holds():
    """All at once: as many edges as there may be, none fully trusted, and all too near."""
    others = range(2, NEIGHBOURS_MAX + 2)
    rows = ", ".join(f"{{ id = {k}, x_m = {k}, y_m = 0 }}" for k in (1, *others))
    places = [[round(3 * cos(tau * k / 64), 3), round(3 * sin(tau * k / 64), 3)] for k in others]
    text = f"""
    robot = [{rows}]
    fleet = {{ name = "star" }}
    avoidance = {{ distance_m = 1.0 }}
    formation = {{ edges = {[[1, k] for k in others]}, offsets = {[[0, 0], *places]}, safe_distance_m = 0.2 }}
    """
    fleet = parse_fleet(text, source="here")
    controller = Controller(fleet, resolve(fleet), 1)
    controller.look(T0)
    for edge, peer in controller.edges:
        x, y = 0.5 * cos(edge.other), 0.5 * sin(edge.other)
        state = HandState(peer.robot, 0, T0, True, 2, x, y, *[0.0] * 6, (), ())
        assert controller.peers.accept(state, T0 + fleet.period_ns) is None
        peer.trust = 0.5
    plant = PlantState(1, 0, T0, *[0.0] * 7, True, True, True, "")
    controller.drive(plant, T0 + fleet.period_ns)
    assert len(controller.multipliers()) <= NEIGHBOURS_MAX
