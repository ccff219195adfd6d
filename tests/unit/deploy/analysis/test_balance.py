"""Formations at rest in another shape than their own."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from handfast.agent.control import law
from handfast.agent.control.gains import gains_of
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.analysis.balance import STILL_S, caught, last_caught_s, rest_shapes
from handfast.deploy.recording.collector import RunData
from tests.unit.deploy.synthetic_run import make_fleet, messages, standing

PAIR = make_fleet([(0.0, 0.0), (2.0, 0.0)], [(1, 2)], duration_s=4.0)


def at_rest(fleet: Fleet, apart_m: float, moving_m: float = 0.0) -> Analysis:
    """The pair on each other's side, so far apart; the first moves so far in the last two seconds."""
    data = RunData(fleet)
    for sent in messages(fleet, [standing(0, 0), standing(1, 0)]):
        data.feed(*sent)
    a = analyse(data.recording(), resolve(fleet))
    hands = np.empty_like(a.hands)
    hands[:, 0] = 1.0 + 0.5 * apart_m, 0.0
    hands[:, 1] = 1.0 - 0.5 * apart_m, 0.0
    late = a.grid >= a.grid[-1] - STILL_S
    hands[late, 0, 1] = np.linspace(0.0, moving_m, late.sum())
    distances = np.hypot(*(hands[:, 0] - hands[:, 1]).T)[:, None]
    off = np.abs(distances - a.wanted) > 0.05 * a.wanted
    return replace(a, hands=hands, distances=distances, off=off & a.counts)


def of_coupling(coupling: Any) -> Fleet:
    return replace(PAIR, control=replace(PAIR.control, coupling=coupling, kp=1.0))


def balanced(fleet: Fleet) -> float:
    """Distance of the two at which the law's own forces are in balance there, m."""
    control = fleet.control
    gains = gains_of(fleet)

    def left(apart_m: float) -> float:
        error = 0.5 * apart_m + 1.0
        acting = law.acting_error((error, 0.0), (0.0, 0.0), control.c1, control.c2, control.max_speed_mps)
        push = -2.0 * control.c1 * acting[0]
        edge = law.edge((apart_m, 0.0), (0.0, 0.0), (push, 0.0), 2.0, fleet.formation.safe_distance_m, gains)
        bodies = {"joint": 2, "edge": 2}.get(control.coupling)
        if bodies is None:
            multiplier = law.multiplier_penalty(edge, gains)
        else:
            multiplier = law.multiplier_edge(edge)
        return 0.5 * push + float(law.force(edge, multiplier)[0])

    return float(brentq(left, 0.25, 1.99))


@pytest.mark.parametrize("coupling", ["joint", "edge", "penalty"])
def test_on_each_others_side_where_forces_are_in_balance(coupling: str) -> None:
    fleet = of_coupling(coupling)
    apart_m = balanced(fleet)
    assert caught(at_rest(fleet, apart_m), fleet)
    assert not caught(at_rest(fleet, apart_m, moving_m=0.2), fleet)
    assert not caught(at_rest(fleet, 1.6 * apart_m), fleet)


def test_in_formation_nothing_is_caught() -> None:
    assert not caught(at_rest(PAIR, 2.0), PAIR)


def test_one_that_leaves_another_shape_was_caught_until_then() -> None:
    """Such a shape may be a saddle: the formation rests there for a while, and then goes on."""
    fleet = of_coupling("joint")
    fleet = replace(fleet, fleet=replace(fleet.fleet, duration_s=12.0))
    a = at_rest(fleet, balanced(fleet))
    assert caught(a, fleet)
    leaving = a.grid > 7.0
    hands = a.hands.copy()
    hands[leaving, 0, 1] += 0.3 * (a.grid[leaving] - 7.0)
    a = replace(a, hands=hands)
    assert not caught(a, fleet)
    assert last_caught_s(a, fleet, 0.0) == pytest.approx(7.2, abs=0.5)
    assert last_caught_s(a, fleet, 6.0) == -inf


def test_the_shapes_at_rest_are_told_apart_by_their_edges() -> None:
    """Robots 1 and 2 have each other's side, robots 3 and 4 are far from their places and move."""
    offsets = [(0.0, 0.0), (2.0, 0.0), (0.0, 50.0), (2.0, 50.0)]
    fleet = make_fleet(offsets, [(1, 2), (3, 4)], duration_s=4.0)
    fleet = replace(fleet, control=replace(fleet.control, coupling="joint", kp=1.0))
    half_m = 0.5 * balanced(of_coupling("joint"))
    data = RunData(fleet)
    for sent in messages(fleet, [standing(*offset) for offset in offsets]):
        data.feed(*sent)
    a = analyse(data.recording(), resolve(fleet))
    hands = a.hands.copy()
    hands[:, 0], hands[:, 1] = (1.0 + half_m, 0.0), (1.0 - half_m, 0.0)
    hands[:, 2, 1] = 50.0 + a.grid
    distances = np.hypot(*np.moveaxis(hands[:, a.edges[:, 0]] - hands[:, a.edges[:, 1]], 2, 0))
    off = a.counts & (np.abs(distances - a.wanted) > 0.05 * a.wanted)
    a = replace(a, hands=hands, distances=distances, off=off)
    assert not caught(a, fleet), "not all that are off are at rest"
    far = np.array([True, True, True, False])
    assert rest_shapes(a, fleet, far) == [[0, 1]]
    assert rest_shapes(replace(a, off=np.zeros_like(off)), fleet, far) == []
