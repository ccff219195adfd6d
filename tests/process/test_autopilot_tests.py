"""The tests that wait for real autopilots, against simulated rovers: so that they are known to run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from handfast.deploy.processes.placement import Reservation
from tests.process.harness import ADDRESS, ROOT, environment, last_lines, no_trouble

pytestmark = pytest.mark.long

BASE_PORT = 26_368
LIMIT_S = 200.0
BOOT_S = 10.0


@pytest.mark.slow
@pytest.mark.timeout(LIMIT_S + 60.0)
def test_the_tests_for_autopilots_pass_against_simulated_rovers(tmp_path: Path) -> None:
    """Switched on as they begin, disarmed; one has a second port for the operator, the other has not."""
    ports = Reservation(ADDRESS, BASE_PORT, 3)
    first, second, other = (f"tcp:{ADDRESS}:{ports.base + k}" for k in range(3))
    rovers = [
        (f"--listen={first}", f"--listen={second}", "--system=1", "--home=-35.363261,149.165230,584,30"),
        (f"--listen={other}", "--system=2", "--home=-35.363261,149.165270,584,100"),
    ]
    simulator = [
        sys.executable,
        "-P",
        "-m",
        "handfast.bridges.mavlink.simulator",
        f"--boot={BOOT_S}",
        "--exit-with-parent",
    ]
    started = []
    log = tmp_path / "pytest.log"
    try:
        for number, arguments in enumerate(rovers):
            with open(tmp_path / f"rover-{number}.log", "wb") as err:
                started.append(
                    subprocess.Popen(
                        [*simulator, *arguments], stdin=subprocess.DEVNULL, stderr=err, env=environment()
                    )
                )
        chosen = "vehicle2 or operator_wins or one_world"
        with open(log, "wb") as out:
            run = subprocess.run(
                [
                    sys.executable,
                    "-m",
                    "pytest",
                    "-q",
                    "-p",
                    "no:cacheprovider",
                    "tests/autopilot",
                    "-k",
                    chosen,
                ],
                cwd=ROOT,
                env=environment() | {"HANDFAST_AUTOPILOTS": f"{first}+{second},{other}"},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                timeout=LIMIT_S,
                check=False,
            )
    finally:
        for process in started:
            process.kill()
            process.wait()
        ports.close()
    told = "\n".join(last_lines(log, 80))
    assert run.returncode == 0, told
    assert int(re.findall(r"(\d+) passed", told)[-1]) >= 15, told
    assert "skipped" not in told, told
    for number in range(len(rovers)):
        no_trouble((tmp_path / f"rover-{number}.log").read_text(), f"rover {number}")
