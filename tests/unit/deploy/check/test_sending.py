"""handfast.deploy.check.sending: what check says of hand states that are sent at events."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.check.check import check
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.sending import check_sending

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0.2 }]
fleet = { name = "two" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0]], safe_distance_m = 0.2 }
"""
EVENT = 'control.send="event"'


def fleet(*overrides: str) -> Fleet:
    return parse_fleet(FLEET, source="here", overrides=overrides)


def found(*overrides: str) -> list[Finding]:
    return list(check_sending(fleet(*overrides)))


@pytest.mark.parametrize("overrides", [(), (EVENT,), (EVENT, "robot_defaults.position_noise_m=0.001")])
def test_what_suits_is_not_mentioned(overrides: tuple[str, ...]) -> None:
    assert found(*overrides) == []


@pytest.mark.parametrize(
    ("overrides", "level", "place", "words"),
    [
        (("control.send_every_s=0.5",), "info", "control.send_every_s", 'control.send is "periodic"'),
        ((EVENT, "control.send_every_s=0.02"), "warning", "control.send_every_s", "in every period"),
        (
            (EVENT, "fleet.rate_hz=10", "control.prediction_horizon_s=0.3"),
            "warning",
            "control.send_every_s",
            "prediction_horizon_s",
        ),
        ((EVENT, "control.prediction=false"), "warning", "control.prediction", "in which it moves"),
        ((EVENT, "control.send_bound_m=0.03"), "warning", "control.send_bound_m", "margin_m = 0.05"),
        (
            (EVENT, "robot_defaults.position_noise_m=0.004"),
            "warning",
            "control.send_bound_m",
            "0.02 m or more",
        ),
    ],
)
def test_what_does_not_suit_is_named(overrides: tuple[str, ...], level: str, place: str, words: str) -> None:
    said = {(each.level, each.place): each.message for each in found(*overrides)}
    assert words in said[level, place]


def test_what_noise_asks_for_quiets_it() -> None:
    noise = "robot_defaults.position_noise_m=0.004"
    assert found(EVENT, noise, "control.send_bound_m=0.0201") == []


def test_a_law_of_others_cannot_be_predicted() -> None:
    made = fleet(EVENT)
    control: Any = replace(made.control, law="somebody:Law")
    said = [each.message for each in check_sending(replace(made, control=control))]
    assert any("nobody can predict" in each for each in said)


def test_check_asks() -> None:
    assert any(each.place == "control.prediction" for each in check(fleet(EVENT, "control.prediction=false")))


@pytest.mark.parametrize(
    ("every", "words"),
    [("0.01", "at least one period, 0.02 s"), ("1.1", "at most half of control.prediction")],
)
def test_an_interval_that_contradicts_the_rest_is_refused(every: str, words: str) -> None:
    with pytest.raises(FleetError, match=words):
        fleet(EVENT, f"control.send_every_s={every}")
