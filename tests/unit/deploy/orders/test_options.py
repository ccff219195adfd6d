"""Orders as they are written on the command line."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from handfast.deploy.console.arguments import InputError
from handfast.deploy.orders.options import order_of_options, shape_tables
from tests.unit.deploy.orders.order_fleets import after, first_plan, order, square

FLEET = square()
PLAN = first_plan(FLEET)
IDS = FLEET.ids


def reshape(*overrides: str, file: str | None = None, **given: str) -> Any:
    tables = shape_tables(PLAN, overrides, None if file is None else tomllib.loads(file), "other.toml")
    return order_of_options("reshape", given, IDS, tables)


def test_join_takes_lists_and_times_as_a_person_writes_them() -> None:
    given = {"robot": "7", "edges": "2,3", "distance_m": "1.5", "offset_m": "-1, 0.5", "over_s": "5s"}
    assert order_of_options("join", given, IDS) == order(
        "join", robot=7, edges=(2, 3), distance_m=1.5, offset_m=(-1.0, 0.5), over_s=5.0
    )
    one = order_of_options("join", {"robot": "7", "edges": "2", "distance_m": "80cm"}, IDS)
    assert (one.edges, one.distance_m) == ((2,), 0.8)
    each = order_of_options("join", {"robot": "7", "edges": "[2,3]", "distance_m": "1,1.2"}, IDS)
    assert (each.edges, each.distance_m) == ((2, 3), (1.0, 1.2))


def test_leave_and_replace() -> None:
    assert order_of_options("leave", {"robot": "4"}, IDS) == order("leave", robot=4)
    assert order_of_options("replace", {"robot": "3", "by": "7"}, IDS) == order("replace", robot=3, by=7)


def test_remove_takes_one_robot_or_many() -> None:
    assert order_of_options("remove", {"robots": "4"}, IDS) == order("remove", robots=(4,))
    assert order_of_options("remove", {"robots": "4,7"}, IDS) == order("remove", robots=(4, 7))


@pytest.mark.parametrize(
    ("kind", "given", "says"),
    [
        ("remove", {"robots": "9"}, "--robot[1]: there is no robot 9; ids are 1, 2, 3, 4, 7, 8"),
        ("remove", {"robots": "4,4"}, "--robot[2]: robot 4 is given twice"),
        ("remove", {"robots": "x"}, "--robot"),
        ("leave", {"robot": "9"}, "--robot: there is no robot 9; ids are 1, 2, 3, 4, 7, 8"),
        ("leave", {"robot": "x"}, '--robot: must be a whole number, such as 7, got "x"'),
        ("join", {"robot": "7", "edges": "2,2"}, "--edges[2]: robot 2 is given twice"),
        ("replace", {"robot": "3", "by": "3"}, "--by: 3 is the robot that it is to replace"),
        ("leave", {"robot": "4", "over_s": "5 m"}, "--over: must be a number (s) or a string"),
    ],
)
def test_what_is_wrong_is_named_by_its_option(kind: str, given: dict[str, str], says: str) -> None:
    with pytest.raises(InputError) as caught:
        order_of_options(kind, given, IDS)
    assert str(caught.value).startswith(says)


def test_reshape_by_settings() -> None:
    made = reshape("formation.distance_m=1.5", scale="2", over_s="3")
    assert (made.formation.distance_m, made.scale, made.over_s) == (1.5, 2.0, 3.0)
    assert made.trajectory is None


def test_a_line_with_another_velocity_begins_where_the_formation_is() -> None:
    made = reshape("trajectory.velocity_mps=[0.0,0.5]")
    assert (made.trajectory.kind, made.trajectory.velocity_mps) == ("line", (0.0, 0.5))
    mission, plan = after(made, PLAN, FLEET, 10.0)
    middle_ns = mission.from_ns + mission.blend_ns // 2
    assert plan.reference(middle_ns)[:2] == pytest.approx(PLAN.reference(middle_ns)[:2])


def test_another_kind_takes_nothing_of_the_old_one() -> None:
    assert reshape('trajectory.kind="hold"').trajectory.kind == "hold"
    with pytest.raises(InputError, match=r"trajectory\.radius_m: is missing"):
        reshape("trajectory.kind=circle", "trajectory.centre_m=[0,0]")
    with pytest.raises(InputError, match=r"trajectory\.velocity_mps: is used by"):
        reshape("trajectory.kind=hold", "trajectory.velocity_mps=[1,0]")
    with pytest.raises(InputError, match=r"trajectory\.kind: must be one of"):
        reshape("trajectory.kind=spiral")


def test_reshape_by_a_file() -> None:
    text = """
[fleet]
name = "another"
[formation]
offsets = [[0, 0], [2, 0], [2, 2], [0, 2]]
edges = [[1, 2], [2, 3]]
safe_distance_m = 0.3
[trajectory]
kind = "circle"
centre_m = [1, 1]
radius_m = 3.0
speed_mps = 0.3
"""
    made = reshape(file=text)
    assert made.formation.offsets == ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
    assert made.formation.edges == ((1, 2), (2, 3))
    assert made.trajectory.kind == "circle"
    other = reshape("trajectory.radius_m=5.0", "formation.distance_m=2.5", file=text)
    assert (other.trajectory.radius_m, other.formation.distance_m) == (5.0, 2.5)
    assert reshape("trajectory.kind=hold", file=text).trajectory.kind == "hold"
    with pytest.raises(InputError, match=r"other\.toml: has neither \[formation\] nor \[trajectory\]"):
        reshape(file='[fleet]\nname = "x"\n')


def test_only_formation_and_trajectory_can_be_set() -> None:
    with pytest.raises(InputError, match=r"--set control\.kp: reshape takes formation\.offsets"):
        reshape("control.kp=2")
    with pytest.raises(InputError, match=r"--set formation\.distanse_m: unknown field; did you mean"):
        reshape("formation.distanse_m=2")
