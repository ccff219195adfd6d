"""handfast.deploy.check.loop: when check says that a formation may fold, and what it says would be
right."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.deploy.check.loop import check_stiffness, stiffness
from tests.unit.deploy.synthetic_run import make_fleet

PLACES = ((0.0, -1.1547), (0.5, -0.2887), (-0.5, -0.2887), (1.0, 0.5774), (0.0, 0.5774), (-1.0, 0.5774))
EDGES = ((1, 2), (1, 3), (2, 3), (2, 4), (2, 5), (3, 5), (3, 6), (4, 5), (5, 6))


def delta(distance_m: float = 1.0, **control: Any) -> Fleet:
    fleet = make_fleet([(distance_m * x, distance_m * y) for x, y in PLACES], list(EDGES))
    return replace(
        fleet,
        formation=replace(fleet.formation, safe_distance_m=0.22 * distance_m),
        control=replace(fleet.control, **{"kp": 1.0, "k2": None} | control),
    )


def said(fleet: Fleet) -> str:
    found = list(check_stiffness(fleet, resolve(fleet)))
    assert all((each.level, each.place) == ("warning", "control.kp") for each in found)
    return found[0].message if found else ""


@pytest.mark.parametrize("distance_m", [0.3, 0.5, 1.0, 3.0, 10.0, 100.0])
def test_gains_that_are_left_out_suit_every_scale(distance_m: float) -> None:
    fleet = delta(distance_m)
    assert said(fleet) == ""
    assert stiffness(fleet, resolve(fleet)) == pytest.approx([0.625] * 9, rel=1e-3)


def test_a_k2_for_edges_of_1_m_is_dangerous_for_shorter_ones() -> None:
    assert said(delta(1.0, k2=5.0)) == ""
    message = said(delta(0.5, k2=5.0))
    assert "of 0.5 m" in message
    assert "36.3% of random starts" in message
    assert "leave control.k2 = 5 out" in message


@pytest.mark.parametrize("changes", [{"kp": 3.0}, {"kp": 3.0, "k2": 4.0}, {"k2": 1.0}, {"c1": 0.1}])
def test_what_it_says_would_be_right_is(changes: dict[str, float]) -> None:
    fleet = delta(1.0, **changes)
    remedy = re.search(r"take (\S+) or less", said(fleet))
    assert remedy is not None
    assert said(replace(fleet, control=replace(fleet.control, kp=float(remedy[1])))) == ""


def test_slow_robots_and_fast_formations_pull_less() -> None:
    fleet = delta(1.0, k2=6.0, max_speed_mps=0.3)
    assert said(fleet)
    assert not said(replace(fleet, avoidance=replace(fleet.avoidance, enabled=False)))
    line = replace(fleet.trajectory, kind="line", velocity_mps=(1.4, 0.0))
    assert said(replace(delta(), trajectory=line))


def test_assigned_places_bear_more() -> None:
    fleet = delta(1.0, kp=4.0)
    assert said(fleet)
    assert not said(replace(fleet, formation=replace(fleet.formation, assign=True)))


def test_a_yardstick_and_robots_without_edges_have_nothing_to_say() -> None:
    assert not said(delta(0.5, coupling="penalty", k2=5.0))
    assert not said(make_fleet([(0.0, 0.0)], []))
