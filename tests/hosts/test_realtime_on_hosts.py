"""A fleet that asks for real time on its hosts: what its units let it have, and how that is said."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from handfast.deploy.console.data_files import FLEETS
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.host import Host, Setup
from tests.hosts.hosts import Hosts
from tests.hosts.programs import python_to_lend
from tests.process.harness import wait_for
from tests.realtime_here import may_raise_limits

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
MakeHosts = Callable[[int | Sequence[Setup]], Hosts]
GRANTED, ORDINARY = 1, 2
"""Robots: on a host where it is root's and keeps what root may, and on one where it is a user's."""
CORE = 0


def tables(hosts: Sequence[Host]) -> dict[str, Any]:
    raw = tomllib.loads((FLEETS / "pair.toml").read_text(encoding="utf-8"))
    raw["host"] = {host.name: {"address": host.address} for host in hosts}
    for robot, host in zip(raw["robot"], hosts, strict=True):
        robot["host"] = host.name
    raw["process"] = {"realtime": True, "cpus": [CORE]}
    return raw


def policies(fleet: FleetOnHosts, robot: int) -> list[tuple[int, int]]:
    """Policy and priority of a robot's agent and plant, by the kernel."""
    pids = [fleet.process(robot, role) for role in ("agent", "plant")]
    return [
        (os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(pid).sched_priority)
        for pid in pids
    ]


def test_units_lift_what_they_can_and_the_rest_is_said(
    make_hosts: MakeHosts, cache: Path, tmp_path: Path
) -> None:
    """A user's systemd gives no more than it has; with more, robots that start again get all."""
    if python_to_lend() is not None:
        pytest.skip("an ordinary user of a host needs a Python of 3.11 or later in /usr")
    hosts = make_hosts([Setup(namespaces=False), Setup(ordinary=True)])
    fetch_wheels(hosts[0], cache)
    fleet = FleetOnHosts(hosts, tmp_path, tables(list(hosts)), cache)
    fleet.handfast("keys")
    told = fleet.handfast("up", timeout=UP_TIMEOUT_S)

    assert policies(fleet, GRANTED) == [(os.SCHED_FIFO, 41), (os.SCHED_FIFO, 42)]
    assert os.sched_getaffinity(fleet.process(GRANTED, "agent")) == {CORE}
    assert policies(fleet, ORDINARY) == [(os.SCHED_OTHER, 0)] * 2, "it drives all the same"
    (warning,) = [line for line in told.stderr.splitlines() if "realtime" in line]
    refused = "SCHED_FIFO refused: RLIMIT_RTPRIO is 0, 42 is needed; memory not locked: RLIMIT_MEMLOCK is"
    assert f"{fleet.host_of(ORDINARY).name}: robot {ORDINARY}: realtime: core {CORE}; {refused}" in warning
    assert "user@.service.d/handfast.conf [Service] LimitRTPRIO=42" in warning

    found = fleet.handfast("preflight").stdout
    assert f"robot {GRANTED}: realtime agent: SCHED_FIFO 41, core {CORE}, memory locked\n" in found
    assert f"robot {GRANTED}: realtime plant: SCHED_FIFO 42, core {CORE}, memory locked\n" in found
    assert f"robot {ORDINARY}: realtime: core {CORE}; {refused}" in found

    if not may_raise_limits():
        return  # this machine's root may raise no limit (CAP_SYS_RESOURCE): nor can a host's
    # What that file would do, without the restart of the computer.
    host = fleet.host_of(ORDINARY)
    before = fleet.process(ORDINARY, "plant")
    host.run(
        f"for pid in $(pgrep -u {host.uid} -x systemd); do "
        "prlimit --pid $pid --rtprio=42:42 --memlock=unlimited:unlimited; done",
        check=True,
    )
    fleet.hosts.operator.ssh(host, "systemctl --user restart 'handfast-pair-robot-*'")
    wait_for(lambda: fleet.process(ORDINARY, "plant") != before, "the robot's new processes")
    assert "nothing to do" in fleet.handfast("up", timeout=UP_TIMEOUT_S).stderr
    assert policies(fleet, ORDINARY) == [(os.SCHED_FIFO, 41), (os.SCHED_FIFO, 42)]
    found = fleet.handfast("preflight").stdout
    both = f"robots {GRANTED} and {ORDINARY}: realtime"
    assert f"{both} agent: SCHED_FIFO 41, core {CORE}, memory locked\n" in found
    assert "formation within 5 %" in fleet.handfast("drive", "--out", "drive", "--no-report").stdout
