"""The checks of many vehicles on one page: a mark each, and words for what is not well."""

from __future__ import annotations

import io

import pytest

from handfast.deploy.drive.preflight import LEGEND, matrix, show, summary
from handfast.deploy.drive.readiness import Line

LINK = Line("link", "ok", "system 1 on udp:14550", "")
MODE = Line("mode", "warning", "MANUAL", "its operator puts it into GUIDED")
EKF = Line("EKF", "blocking", "waiting for its EKF to have a position", "give it open sky")


def battery(percent: int) -> Line:
    return Line("battery", "warning" if percent < 30 else "ok", f"{percent} %", "charge it soon")


@pytest.mark.parametrize("width", [60, 80, 140])
def test_forty_five_vehicles_fit(width: int) -> None:
    found = {robot: [LINK, MODE, battery(10 + robot)] for robot in range(1, 46)}
    lines = matrix(found, width)
    table, words = lines[: lines.index(LEGEND)], lines[lines.index(LEGEND) + 1 :]
    assert max(map(len, table)) <= width
    shown = [each for line in table if line.startswith("check") for each in line.split()[1:]]
    assert shown == [str(robot) for robot in found]
    for name, mark, count in (("link", ".", 45), ("mode", "!", 45), ("battery", "!", 19)):
        assert sum(line.split().count(mark) for line in table if line.startswith(name)) == count
    assert words == [
        "! 45 robots (1-45): mode: MANUAL (its operator puts it into GUIDED)",
        "! 19 robots (1-19): battery: 11 to 29 % (charge it soon)",
    ]


def test_several_vehicles_are_one_table_unless_each_is_asked_for() -> None:
    found = {1: [LINK, MODE], 2: [LINK, EKF], 3: [LINK, EKF], 6: [], 7: []}
    for each, tables in ((False, 0), (True, 3)):
        out = io.StringIO()
        show(found, out, each=each)
        lines = out.getvalue().splitlines()
        assert sum(line.startswith("robot ") and " " not in line[6:] for line in lines) == tables
        assert (LEGEND in lines) == (not each)
        assert lines[-2:] == ["robots 6 and 7  simulated: nothing to check", "BLOCKED: robots 2 and 3: EKF"]
    alone = io.StringIO()
    show({1: [LINK, MODE]}, alone)
    assert alone.getvalue().splitlines()[0] == "robot 1"
    assert summary(found) == "BLOCKED: robots 2 and 3: EKF"
