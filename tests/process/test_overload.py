"""A process that is held up again and again, as on a machine that has too much to do: by stopping it."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from handfast.agent.messages.types import Beacon, HandState, Status
from tests.process.fleet_harness import robots

pytestmark = pytest.mark.long

HELD_UP_S = 0.06
PATIENT = ("control.wrench_timeout_s=1", "control.plant_timeout_s=1")
"""Commands shall be judged, not the scheduler of a busy machine."""


def test_one_that_is_held_up_has_all_drive_at_a_lower_rate_and_they_come_back(tmp_path: Path) -> None:
    with robots(tmp_path / "r", "pair", *PATIENT) as all_robots:
        all_robots.drive()
        begun_ns = time.time_ns()

        def held_up() -> bool:
            all_robots.signal(1, "agent", signal.SIGSTOP)
            time.sleep(HELD_UP_S)
            all_robots.signal(1, "agent", signal.SIGCONT)
            time.sleep(HELD_UP_S)
            status = all_robots.status(2)
            return status is not None and "overloaded: the machine of robot 1 runs late" in status.reason

        all_robots.wait(held_up, "robot 2 decides more rarely for the sake of robot 1")
        asked = [beacon.overload for _, beacon in all_robots.since(begun_ns, Beacon, 1)]
        assert max(asked) >= 1
        all_robots.first(begun_ns, HandState, 2, lambda m: m.next_ms >= 40, "it says when the next comes")

        def is_back() -> bool:
            found = [all_robots.status(robot) for robot in all_robots.fleet.ids]
            return all(status is not None and "overloaded" not in status.reason for status in found)

        all_robots.wait(is_back, "both decide at the full rate again")
        said = [status for robot in (1, 2) for _, status in all_robots.since(begun_ns, Status, robot)]
        # Nobody took it for a plant or a robot that is lost.
        assert {status.state for status in said} <= {"running", "degraded"}, {s.reason for s in said}
        assert not any("silent" in status.reason or "no connection" in status.reason for status in said)
