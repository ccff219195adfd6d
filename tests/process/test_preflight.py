"""`handfast preflight` of a simulated rover behind a real socket."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

from tests.process.harness import ADDRESS, environment, wait_for


def test_parameters_that_are_off_are_written_for_a_ground_station(tmp_path: Path) -> None:
    said = tmp_path / "said"
    simulator = (
        sys.executable,
        "-P",
        "-m",
        "handfast.bridges.mavlink.simulator",
        f"--listen=tcp:{ADDRESS}:0",
    )
    with (
        said.open("wb") as stderr,
        subprocess.Popen([*simulator, "--warm"], env=environment(), stderr=stderr) as process,
    ):
        try:
            listens = re.compile(r"listens on tcp:.*:(\d+)")
            port = wait_for(lambda: listens.search(said.read_text()), "the simulator")[1]
            sets = [f"--set=robot.1.mavlink.connection=tcp:{ADDRESS}:{port}"]
            sets += [f"--set=robot.{robot}.plant=unicycle" for robot in range(2, 7)]
            looked = subprocess.run(
                [sys.executable, "-P", "-m", "handfast.deploy.cli", "preflight", "rovers", "--json", *sets],
                env=environment(), cwd=tmp_path, capture_output=True, text=True, timeout=60.0,
            )  # fmt: skip
        finally:
            process.kill()
    assert looked.returncode == 0, looked
    lines = json.loads(looked.stdout)["robots"][0]["lines"]
    assert ["FS_CRASH_CHECK", "warning"] in [[line["name"], line["level"]] for line in lines]
    assert "Robot 1: parameters to change are in rovers-parameters/robot-N.param." in looked.stderr
    values = (tmp_path / "rovers-parameters/robot-1.param").read_text().splitlines()
    assert [line for line in values if line[0] != "#"] == ["FS_CRASH_CHECK,1", "BATT_FS_LOW_ACT,2"]
