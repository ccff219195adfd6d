"""Whom one that dies would roll at."""

from __future__ import annotations

from math import dist

from deploy.chaos.profiles.encounters import Encounter, encounters


def test_one_that_drives_at_another_rolls_at_it_once_it_is_near_enough():
    found = encounters({1: (0.0, 0.0), 2: (6.0, 0.2)}, {1: (8.0, 0.0), 2: (6.0, 0.2)}, 1.0)
    assert {(each.rolls, each.other) for each in found} == {(1, 2)}
    for each in found:
        assert 0.0 < each.cut_s - each.at_s < 1.2
        assert 1.4 < each.at_s < 5.1, "a second's way before it, and no more than it rolls"
        assert 1.0 < each.apart_m < 4.6


def test_nobody_is_met_whose_way_nobody_crosses():
    assert encounters({1: (0.0, 0.0), 2: (0.0, 4.0)}, {1: (8.0, 0.0), 2: (8.0, 4.0)}, 1.0) == []


def test_of_two_that_change_sides_each_meets_the_other():
    starts = {3: (0.0, 0.0), 7: (7.0, 0.0)}
    found = encounters(starts, {3: starts[7], 7: starts[3]}, 0.9)
    assert {(each.rolls, each.other) for each in found} == {(3, 7), (7, 3)}
    assert all(isinstance(each, Encounter) for each in found)
    assert dist(*starts.values()) == 7.0
