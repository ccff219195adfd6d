from __future__ import annotations

import pytest

from deploy.chaos.dice import Dice


def test_the_same_key_is_the_same_stream_and_another_is_another() -> None:
    first, again, other = Dice("a", 1), Dice("a", 1), Dice("a", 2)
    drawn = [first.share() for _ in range(5)]
    assert drawn == [again.share() for _ in range(5)]
    assert drawn != [other.share() for _ in range(5)]
    # Known numbers: those of every machine and version.
    assert [Dice("a", 1).whole(0, 10**6), Dice("b").whole(0, 10**6)] == [315_958, 762_105]


def test_numbers_lie_within_their_bounds_and_reach_them() -> None:
    dice = Dice("bounds")
    whole = [dice.whole(2, 4) for _ in range(200)]
    assert set(whole) == {2, 3, 4}
    between = [dice.between(-1.0, 1.0, 1) for _ in range(500)]
    assert min(between) == -1.0
    assert max(between) == 1.0
    assert all(round(value, 1) == value for value in between)
    assert sum(dice.chance(0.25) for _ in range(4000)) == pytest.approx(1000, abs=100)


def test_choices_are_of_what_is_given() -> None:
    dice = Dice("choices")
    assert {dice.pick("abc") for _ in range(100)} == set("abc")
    drawn = [dice.weighted((("often", 3.0), ("rarely", 1.0), ("never", 0.0))) for _ in range(4000)]
    assert drawn.count("often") == pytest.approx(3000, abs=120)
    assert "never" not in drawn
    for count in range(6):
        some = dice.some([1, 2, 3, 4], count)
        assert len(some) == min(count, 4)
        assert some == sorted(set(some))
