"""How robots' clocks stand to this machine's: no one robot decides, nor what was slow on its way."""

from __future__ import annotations

import pytest

from handfast.deploy.orders.robot_clocks import OFF_NS, RobotClocks

S = 10**9
NOW = 10**18


def clocks(*ahead_s: float) -> RobotClocks:
    made = RobotClocks()
    for robot, each_s in enumerate(ahead_s, 1):
        made.show(robot, NOW, NOW + round(each_s * S))
    return made


def test_without_any_they_are_as_this_machines() -> None:
    none = RobotClocks()
    assert (none.newest(NOW), none.usual(NOW), none.behind_s, none.at(1, NOW)) == (NOW, NOW, 0.0, None)


def test_what_was_the_shortest_on_its_way_counts() -> None:
    made = clocks(5.0)
    made.show(1, NOW + 3 * S, NOW + 7 * S)  # a second longer on its way
    assert made.at(1, NOW + 3 * S) == NOW + 8 * S
    made.show(1, NOW + 3 * S, NOW + 9 * S)
    assert made.at(1, NOW) == NOW + 6 * S


def test_the_newest_is_that_of_the_one_furthest_ahead_and_the_usual_that_of_the_one_in_the_middle() -> None:
    made = clocks(-7200.0, 0.0, 1e6)
    assert made.newest(NOW) == NOW + 10**6 * S
    assert made.usual(NOW) == NOW
    assert clocks(5.0, 1e6).usual(NOW) == NOW + 5 * S, "of two the one behind: the other may lie"


@pytest.mark.parametrize(
    ("ahead_s", "behind_s"),
    [((7200.0, 9000.0), 7200.0), ((7200.0, 0.0), 0.0), ((OFF_NS / S, 9000.0), 0.0), ((-5.0,), 0.0)],
)
def test_this_machines_is_behind_when_it_is_so_to_all(ahead_s: tuple[float, ...], behind_s: float) -> None:
    assert clocks(*ahead_s).behind_s == behind_s
