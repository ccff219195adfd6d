"""handfast.agent.fleet.model: what a robot asks of its fleet, and how an error reads."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import FleetError
from tests.unit.agent.fleet.fleet_texts import SMALL, small


def test_what_a_robot_asks() -> None:
    fleet = small("network.base_port=9000", "network.address=robots.example", "fleet.rate_hz=30")
    assert fleet.period_ns == 33_333_333
    assert fleet.robot(7).mass_kg == 9.0
    assert fleet.index(5) == 2
    assert fleet.neighbours(7) == (3, 5), "ascending, whichever end of the edge it is"
    assert fleet.neighbours(5) == (7,)
    assert [fleet.degree(robot) for robot in fleet.ids] == [1, 2, 1]
    assert fleet.agent_endpoint(3) == "tcp/robots.example:9000"
    assert fleet.plant_endpoint(5) == "tcp/robots.example:9005"
    endpoints = {f(robot) for robot in fleet.ids for f in (fleet.agent_endpoint, fleet.plant_endpoint)}
    assert len(endpoints) == 6


@pytest.mark.parametrize(
    "method", ["robot", "index", "neighbours", "degree", "agent_endpoint", "plant_endpoint"]
)
def test_an_unknown_robot_is_a_clear_message(method: str) -> None:
    with pytest.raises(FleetError) as caught:
        getattr(small(), method)(4)
    assert str(caught.value) == "fleet small: there is no robot 4; ids are 3, 7, 5"


def test_an_error_lists_all_its_problems() -> None:
    text = SMALL.replace("safe_distance_m = 0.2", "safe_distance_m = 1.5").replace(
        "mass_kg = 9", "mas_kg = 9"
    )
    with pytest.raises(FleetError) as caught:
        parse_fleet(text, source="small.toml", overrides=["control.c1=-1"], law="best")
    assert str(caught.value) == (
        "small.toml: 4 problems\n"
        '  --law: must be one of paper, edge, joint, penalty, or a plugin, got "best": no plugin has the '
        'name "best"; no entry point is in handfast.laws\n'
        "  --set control.c1: must be more than 0 and at most 10000 1/s2, got -1\n"
        "  robot[2].mas_kg: unknown field; did you mean mass_kg? (the robot with id 7)\n"
        "  formation.distance_m: 1.0 is too small: r_s must be below every distance, "
        "and safe_distance_m is 1.5"
    )
    assert caught.value.source == "small.toml"
    assert len(caught.value.problems) == 4
