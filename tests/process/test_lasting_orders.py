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
from handfast.agent.supervision.situation import NOT_SAID
from handfast.agent.transport.bus import BusError
from handfast.deploy.inventory.known_fleets import NoAnswerError
from handfast.deploy.session import stop as stop_module
from handfast.deploy.session.resume import resume
from handfast.deploy.session.stop import Way
from handfast.deploy.session.stop_by_file import WAY, FileWay
from tests.process.fleet_harness import Robots, all_ready, robots
from tests.process.harness import no_trouble_in_logs
from tests.process.small_fleets import triangle

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


@pytest.mark.long
def test_a_fleet_whose_robots_all_start_again_waits_for_a_word(tmp_path: Path) -> None:
    with all_ready(triangle(), tmp_path / "r") as fleet:
        fleet.drive()
        begun_ns = start_again(fleet, fleet.fleet.ids)
        fleet.wait_until_all("ready")
        fleet.wait(lambda: {fleet.status(robot).reason for robot in fleet.members} == {NOT_SAID}, "they wait")
        nobody_drives(fleet, begun_ns)
        status, out = fleet.told_by("resume")
        assert status == 0, out
        fleet.wait_until_all("running")
        # One alone starts again in a drive that goes on: it takes its place, with nobody's word.
        begun_ns = start_again(fleet, [2])
        took_s, _ = fleet.first(begun_ns, PlantState, 2, lambda m: m.driving, "it drives again")
        assert took_s < 20.0, "and soon: how soon is measured elsewhere"
        assert not fleet.died()
        no_trouble_in_logs(fleet.folder)


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


@pytest.mark.long
def test_a_resume_that_was_given_before_a_stop_does_not_lift_it(tmp_path: Path) -> None:
    """As one that has waited for its links meanwhile, or on a laptop whose lid was closed."""
    with robots(tmp_path / "r", "pair") as fleet:
        fleet.drive()
        given_ns = time.time_ns()
        status, out = fleet.told_by("stop")
        assert status == 0, out
        fleet.wait_until_all("stopped")
        with pytest.raises(NoAnswerError, match="nobody is resumed: somebody has just said stop"):
            resume(fleet.fleet, (), given_ns)
        nobody_drives(fleet, time.time_ns(), 1.0)
        resuming, _ = resume(fleet.fleet, (), time.time_ns())
        assert resuming.done
        fleet.wait_until_all("running")


@pytest.mark.long
def test_a_damaged_file_is_said_and_nobody_drives(tmp_path: Path) -> None:
    with robots(tmp_path / "r", "pair") as fleet:
        fleet.drive()
        kept = fleet.folder / "orders" / "robot-1-agent.json"
        fleet.wait(kept.exists, "the mission is kept")
        for robot in fleet.fleet.ids:
            path = fleet.folder / "orders" / f"robot-{robot}-agent.json"
            path.write_bytes(path.read_bytes()[:-10])
        begun_ns = start_again(fleet, fleet.fleet.ids)
        fleet.wait_until_all("ready")
        assert f"cannot use the orders kept in {kept}: it is damaged" in fleet.log(1, "agent").read_text()
        nobody_drives(fleet, begun_ns)
