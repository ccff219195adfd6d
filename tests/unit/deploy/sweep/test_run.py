"""One run of a sweep: what becomes of it in its row."""

from __future__ import annotations

import gc

import pytest

from handfast.deploy.sweep.plan import Question, make_plan
from handfast.deploy.sweep.run import PASSED, execute
from handfast.deploy.sweep.summary import summarise

ALONE = """
[fleet]
name = "alone"
duration_s = 3.0
[formation]
safe_distance_m = 0.2
edges = []
offsets = [[0.0, 0.0]]
[[robot]]
id = 9
x_m = 0.3
y_m = 0.0
"""
RESERVE = "[[robot]]\nid = 10\nx_m = 3.0\ny_m = 0.0\nreserve = true\n"


@pytest.mark.parametrize("more", ["", RESERVE], ids=["alone", "one in reserve"])
def test_a_robot_without_edges_is_safe_and_settled_at_its_place(more: str) -> None:
    plan = make_plan(Question("alone", ALONE + more, None, (), (), 2, None))
    rows = {run: execute(plan, run) for run in range(plan.runs)}
    for row in rows.values():
        assert (row.verdict, row.reason, row.safe, row.settled) == (PASSED, "", True, True)
        assert row.numbers["settling_time_s"] == 0.0
    (cell,) = summarise(plan, rows)
    assert (cell.safe.count, cell.settled.count) == (2, 2)
    assert cell.unsafe_upper == pytest.approx(1.0 - 0.05 ** (1 / 2))


def test_a_robot_without_edges_that_is_not_at_its_place_has_not_settled() -> None:
    course = ("trajectory.kind=line", "trajectory.velocity_mps=[1.0, 0.0]", "control.max_speed_mps=0.5")
    plan = make_plan(Question("alone", ALONE, None, (*course, "fleet.duration_s=12"), (), 1, None))
    row = execute(plan, 0)
    assert (row.safe, row.settled) == (True, False)
    assert "from its place" in row.reason


def test_a_robot_without_edges_whose_agent_is_dead_has_not_settled() -> None:
    killed = '[[faults.rule]]\nkill = "agent"\nrobot = 9\nat = 1.0\n'
    row = execute(make_plan(Question("alone", ALONE + killed, None, (), (), 1, None)), 0)
    assert (row.safe, row.settled) == (True, False)


@pytest.mark.slow
def test_a_process_that_drives_many_runs_does_not_grow_with_each() -> None:
    plan = make_plan(Question("alone", ALONE, None, ("fleet.duration_s=0.5",), (), 8, None))
    objects = []
    for run in range(plan.runs):
        execute(plan, run)
        objects.append(len(gc.get_objects()))
    # The first may load modules; of the last each what it was made of is there until the next one begins.
    assert objects[-1] - objects[3] < 1000, objects
