"""What `handfast check` finds in obstacles, geofence and avoidance, and how it describes them."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.safety import Paths, check_safety, parting

# Three robots in a row from west to east, 1 m apart, 0.1 m ahead of their axles; they drive east.
ROW = """
[fleet]
name = "row"
duration_s = 20
[formation]
edges = [[3, 7], [7, 5]]
offsets = [[-1, 0], [0, 0], [1, 0]]
safe_distance_m = 0.2
[trajectory]
kind = "line"
velocity_mps = [0.5, 0.0]
[[robot]]
id = 3
x_m = -1.1
y_m = 0
[[robot]]
id = 7
x_m = -0.1
y_m = 0
[[robot]]
id = 5
x_m = 0.9
y_m = 0
"""
FENCE = "[geofence]\npoints_m = [[-2, -2], [{east}, -2], [{east}, 2], [-2, 2]]\n"


def circle(x: float, y: float, radius: float, name: str = "tree") -> str:
    return f"[[obstacle]]\nname = '{name}'\ncentre_m = [{x}, {y}]\nradius_m = {radius}\n"


def fleet(extra: str = "", *overrides: str) -> Fleet:
    return parse_fleet(ROW + extra, source="row.toml", overrides=overrides)


def found(extra: str = "", *overrides: str) -> list[Finding]:
    one = fleet(extra, *overrides)
    return list(check_safety(one, resolve(one)))


def said(extra: str = "", *overrides: str) -> list[str]:
    return [str(finding) for finding in found(extra, *overrides)]


def test_a_fleet_with_room_has_nothing_to_be_said() -> None:
    assert found() == []
    assert found(circle(5.0, 1.0, 0.5) + FENCE.format(east=12)) == []


# --- starts ---


def test_starts_inside_an_obstacle_or_too_near_to_it() -> None:
    inside = (
        "error: robot[1]: robot 3 starts with its hand point inside tree: move or turn the robot, or move"
    )
    near = (
        "warning: robot[2]: robots 7 and 5 start with their hand points nearer to tree than the clearance of "
    )
    assert said(circle(-1.0, 0.0, 0.05), "trajectory.velocity_mps=[-0.5, 0]")[0].startswith(inside)
    between = said(circle(0.5, 0.0, 0.45), "trajectory.velocity_mps=[0, 1]")
    assert between[0] == near + "0.1 m: driving away from it comes first"


def test_starts_outside_the_fence_or_within_its_band() -> None:
    outside, near = said(FENCE.format(east=0.7))[0], said(FENCE.format(east=1.4))[0]
    assert outside.startswith(
        "error: robot[3]: robot 5 starts with its hand point outside the geofence, where"
    )
    assert near.startswith(
        "warning: robot[3]: robot 5 starts with its hand point nearer to the geofence than"
    )


# --- ways ---


def test_a_way_through_an_obstacle_is_a_warning_that_says_who_and_when() -> None:
    (only,) = found(circle(5.0, 0.0, 0.3))
    assert (only.level, only.place) == ("warning", "obstacle[1]")
    # Robot 5 is to be 0.4 m before its centre, 0.3 m and the clearance, after 3.6 m.
    assert only.message.startswith(
        "the way of robots 3, 7 and 5 (first 5, at 7.2 s) leads through tree or within 0.1 m of it: the law"
    )
    (other,) = found(circle(5.0, 0.0, 0.3), "avoidance.enabled=false")[1:]
    assert "they would hit it" in other.message


def test_without_avoidance_obstacles_do_nothing() -> None:
    first = found(circle(5.0, 3.0, 0.3) + circle(8.0, 3.0, 0.3, "post"), "avoidance.enabled=false")[0]
    assert (first.level, first.place) == ("warning", "avoidance.enabled")
    assert "keeps the robots away from tree, post;" in first.message


def test_nothing_thin_is_missed() -> None:
    wire = "[[obstacle]]\nname = 'wire'\npoints_m = [[{x}, -1], [{x}, 1], [{y}, 1], [{y}, -1]]\n"
    thin = wire.format(x=4321.0, y=4321.002)
    one = fleet(thin, "fleet.duration_s=10000", "avoidance.clearance_m=0.01")
    (only,) = check_safety(one, resolve(one))
    assert "leads through wire" in only.message
    ways = Paths(one, resolve(one))
    post = Circle("post", 4321.0, 0.0, 0.005)  # 1 cm of 5 km
    assert [robot for robot, _ in ways.below(post, 0.01)] == [3, 7, 5]
    times = dict(ways.below(post, 0.01))
    assert times[5] == pytest.approx(2.0 * (4320.0 - 0.015), abs=0.03)
    (last,) = Paths(fleet(), resolve(fleet())).below(Circle("last", 12.0, 0.0, 0.5), 0.503)
    assert last == (5, pytest.approx(20.0, abs=0.01))  # in the last 3 mm
    assert ways.below(Circle("beside", 4321.0, 1.0, 0.5), 0.45) == []


def test_places_at_rest_in_an_obstacle_can_never_be_taken() -> None:
    (only,) = found(circle(1.0, 0.3, 0.25), "trajectory.kind=hold")[1:]
    assert only.level == "warning"
    assert (
        "comes to rest with the places of robot 5 in tree or within 0.1 m of it: nobody can" in only.message
    )
    assert "--set" not in only.message


def test_a_way_out_of_the_fence_is_an_error_and_within_its_band_a_warning() -> None:
    (outside,) = found(FENCE.format(east=9.5))
    assert (outside.level, outside.place) == ("error", "geofence.points_m")
    assert "the way of robots 7 and 5 (first 5, at 17 s)" in outside.message
    (near,) = found(FENCE.format(east=11.3))
    assert (near.level, near.place) == ("warning", "geofence.points_m")
    assert "the way of robot 5 (at 19.6 s)" in near.message


# --- distances ---


def test_a_distance_of_avoidance_above_what_the_formation_has() -> None:
    (only,) = found("[avoidance]\ndistance_m = 2.1\n")
    assert (only.level, only.place) == ("warning", "avoidance.distance_m")
    assert "at least 2 m: such robots, as 3 and 5, push each other" in only.message
    assert "take at most 1.8 m" in only.message
    assert found("[avoidance]\ndistance_m = 2.0\n") == []
    assert found("[avoidance]\ndistance_m = 2.1\nenabled = false\n") == []


def test_the_distance_of_avoidance_of_a_formation() -> None:
    one = fleet()
    assert parting(one, resolve(one)) == (pytest.approx(0.56), pytest.approx(2.0))


# --- gaps ---

BOX = "[[obstacle]]\nname = 'box'\npoints_m = [[4, 1.5], [6, 1.5], [6, 2.5], [4, 2.5]]\n"


@pytest.mark.parametrize(
    ("obstacles", "gap"),
    [
        (circle(4, 3, 1) + circle(6.15, 3, 1, "post"), "0.15"),
        (BOX + circle(5, 3, 0.35), "0.15"),
        (BOX + "[[obstacle]]\nname = 'other'\npoints_m = [[5, 2.6], [7, 5], [3, 5]]\n", "0.1"),
        (BOX + "[[obstacle]]\nname = 'other'\npoints_m = [[3, 2.69], [7, 2.69], [5, 5]]\n", "0.19"),
    ],
)
def test_a_gap_that_no_robot_fits_through(obstacles: str, gap: str) -> None:
    (only,) = found(obstacles)
    assert (only.level, only.place) == ("info", "obstacle")
    assert f"is {gap} m wide, and a hand point needs more than twice the clearance, 0.2 m" in only.message
    assert found(obstacles, f"avoidance.clearance_m={float(gap) / 2 - 0.001}") == []


# --- in words ---


def test_a_fence_of_many_corners_and_a_long_drive_are_quick_to_look_at() -> None:
    angles = np.linspace(0.0, 2.0 * pi, 200, endpoint=False)
    ring = Polygon(
        "ring", list(zip((50 * np.cos(angles)).tolist(), (50 * np.sin(angles)).tolist(), strict=True))
    )
    one = fleet("", "fleet.duration_s=1e6")
    crossing = dict(Paths(one, resolve(one)).below(ring, 0.0))
    assert set(crossing) == {3, 7, 5}
