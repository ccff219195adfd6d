"""Recorders beside real agents and plants: what they leave, killed or not, makes the run that was driven."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.validation import Malformed
from handfast.agent.recorder.folder import recording_files
from handfast.deploy.merging.merge import Choice, merge
from handfast.deploy.recording.mcap_reader import McapFile
from handfast.deploy.report.run_folder import RunFolder, rebuild
from tests.process.fleet_harness import Heard, Robots, make_fleet, placed
from tests.process.harness import PATIENCE_S, measured, no_trouble_in_logs, wait_for

RECORDER = "recorder"
DURATION_S = 6.0
CALM = (f"fleet.duration_s={DURATION_S}", "fleet.rate_hz=25", "control.wrench_timeout_s=0.5",
        "control.plant_timeout_s=0.5")  # fmt: skip
"""A busy machine shall not make agents miss what the law needs."""


class Recorded(Robots):
    """Robots whose operator records what it hears, as `handfast run` does."""

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        super().__init__(fleet, folder)
        self.run_folder = RunFolder(folder / "run", fleet, "run")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        self.run_folder.close()

    def collect(self) -> None:
        now_ns = time.time_ns()
        for key, payload in self.bus.drain():
            self.run_folder.record(now_ns, key, payload)
            try:
                message = decode(payload)
            except Malformed:
                continue
            self.heard.append(Heard(now_ns, key, message))
            self.latest[key] = message
        self.presence.update()

    def recording(self, robot: int) -> Path:
        return self.folder / "recordings" / f"robot-{robot}"

    def start_recorder(self, robot: int) -> None:
        arguments = ("--fleet", str(self.fleet_file), "--robot", str(robot))
        self.run(
            robot, RECORDER, "handfast.agent.recorder", *arguments, "--folder", str(self.recording(robot))
        )

    def recorded(self, robot: int) -> list[tuple[int, str]]:
        """Reception and key of all that is on the disk of a robot's computer now."""
        folder = self.recording(robot)
        return [
            (at_ns, key)
            for path in (recording_files(folder) if folder.exists() else [])
            for at_ns, key, _ in McapFile(path).read()
        ]

    def wait_until_recorded(self, robot: int, from_ns: int = 0) -> None:
        """Until the disk has something of both of a robot's processes that came after `from_ns`."""
        wanted = {key_expressions.status(self.name, robot), key_expressions.plant_state(self.name, robot)}

        def look() -> bool:
            return wanted <= {key for at_ns, key in self.recorded(robot) if at_ns > from_ns}

        self.wait(look, f"robot {robot} recorded")


@contextmanager
def recorded(folder: Path) -> Iterator[Recorded]:
    with placed(make_fleet("pair", *CALM)) as fleet, Recorded(fleet, folder) as robots:
        robots.start_all()
        for robot in fleet.ids:
            robots.start_recorder(robot)
        robots.wait_until_all("ready")
        for robot in fleet.ids:
            robots.wait_until_recorded(robot)
        yield robots


def test_a_drive_is_recorded_and_a_killed_recorder_loses_a_second(tmp_path: Path) -> None:
    with recorded(tmp_path / "r") as robots:
        epoch_ns = robots.drive(DURATION_S)
        robots.wait(lambda: time.time_ns() > epoch_ns + 2 * NS_PER_S, "two seconds of driving")
        killed_ns = robots.signal(2, RECORDER, signal.SIGKILL)
        robots.processes.pop((2, RECORDER)).wait()
        last_ns = robots.recorded(2)[-1][0]
        lost_s = measured("seconds lost by the kill", (killed_ns - last_ns) / NS_PER_S)
        assert lost_s < 2.0, "a second, and what a busy machine adds to it"
        robots.start_recorder(2)
        robots.wait_until_recorded(2, killed_ns)
        robots.wait(lambda: time.time_ns() > epoch_ns + round((DURATION_S + 0.5) * NS_PER_S), "the end")
        for role in (RECORDER, "agent", "plant"):
            assert [robots.end(robot, role) for robot in robots.fleet.ids] == [0, 0], robots.told()
        robots.collect()
        no_trouble_in_logs(robots.folder)
        assert "ending (SIGTERM)" in robots.log(1, RECORDER).read_text()

        own = robots.run_folder.finish(report=False).metrics
        found = merge(
            {robot: robots.recording(robot) for robot in robots.fleet.ids},
            tmp_path / "merged",
            Choice(robots.name),
        )
    assert found.robots == robots.fleet.ids
    assert all(warning.startswith("nothing was recorded of robot 2 from") for warning in found.warnings)
    assert len(found.warnings) <= 1
    metrics = found.result.metrics
    reasons = metrics["verdict"]["reasons"]
    about_others = [reason for reason in reasons if "robot 2 sent no pose" not in reason.lower()]
    assert about_others == own["verdict"]["reasons"]
    assert metrics["final_distance_error_m"] == pytest.approx(own["final_distance_error_m"], abs=1e-9)
    assert metrics["final_tracking_error_m"] == pytest.approx(own["final_tracking_error_m"], abs=1e-9)
    assert metrics["duration_s"] == own["duration_s"]
    assert rebuild(tmp_path / "merged").metrics == metrics


@pytest.mark.long
def test_two_recorders_do_not_share_a_folder(tmp_path: Path) -> None:
    with placed(make_fleet("pair", *CALM)) as fleet, Recorded(fleet, tmp_path / "r") as robots:
        robots.start_recorder(1)
        wait_for(lambda: "recording into" in robots.log(1, RECORDER).read_text(), "it records")
        first = robots.processes[1, RECORDER]
        robots.start_recorder(1)
        assert robots.processes[1, RECORDER].wait(PATIENCE_S) == 1
        assert robots.log(1, RECORDER).read_text().endswith(": another process is recording there\n")
        assert first.poll() is None
