"""How many processors this machine has for robots, and how fast they are."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from math import inf
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.analysis.shapes import lattice
from handfast.deploy.check.capacity import FULL, Machine, cost_of, used
from handfast.deploy.processes import machine
from handfast.deploy.processes.machine import LOOKS, ROUND_S, WINDOWS, measured, measured_for, overload_here


def test_it_is_measured_on_the_processors_that_may_be_used_and_leaves_them_as_they_were() -> None:
    allowed = os.sched_getaffinity(0)
    found = measured()
    assert 0.0 < found.cores <= len(allowed)
    assert found.speed > 0.0
    assert os.sched_getaffinity(0) == allowed


def test_the_fastest_window_counts_of_a_machine_that_others_slow_down(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Windows of an idle machine with other tenants: 0.6 times as fast as one before, for a while."""
    slow = iter([1.6, 1.0, 1.7, 1.6, 1.05, 1.6] * WINDOWS)
    monkeypatch.setattr(machine, "_took_s", lambda *_: ROUND_S * next(slow))
    assert measured().speed == 1.0


def looks(monkeypatch: pytest.MonkeyPatch, *speeds: float) -> list[float]:
    """Has the machine be measured as so fast, one after the other; what was waited between."""
    measures, waited = iter(speeds), list[float]()
    monkeypatch.setattr(machine, "measured", lambda: Machine(2.0, next(measures)))
    monkeypatch.setattr(machine.time, "sleep", waited.append)
    return waited


def test_a_machine_that_is_slow_for_a_second_is_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = resolved(parse_fleet(lattice("many", 45, rate_hz=10.0), source="many"))
    enough = used(cost_of(fleet), Machine(2.0, 1.0)) / FULL + 0.01
    waited = looks(monkeypatch, enough, 9.0)
    assert measured_for(fleet).speed == enough
    assert waited == [], "a fleet that is carried is not kept waiting"
    waited = looks(monkeypatch, 0.6 * enough, enough, 9.0)
    assert measured_for(fleet).speed == enough
    assert len(waited) == 1
    waited = looks(monkeypatch, *[0.6 * enough, 0.7 * enough, 0.5 * enough][:LOOKS], 9.0)
    assert measured_for(fleet).speed == 0.7 * enough
    assert overload_here(fleet) == "", "the last is fast"


@pytest.mark.parametrize(
    ("limits", "processors"),
    [
        ({}, inf),
        ({"a/b": "max 100000"}, inf),
        ({"a/b": "150000 100000"}, 1.5),
        ({"a": "50000 100000", "a/b": "max 100000"}, 0.5),
        ({"": "400000 100000", "a/b": "200000 50000"}, 4.0),
        ({"a/b": "nonsense"}, inf),
    ],
)
def test_a_control_group_may_have_less(tmp_path: Path, limits: dict[str, str], processors: float) -> None:
    groups, own = tmp_path / "cgroup", tmp_path / "own"
    (groups / "a" / "b").mkdir(parents=True)
    own.write_text("1:cpu:/other\n0::/a/b\n")
    for folder, text in limits.items():
        (groups / folder / "cpu.max").write_text(text + "\n")
    assert machine._quota(groups, own) == processors
    assert machine._quota(groups, tmp_path / "absent") == inf


def test_the_program_beside_hears_no_ctrl_c_and_ends_with_whoever_started_it() -> None:
    cpu = min(os.sched_getaffinity(0))
    script = (
        "import os, signal, subprocess\n"
        "from handfast.deploy.processes import machine\n"
        "made = []\n"
        "popen = subprocess.Popen\n"
        "subprocess.Popen = lambda *a, **k: made.append(popen(*a, **k)) or made[-1]\n"
        f"with machine._busy({cpu}):\n"
        "    assert os.getpgid(made[0].pid) != os.getpgid(0)\n"
        "    print(made[0].pid, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    pid = int(told.stdout)
    until = time.monotonic() + 10.0
    while Path(f"/proc/{pid}").exists() and "State:\tZ" not in Path(f"/proc/{pid}/status").read_text():
        assert time.monotonic() < until, "it goes on"
        time.sleep(0.01)
