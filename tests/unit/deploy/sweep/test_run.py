"""One run of a sweep and its row; where runs are driven, and by which program."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.console.data_files import FLEETS, ROOT
from handfast.deploy.console.sources import plugins_of, sources_digest
from handfast.deploy.simulate import worker_pool
from handfast.deploy.simulate.worker_pool import (
    SOURCES,
    ClusterError,
    Pool,
    Refused,
    SameProgram,
    differences,
    identity,
    program_digest,
)
from handfast.deploy.sweep.plan import Question, make_plan
from handfast.deploy.sweep.run import PASSED, Resources, execute, scheduler_address
from handfast.deploy.sweep.summary import summarise
from tests.passing_law import PassingLaw

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
        gc.collect()  # when the collector comes by itself depends on what ran before in this process
        objects.append(len(gc.get_objects()))
    # The first may load modules; of the last each what it was made of is there until the next one begins.
    assert objects[-1] - objects[3] < 1000, objects


class Doubles:
    def execute(self, number: int, _go_on: Callable[[], bool]) -> int:
        return 2 * number

    def unfinished(self, number: int, reason: str, _wall_s: float, *, timed_out: bool) -> int:
        return -number


def test_a_scheduler_is_named_by_its_address_or_by_its_file(tmp_path: Path) -> None:
    file = tmp_path / "scheduler.json"
    file.write_text('{"address": "tls://host:8786"}')
    assert scheduler_address("tcp://[::1]:8786") == "tcp://[::1]:8786"
    assert scheduler_address(str(file)) == "tls://host:8786"


@pytest.mark.parametrize(
    "given", ["host:8786", "tcp://host", "ssh:delta", "http://host:8786", "", "tcp://a b:1"]
)
def test_another_address_is_refused(given: str) -> None:
    with pytest.raises(ClusterError, match=f"^--cluster {given}: must be tcp://HOST:PORT or tls://HOST:PORT"):
        scheduler_address(given)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"address": 3}', '{"address": "inproc://x"}'])
def test_a_file_that_no_scheduler_wrote_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "scheduler.json"
    file.write_text(text)
    with pytest.raises(ClusterError, match=r"scheduler\.json: (the file is not|must be)"):
        scheduler_address(str(file))


@pytest.mark.parametrize(
    ("cluster", "jobs", "wait_s", "says"),
    [
        ("tcp://host:1", 2, None, "leave out --jobs"),
        (None, None, 9.0, "--cluster-wait .* needs a cluster"),
        (None, 0, None, "--jobs must be at least 1, got 0"),
    ],
)
def test_resources_that_contradict_each_other_are_refused(
    cluster: str | None, jobs: int | None, wait_s: float | None, says: str
) -> None:
    with pytest.raises(ClusterError, match=says):
        Resources(cluster, jobs, wait_s, 600.0)


def test_without_a_cluster_this_machine_drives() -> None:
    with Resources(None, 1, None, 60.0).engine(Doubles(), identity(), (), print) as engine:
        assert isinstance(engine, Pool)
        assert list(engine.results([4], lambda: True)) == [8]


def test_differences_between_programs_are_named() -> None:
    here = identity()
    assert here[SOURCES] == sources_digest(ROOT)
    assert differences(here, dict(here)) == ""
    there = here | {"Python": "3.99", "numpy": "1.0"}
    del there["pymap3d"]
    assert differences(here, there) == (
        f"Python 3.99 instead of {here['Python']}, numpy 1.0 instead of {here['numpy']}, "
        f"pymap3d unknown instead of {here['pymap3d']}"
    )


def test_the_files_of_plugins_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    law = PassingLaw(tmp_path, monkeypatch, "law_of_a_program")
    fleet = load_fleet(FLEETS / "pair.toml", law=law.reference)
    plugins = plugins_of([load_fleet(FLEETS / "pair.toml"), fleet])
    assert plugins == (law.reference,)
    without, before = sources_digest(ROOT), program_digest(plugins)
    assert program_digest(()) == without != before
    file = tmp_path / "law_of_a_program.py"
    file.write_text(file.read_text() + "\n")
    assert program_digest(plugins) not in (before, without)


def programs(monkeypatch: pytest.MonkeyPatch, *found: str) -> Iterator[str]:
    """Make `identity` return sources one after the other."""
    left = iter(found)
    monkeypatch.setattr(worker_pool, "identity", lambda _: {SOURCES: next(left)})
    return left


def test_the_program_is_compared_before_and_after_the_first_run_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left = programs(monkeypatch, "aa", "aa", "bb")
    work = SameProgram(Doubles(), {SOURCES: "aa"}, ())
    assert [work.execute(number, lambda: True) for number in range(4)] == [0, 2, 4, 6]
    assert list(left) == ["bb"]
    assert work.unfinished(3, "died", 1.0, timed_out=False) == -3


@pytest.mark.parametrize("found", [("bb",), ("cc", "bb")])
def test_another_program_drives_nothing(monkeypatch: pytest.MonkeyPatch, found: tuple[str, ...]) -> None:
    left = programs(monkeypatch, *found)
    with pytest.raises(Refused, match=r"^the program is not the one .* with: sources bb instead of cc$"):
        SameProgram(Doubles(), {SOURCES: "cc"}, ()).execute(1, lambda: True)
    assert list(left) == []
