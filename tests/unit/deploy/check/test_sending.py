"""handfast.deploy.check.loop: what check says of hand states that are sent at events."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.check.check import check
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.loop import check_sending

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
        ((EVENT, "control.prediction=false"), "warning", "control.prediction", "in which it moves"),
        ((EVENT, "robot_defaults.position_noise_m=0.004"), "warning", "control.send", "measurement noise"),
    ],
)
def test_what_does_not_suit_is_named(overrides: tuple[str, ...], level: str, place: str, words: str) -> None:
    said = {(each.level, each.place): each.message for each in found(*overrides)}
    assert words in said[level, place]


def test_a_law_of_others_cannot_be_predicted() -> None:
    made = fleet(EVENT)
    control: Any = replace(made.control, law="somebody:Law")
    said = [each.message for each in check_sending(replace(made, control=control))]
    assert any("nobody can predict" in each for each in said)


def test_check_asks() -> None:
    assert any(each.place == "control.prediction" for each in check(fleet(EVENT, "control.prediction=false")))
