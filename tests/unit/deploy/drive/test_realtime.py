"""What a preflight and a run say of real time, by what processes have."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from typing import cast

import pytest

from handfast.agent.fleet.hosts import ProcessSection
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.runtime.realtime_granted import SCHED_FIFO, Granted, Thread
from handfast.deploy.cli import main
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.drive import realtime
from handfast.deploy.drive.preflight import summary
from handfast.deploy.drive.readiness import OK, WARNING, Line
from handfast.deploy.drive.realtime import RECORDING_NICE, lines, trial
from handfast.deploy.processes.child import FleetProcesses

ASKED = ProcessSection(realtime=True)
LINKS = (Thread(11, "app-0", SCHED_FIFO, 40, (0, 1)), Thread(12, "app-1", SCHED_FIFO, 40, (0, 1)))
SCHED_OTHER, SCHED_RR, SCHED_BATCH = 0, 2, 3


def has(
    policy: int, priority: int, cpus: tuple[int, ...] = (0, 1), links: tuple[Thread, ...] = LINKS
) -> Granted:
    """What a process has whose main thread has that."""
    main_thread = Thread(10, "python", policy, priority, cpus)
    fifo = priority if policy == SCHED_FIFO else 0
    return Granted(
        fifo,
        cpus,
        (0, 1),
        locked=True,
        rtprio=42,
        memlock=-1,
        privileged=False,
        threads=(main_thread, *links),
    )


AGENT, PLANT = has(SCHED_FIFO, 41), has(SCHED_FIFO, 42)
REFUSED = has(SCHED_OTHER, 0)._replace(rtprio=0)


def fleet() -> Fleet:
    return replace(load_fleet(FLEETS / "delta.toml"), process=ASKED)


def all_have(agent: Granted | None, plant: Granted | None) -> dict[tuple[int, str], Granted | None]:
    return {
        (robot, role): each for robot in range(1, 7) for role, each in (("agent", agent), ("plant", plant))
    }


def test_what_a_robots_processes_were_granted_is_a_line_for_each() -> None:
    found = lines(ASKED, {(1, "agent"): AGENT, (1, "plant"): PLANT}, as_units=False)
    assert found == {
        1: [
            Line("realtime agent", OK, "SCHED_FIFO 41, cores 0-1, memory locked", ""),
            Line("realtime plant", OK, "SCHED_FIFO 42, cores 0-1, memory locked", ""),
        ]
    }


def test_what_both_are_refused_is_one_line_and_blocks_nothing() -> None:
    (line,) = lines(ASKED, {(1, "agent"): REFUSED, (1, "plant"): REFUSED}, as_units=True)[1]
    assert (line.name, line.level) == ("realtime", WARNING)
    assert "RLIMIT_RTPRIO is 0" in line.found
    assert "user@.service.d" in line.advice
    assert summary({1: [line]}) == "CLEAR, with 1 warning"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has it")
def test_a_trial_asks_as_a_process_would() -> None:
    found = trial(replace(ASKED, cpus=(0,)))
    assert list(found) == ["agent", "plant"]
    for each in found.values():
        assert each is not None
        assert each.cpus == (0,)


def test_preflight_says_what_this_machine_grants_where_it_is_asked_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[ProcessSection] = []

    def pretended(section: ProcessSection) -> dict[str, Granted | None]:
        tried.append(section)
        return {"agent": AGENT, "plant": PLANT}

    monkeypatch.setattr(realtime, "trial", pretended)
    assert main(["preflight", "delta"]) == 0
    assert "realtime" not in capsys.readouterr().out
    assert main(["preflight", "delta", "--set", "process.realtime=true", "--set", "process.cpus=[1]"]) == 0
    out = capsys.readouterr().out
    assert "realtime plant: SCHED_FIFO 42, cores 0-1, memory locked; on core 0 as well" in out
    assert out.endswith("simulated: nothing to check\nCLEAR, with 12 warnings\n")
    assert tried == [ProcessSection(realtime=True, cpus=(1,))]


class Looked:
    """Processes of a fleet as they are found."""

    def __init__(self) -> None:
        self.found = all_have(AGENT, PLANT)
        self.looks = 0

    def granted(self) -> dict[tuple[int, str], Granted | None]:
        self.looks += 1
        return self.found


def test_who_gives_real_time_up_in_a_drive_is_named_once() -> None:
    there = Looked()
    watch = realtime.Watch(fleet(), cast(FleetProcesses, there))
    assert len(watch.begin()) == 2
    assert watch.look(10.0) == watch.look(10.5) == []
    assert there.looks == 2, "a look costs files of each process: one a second is enough"
    there.found = there.found | {(2, "agent"): REFUSED, (3, "plant"): None}
    (sentence,) = watch.look(11.0)
    said = "The agent of robot 2 has real time no longer (SCHED_OTHER): it ran for 0.5 s without waiting and "
    assert sentence == f"{said}gave it up, which its log says, or somebody took it away", (
        "the verdict ends it"
    )
    assert watch.look(12.0) == []


CHANGED = [
    (
        has(SCHED_FIFO, 5),
        ["The agent of robot 2 has SCHED_FIFO 5 now, which somebody changed from SCHED_FIFO 41"],
    ),
    (
        has(SCHED_FIFO, 41, (0,)),
        [
            "The agent of robot 2 has SCHED_FIFO 41, core 0 now, which somebody changed from SCHED_FIFO 41, "
            "cores 0-1"
        ],
    ),
    (
        has(SCHED_RR, 41),
        ["The agent of robot 2 has SCHED_RR 41 now, which somebody changed from SCHED_FIFO 41"],
    ),
    (
        has(SCHED_BATCH, 0),
        ["The agent of robot 2 has SCHED_BATCH now, which somebody changed from SCHED_FIFO 41"],
    ),
    (
        has(SCHED_FIFO, 41, links=tuple(each._replace(policy=SCHED_OTHER, priority=0) for each in LINKS)),
        [
            "Threads app-0, app-1 of the agent of robot 2 have SCHED_OTHER now, which somebody changed from "
            "SCHED_FIFO 40"
        ],
    ),
    (
        has(SCHED_FIFO, 41, links=(LINKS[0]._replace(cpus=(1,)), LINKS[1])),
        [
            "Thread app-0 of the agent of robot 2 has SCHED_FIFO 40, core 1 now, which somebody changed from "
            "SCHED_FIFO 40, cores 0-1"
        ],
    ),
    # What ended and what came since: a thread of a plugin, or the number of one given to another.
    (has(SCHED_FIFO, 41, links=(LINKS[0], Thread(12, "numpy", SCHED_OTHER, 0, (0, 1)))), []),
    (has(SCHED_FIFO, 41, links=()), []),
]


@pytest.mark.parametrize(("found", "sentences"), CHANGED)
def test_whose_scheduling_somebody_changes_in_a_drive_is_named_once(
    found: Granted, sentences: list[str]
) -> None:
    there = Looked()
    watch = realtime.Watch(fleet(), cast(FleetProcesses, there))
    watch.begin()
    there.found = there.found | {(2, "agent"): found}
    assert watch.look(11.0) == sentences
    assert watch.look(12.0) == []


@pytest.fixture
def niceness(monkeypatch: pytest.MonkeyPatch) -> dict[int, int]:
    """What threads of this process have, as the kernel would keep it of one that may do anything."""
    kept: dict[int, int] = {}
    monkeypatch.setattr(os, "getpriority", lambda _which, thread: kept.setdefault(thread, 0))
    monkeypatch.setattr(os, "setpriority", lambda _which, thread, nice: kept.update({thread: nice}))
    return kept


def test_the_command_that_records_a_fleet_in_real_time_goes_before_others_meanwhile(
    niceness: dict[int, int],
) -> None:
    with realtime.recording(fleet()):
        assert niceness[os.getpid()] == RECORDING_NICE
    assert set(niceness.values()) == {0}
