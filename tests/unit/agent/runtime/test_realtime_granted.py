"""What is found and said of real time that processes have."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace

import pytest

from handfast.agent.fleet.hosts import ProcessSection
from handfast.agent.runtime.realtime_granted import (
    Granted,
    from_json,
    look,
    main,
    said,
    to_json,
)

ASKED = ProcessSection(realtime=True)
ALL = Granted(41, (0, 1), (0, 1), locked=True, rtprio=42, memlock=-1, privileged=False)
NOTHING = Granted(0, (0, 1), (0, 1), locked=False, rtprio=0, memlock=8 << 20, privileged=False)


def words(granted: Granted | None, section: ProcessSection = ASKED, *, as_unit: bool = False) -> str:
    return str(said(section, "agent", granted, as_unit=as_unit))


@pytest.mark.parametrize(
    ("as_unit", "advice"),
    [
        (False, ("- rtprio 42`", "- memlock unlimited`", "/etc/security/limits.d/", "log in anew")),
        (True, ("user@.service.d/handfast.conf", "LimitRTPRIO=42", "LimitMEMLOCK=infinity", "restart")),
    ],
)
def test_limits_that_refuse_it_are_named_with_what_would_be_right(
    as_unit: bool, advice: tuple[str, ...]
) -> None:
    found = words(NOTHING, as_unit=as_unit)
    assert found.startswith(
        "cores 0-1; SCHED_FIFO refused: RLIMIT_RTPRIO is 0, 42 is needed; memory not locked: RLIMIT_MEMLOCK "
        "is 8192 kB, it has to be unlimited ("
    )
    assert all(part in found for part in advice), found
    assert found.count("/handfast.conf") == 1, "of two limits it is said once"


@pytest.mark.parametrize("refused", [NOTHING._replace(rtprio=99), NOTHING._replace(privileged=True)])
def test_who_may_and_has_not_is_told_of_sandboxes_and_control_groups(refused: Granted) -> None:
    found = words(refused._replace(locked=True))
    assert "its limits allow it" in found
    assert "cpu.rt_runtime_us" in found
    assert "limits.d" not in found


def test_cores_that_are_not_there_are_said_and_which_are() -> None:
    pinned = ProcessSection(realtime=True, cpus=(1, 7))
    found = words(ALL._replace(cpus=(1,)), pinned)
    assert found.endswith("core 1, memory locked; not on core 7 (correct process.cpus: there are cores 0-1)")
    held = words(ALL._replace(cpus=(0,)), replace(pinned, cpus=(0, 1)))
    kept = "a container or control group keeps it from there (cpuset.cpus)"
    assert held.endswith(f"core 0, memory locked; not on core 1 ({kept})")
    both = words(ALL._replace(cpus=(0,)), replace(pinned, cpus=(0, 1, 7)))
    assert "not on core 7; not on core 1 (correct process.cpus: there are cores 0-1; a container" in both
    moved = words(ALL._replace(cpus=(0, 1)), replace(pinned, cpus=(1,)))
    assert "on core 0 as well" in moved
    assert not said(pinned, "agent", ALL._replace(cpus=(1, 7)), as_unit=False).advice


def test_a_process_is_looked_at_while_it_lives() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", "input()"],
        stdin=subprocess.PIPE,
        preexec_fn=lambda: os.sched_setaffinity(0, {0}),
    ) as child:
        found = look(child.pid)
        child.communicate(b"\n")
    assert found is not None
    assert (found.fifo, found.cpus, found.locked) == (0, (0,), False)
    assert set(found.cpus) <= set(found.there)
    assert look(child.pid) is None


def test_what_is_printed_for_who_looks_over_ssh_is_read_back(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(os.getpid()), "999999999"]) == 0
    mine, gone = map(json.loads, capsys.readouterr().out.splitlines())
    assert from_json(mine) == look(os.getpid())
    assert from_json(gone) is None
    assert from_json(json.loads(to_json(ALL))) == ALL
    before = ALL._asdict()
    del before["threads"]
    assert from_json(before) == ALL, "a host may have an older version"
    for wrong in ({}, {**ALL._asdict(), "cpus": 7}, {**ALL._asdict(), "threads": 7}, [], "x"):
        with pytest.raises(ValueError, match=r"no answer about real time|invalid literal"):
            from_json(wrong)
