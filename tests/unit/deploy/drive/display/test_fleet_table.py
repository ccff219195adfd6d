"""The table of a fleet fits its terminal: whole columns go, numbers stay whole."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from handfast.deploy.drive.display.fleet_table import COLUMNS, table
from handfast.deploy.drive.readiness import OK, Line
from handfast.deploy.drive.watch import RobotPicture

HEADINGS = [column.heading for column in COLUMNS]


def about(robot: int, *, battery: str = "12.3 V, 88 %", level: str = OK) -> RobotPicture:
    return RobotPicture(
        "degraded" if robot % 2 else "running",
        "held up by robot 7, which is held up by robot 9" if robot % 2 else "",
        0.125 * robot,
        40.0 * robot,
        90 + robot,
        robot,
        off_m=0.5 * robot,
        nearest=(0.25 * robot, robot % 99 + 1),
        speed=-0.01 * robot,
        battery=Line("battery", level, battery, "") if battery else None,
    )


def drawn(robots: dict[int, RobotPicture], width: int, room: int = 24) -> list[str]:
    stream = io.StringIO()
    console = Console(file=stream, width=width, color_system=None)
    for each in table(robots, width, room):
        console.print(each)
    return stream.getvalue().splitlines()


def headings(line: str) -> list[str]:
    """The headings in a line, in its order."""
    return sorted((heading for heading in HEADINGS if heading in line), key=line.index)


@given(
    st.integers(28, 200),
    st.dictionaries(st.integers(1, 100), st.floats(0.0, 5000.0), min_size=1, max_size=30),
)
def test_no_line_is_too_long_and_no_number_is_cut_at_any_width(width: int, far: dict[int, float]) -> None:
    robots = {robot: about(robot) for robot in far}
    for robot, metres in far.items():
        robots[robot].off_m, robots[robot].nearest, robots[robot].speed = metres, (metres, robot), -metres
    lines = drawn(robots, width)
    shown = headings(lines[0])
    assert max(map(len, lines)) <= width
    assert len(lines) <= len(robots) + 1
    numbers = [heading for heading in shown if heading not in ("state", "why")]
    for line in lines[1:]:
        if line.startswith("and "):
            continue
        robot = int(line.split()[0])
        texts = {column.heading: column.text(robot, robots[robot]) for column in COLUMNS}
        for heading in numbers:
            assert f" {texts[heading]} " in f" {line} ", heading


@pytest.mark.parametrize(
    ("said", "shows"),
    [("12.3 V, 88 %", "88 %"), ("11.9 V", "11.9 V"), ("7 %", "7 %"), ("not measured", "-"), ("", "-")],
)
def test_a_battery_is_shown_by_its_share_else_by_its_voltage(said: str, shows: str) -> None:
    robots = {1: about(1, battery=said), 2: about(2, battery="50 %")}
    assert f" {shows} " in drawn(robots, 60)[1].replace(robots[1].reason, "")


def test_of_too_many_robots_those_in_trouble_are_shown_and_the_others_counted() -> None:
    robots = {robot: about(robot) for robot in range(1, 101)}
    lines = drawn(robots, 80, room=10)
    assert len(lines) == 11
    assert [int(line.split()[0]) for line in lines[1:-1]] == [1, 3, 5, 7, 9, 11, 13, 15, 17]
    assert lines[-1].startswith("and 91 more (2, 4, 6, 8, 10, 12, 14, 16 and 83 more)")
    assert len(drawn({robot: robots[robot] for robot in range(1, 11)}, 80, room=10)) == 11
