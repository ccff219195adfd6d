"""Orders that outlive processes: all are killed and start again; nobody drives but by a word said since."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterable
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import PlantState
from handfast.agent.transport.bus import BusError
from handfast.deploy.session import stop as stop_module
from handfast.deploy.session.stop import Way
from handfast.deploy.session.stop_by_file import WAY, FileWay
from tests.process.fleet_harness import Robots, robots

REASON = "a person on the field"


def start_again(fleet: Robots, who: Iterable[int]) -> int:
    """Kills both processes of these robots, all before the first starts again; when that was."""
    for robot in who:
        for role in ROLES:
            fleet.signal(robot, role, signal.SIGKILL)
    for robot in who:
        for role in ROLES:
            fleet.processes[robot, role].wait()
    fleet.collect()
    fleet.latest.clear()
    begun_ns = time.time_ns()
    for robot in who:
        for role in ROLES:
            fleet.start(robot, role)
    return begun_ns


def nobody_drives(fleet: Robots, from_ns: int, for_s: float = 2.0) -> None:
    until = time.monotonic() + for_s
    fleet.wait(lambda: time.monotonic() > until, "a while passes")
    for robot in fleet.fleet.ids:
        assert not any(m.driving for _, m in fleet.since(from_ns, PlantState, robot)), fleet.told()


def test_a_stop_by_a_file_holds_though_all_start_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise BusError("no link opens any more")

    monkeypatch.setattr(stop_module, "StopSession", fails)
    with robots(tmp_path / "r", "pair") as fleet:
        fleet.drive()
        ways: list[Way] = [FileWay(fleet.fleet, fleet.folder / "orders")]
        stopping, troubles = stop_module.stop(fleet.fleet, REASON, ways)
        assert stopping.done, [*map(stopping.outcome, fleet.fleet.ids), fleet.told()]
        assert troubles == ["not over new links: no link opens any more"]
        assert WAY in stopping.outcome(1)
        fleet.wait_until_all("stopped")
        begun_ns = start_again(fleet, fleet.fleet.ids)
        fleet.wait_until_all("stopped")
        assert {fleet.status(robot).reason for robot in fleet.members} == {f"stop: {REASON}"}
        assert fleet.mission is not None
        later = fleet.mission_of(begun_ns + NS_PER_S, 60.0)
        fleet.publish_mission(later)
        nobody_drives(fleet, begun_ns)
        assert not fleet.died()
