"""Lists of robots in words, and what is said of many robots in one."""

from __future__ import annotations

from handfast.deploy.console.wording import grouped, robots, some


def test_names_of_robots_read_as_text() -> None:
    assert robots([3]) == "robot 3"
    assert robots([1, 2, 5]) == "robots 1, 2 and 5"
    assert robots(range(1, 9)) == "robots 1, 2, 3, 4, 5, 6, 7 and 8"
    assert robots(range(1, 13)) == "12 robots (1-12)"


def test_many_are_counted_and_those_that_follow_each_other_are_one_range() -> None:
    ids = [*range(13), 17, 19, 20, *range(22, 31)]
    assert robots(ids) == "25 robots (0-12, 17, 19, 20, 22-30)"
    assert some(range(2, 101, 3)) == "2, 5, 8, 11, 14, 17, 20, 23 and 25 more"
    assert some([*range(10), *range(20, 101, 2)], 3) == "0-9, 20, 22 and 39 more"
    assert some([5, 4, 3, 2, 1, 9, 8, 7, 6]) == "5, 4, 3, 2, 1, 9, 8, 7 and 1 more", "the order is kept"
    assert some(["pi1", "pi2"] * 5) == "pi1, pi2, pi1, pi2, pi1, pi2, pi1, pi2 and 2 more"


def test_many_texts_that_differ_in_numbers_alone_say_from_which_to_which() -> None:
    said = [(f"robot {robot} is late by {0.9 + robot / 10:.2g} s of 8 s", robot) for robot in range(1, 5)]
    assert grouped([*said, ("late by -3 s", 5)]) == [
        ("robots 1, 2, 3 and 4 is late by 1 to 1.3 s of 8 s", [1, 2, 3, 4]),
        ("late by -3 s", [5]),
    ]
    said = [(f"the machine of robot {k % 3} and {k} more runs late", k) for k in range(1, 10)]
    assert grouped(said) == [
        ("the machine of robots 0, 1 and 2 and 1 to 9 more runs late", [1, 2, 3, 4, 5, 6, 7, 8, 9])
    ]
    several = [("without robot 4", 1), ("without robots 4 and 5", 2), ("without robot 6", 3)]
    assert grouped([*several, ("without robots 7, 8 and 9", 4)]) == [
        ("without robots 4, 5, 6, 7, 8 and 9", [1, 2, 3, 4])
    ]
