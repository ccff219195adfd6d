"""Who lags behind its place."""

from __future__ import annotations

from handfast.deploy.drive.lagging import PATIENCE_S, Lagging

ALLOWED_M = 0.25


def looked(*distances: float, every_s: float = 1.0) -> list[list[int]]:
    """Who lags at each look at one robot, 7."""
    lagging = Lagging()
    return [lagging.look(k * every_s, {7: each}, ALLOWED_M) for k, each in enumerate(distances)]


def test_who_stands_off_its_place_lags_after_a_while() -> None:
    assert looked(1.0, 1.0, 1.0, 1.0, 1.0) == [[], [], [], [], [7]]
    assert PATIENCE_S == 3.0
    assert looked(0.2, 0.2, 0.2, 0.2, 0.2) == [[]] * 5


def test_who_comes_nearer_does_not() -> None:
    assert looked(*(10.0 * 0.85**k for k in range(20))) == [[]] * 20
    assert looked(10.0, 9.9, 9.8, 9.7, 9.6)[-1] == [7], "at that rate it takes for ever"
    assert looked(1.0, 1.0, 1.0, 0.8, 0.8, 0.8) == [[]] * 6


def test_who_falls_further_behind_does() -> None:
    assert looked(1.0, 2.0, 3.0, 4.0, 5.0)[-1] == [7]


def test_it_is_over_when_it_is_there_or_does_not_drive() -> None:
    lagging = Lagging()
    for k in range(5):
        lagging.look(float(k), {1: 1.0, 2: 2.0}, ALLOWED_M)
    assert lagging.look(5.0, {1: 1.0, 2: 2.0}, ALLOWED_M) == [2, 1]
    assert lagging.look(6.0, {1: 1.0, 2: 0.1}, ALLOWED_M) == [1]
    assert lagging.look(7.0, {2: 2.0}, ALLOWED_M) == []
    assert lagging.look(8.0, {1: 1.0, 2: 2.0}, ALLOWED_M) == []
