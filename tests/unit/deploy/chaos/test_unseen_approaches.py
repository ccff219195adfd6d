"""Who came too near to a vehicle whose bridge is dead, of which no recording tells."""

from __future__ import annotations

from typing import cast

import pytest

from agent.control.hand import Pose
from agent.fleet.loading import parse_fleet
from deploy.chaos.unseen_approaches import UnseenApproaches
from deploy.simulate.simulation import Simulation

FLEET = parse_fleet(
    """
robot = [{ id = 4, x_m = 0, y_m = 0, hand_offset_m = 0.1 }, { id = 7, x_m = 5, y_m = 5, hand_offset_m = 0.1 }]
fleet = { name = "two" }
formation = { edges = [[4, 7]], offsets = [[0, 0], [3, 0]], safe_distance_m = 1.0 }
""",
    source="here",
)


class World:
    """Robot 4 drives along x to where robot 7 stands, at 3 m; `dead`: processes that do not run."""

    epoch_ns = 0

    def __init__(self, *dead: tuple[int, str]) -> None:
        self.dead, self.now_ns = dead, 0

    def runs(self, robot: int, role: str) -> bool:
        return (robot, role) not in self.dead

    def poses(self) -> list[Pose]:
        return [Pose(self.now_ns / 1e9, 0.0, 0.0, 1.0, 0.0), Pose(3.0, 0.0, 0.0, 0.0, 0.0)]


def found(world: World, *seconds: float) -> list[str]:
    unseen = UnseenApproaches(FLEET)
    for second in seconds:
        world.now_ns = round(second * 1e9)
        unseen.look(cast(Simulation, world))
    assert all(each.oracle == "separation" for each in unseen.violations())
    return [each.message for each in unseen.violations()]


def test_the_closest_is_told_of_one_that_nobody_commands_and_one_that_could_have_made_way():
    (said,) = found(World((4, "plant")), 1.5, 2.5, 2.25)
    assert said == (
        "Robots 4 and 7 truly came within 0.500 m of each other at 2.50 s, while nothing commanded robot 4; "
        "the safe distance is 1.000 m."
    )


@pytest.mark.parametrize(
    "dead",
    [(), ((4, "plant"), (7, "plant")), ((4, "plant"), (7, "agent"))],
    ids=["seen", "both", "nobody to steer"],
)
def test_of_others_nothing_is_told(dead: tuple[tuple[int, str], ...]) -> None:
    assert found(World(*dead), 1.5, 2.5) == []


def test_two_that_begin_too_near_count_once_they_have_been_apart():
    assert found(World((4, "plant")), 2.25, 2.5) == []
    assert len(found(World((4, "plant")), 2.25, 0.0, 2.5)) == 1
