"""[[order]] of a fleet file: what is wrong with it is said where it is."""

from __future__ import annotations

import pytest

from handfast.agent.common.settings import entries
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import FleetError
from handfast.agent.fleet.orders import ORDER_FIELDS, OrderSection
from handfast.agent.fleet.sections import TrajectorySection
from tests.unit.deploy.orders.order_fleets import SQUARE, square


def problems(*orders: str) -> list[str]:
    text = SQUARE + "".join(f"\n[[order]]\nat = {k}\n{order}\n" for k, order in enumerate(orders, 1))
    with pytest.raises(FleetError) as caught:
        parse_fleet(text, source="x.toml")
    return [str(problem) for problem in caught.value.problems]


def test_good_orders_are_read():
    text = (
        SQUARE
        + """
[[order]]
at = "20s"
kind = "reshape"
formation = { offsets = [[0, 0], [2, 0], [2, 2], [0, 2]] }
trajectory = { kind = "line", velocity_mps = [0.1, 0.0] }

[[order]]
at = 10
kind = "join"
robot = 7
edges = [2, 3]
distance_m = [1.0, 1.5]

[[order]]
at = 30
kind = "stop"

[[order]]
at = 40
kind = "resume"
"""
    )
    reshape, join, stop, resume = square(text=text).orders
    assert (reshape.at, reshape.trajectory) == (20.0, TrajectorySection("line", velocity_mps=(0.1, 0.0)))
    assert reshape.formation is not None
    assert reshape.formation.offsets == ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
    assert (join.robot, join.edges, join.distance_m) == (7, (2, 3), (1.0, 1.5))
    assert (stop.kind, resume.robots) == ("stop", None)


def test_every_field_belongs_to_a_kind():
    used = {name for needed, taken in ORDER_FIELDS.values() for name in (*needed, *taken)}
    assert used | {"at", "kind"} == set(entries(OrderSection))


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ('kind = "leave"', ['order[1].robot: is missing: kind = "leave" needs it, for example robot = 7']),
        (
            'kind = "join"',
            [
                'order[1].robot: is missing: kind = "join" needs it, for example robot = 7',
                'order[1].edges: is missing: kind = "join" needs it, for example edges = [3, 5]',
            ],
        ),
        (
            'kind = "leave"\nrobot = 1\nedges = [2]\nby = 3',
            [
                'order[1].by: is used by kind = "replace" only, but here kind = "leave": leave it out',
                'order[1].edges: is used by kind = "join" only, but here kind = "leave": leave it out',
            ],
        ),
        (
            'kind = "replace"\nrobot = 1\nby = 9',
            ["order[1].by: there is no robot 9; ids are 1, 2, 3, 4, 7, 8"],
        ),
        ('kind = "replace"\nrobot = 1\nby = 1', ["order[1].by: 1 is the robot that it is to replace"]),
        (
            'kind = "join"\nrobot = 7\nedges = [2, 9]',
            ["order[1].edges[2]: there is no robot 9; ids are 1, 2, 3, 4, 7, 8"],
        ),
        (
            'kind = "join"\nrobot = 7\nedges = [2, 2, 7]\ndistance_m = [1.0]',
            [
                "order[1].edges[2]: robot 2 is given twice",
                "order[1].edges[3]: robot 7 cannot share an edge with itself",
                "order[1].distance_m: must be one number or one per edge, got 1 for 3 edges",
            ],
        ),
        (
            'kind = "reshape"\nover_s = 3',
            ['order[1]: changes nothing: kind = "reshape" takes formation, trajectory or scale'],
        ),
        (
            'kind = "reshape"\nformation = {}',
            ["order[1].formation: gives nothing: write offsets, edges or distance_m"],
        ),
        (
            'kind = "reshape"\nformation = { edges = [[1, 1], [1, 2], [2, 1], [1, 9]], distance_m = [1.0] }',
            [
                "order[1].formation.edges[4]: there is no robot 9; ids are 1, 2, 3, 4, 7, 8",
                "order[1].formation.edges[1]: [1, 1] joins robot 1 to itself",
                "order[1].formation.edges[3]: [2, 1] is given twice",
                "order[1].formation.distance_m: must be one number or one per edge, got 1 for 4 edges",
            ],
        ),
        (
            'kind = "reshape"\ntrajectory = { kind = "line", speed_mps = 1.0 }',
            [
                'order[1].trajectory.velocity_mps: is missing: kind = "line" needs it, for example '
                "velocity_mps = [0.2, 0.2]",
                'order[1].trajectory.speed_mps: is used by kind = "circle" and kind = "waypoints" only, but '
                'here kind = "line": leave it out',
            ],
        ),
        (
            'kind = "resume"\nrobots = [1, 5]',
            ["order[1].robots[2]: there is no robot 5; ids are 1, 2, 3, 4, 7, 8"],
        ),
        (
            'kind = "remove"',
            ['order[1].robots: is missing: kind = "remove" needs it, for example robots = [1, 2]'],
        ),
        ('kind = "remove"\nrobots = []', ["order[1].robots: names no robot: write for example robots = [7]"]),
        (
            'kind = "remove"\nrobots = [4, 9, 4]\nrobot = 1',
            [
                'order[1].robot: is used by kind = "join" and kind = "leave" and kind = "replace" only, but '
                'here kind = "remove": leave it out',
                "order[1].robots[2]: there is no robot 9; ids are 1, 2, 3, 4, 7, 8",
                "order[1].robots[3]: robot 4 is given twice",
            ],
        ),
        (
            'kind = "hop"',
            [
                'order[1].kind: must be one of "join", "leave", "replace", "remove", "reshape", "stop", '
                '"resume", got "hop"'
            ],
        ),
        ('kind = "leave"\nrobot = "one"', ['order[1].robot: must be a whole number, such as 7, got "one"']),
    ],
)
def test_what_is_wrong_is_said_where_it_is(order: str, said: list[str]):
    assert problems(order) == said


def test_the_second_order_is_the_second():
    assert problems('kind = "stop"', 'kind = "leave"')[0].startswith("order[2].robot: is missing")
