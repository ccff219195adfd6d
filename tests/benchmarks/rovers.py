"""`handfast run rovers`: six bridges, six simulated rovers with the measured lags, six agents, for a minute.

As it stands, under delay and loss, and with three of the robots as unicycles. Distances are those of the hand
points by the rovers' own estimates, as the agents have them.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from agent.formation.geometry import resolve
from deploy.recording.mcap_reader import read_run
from deploy.recording.recording import Recording
from tests.benchmarks.figures import Figure, Options, Result
from tests.benchmarks.processes import BenchmarkError, environment, handfast

DURATION_S: Final = 60.0
WITHIN_M: Final = 0.15
LAST_S: Final = 15.0
TIMEOUT_S: Final = 300.0
STEP_S: Final = 0.05
ARMS: Final[tuple[tuple[str, tuple[str, ...], float], ...]] = (
    ("as it stands", (), 0.05),
    ("200 ms, 30 %", ("--set", "faults.delay=200ms", "--set", "faults.loss=30%"), 0.10),
    (
        "three unicycles",
        tuple(
            word
            for robot in (2, 4, 6)
            for word in ("--set", f"robot.{robot}.plant=unicycle", "--set", f"robot.{robot}.max_force_n=16")
        ),
        0.05,
    ),
)
"""Name, options, and what the worst edge may be off at last, m."""


def drive(folder: Path, options: tuple[str, ...], duration_s: float) -> Recording:
    """One run, read back from its recording."""
    command = handfast("run", "rovers", "--no-report", "--duration", str(duration_s), "--out", str(folder))
    done = subprocess.run(
        [*command, *options],
        env=environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    if done.returncode not in (0, 1):
        raise BenchmarkError(f"handfast run rovers: status {done.returncode}\n{done.stderr[-2000:]}")
    return read_run(folder)


def run(options: Options) -> Result:
    result = Result()
    duration_s = 35.0 if options.quick else DURATION_S
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        for number, (arm, settings, limit_m) in enumerate(ARMS):
            folder = Path(name) / str(number)
            recording = drive(folder, settings, duration_s)
            geometry = resolve(recording.fleet)
            grid = np.arange(0.0, duration_s, STEP_S)
            hands = recording.hand_positions(grid)
            i, j = np.asarray(geometry.edges).T
            apart = np.linalg.norm(hands[:, i] - hands[:, j], axis=-1)
            worst = np.abs(apart - geometry.distances).max(axis=1)
            off = np.flatnonzero(worst > WITHIN_M)
            settled_s = float(grid[off[-1]]) + STEP_S if len(off) else 0.0
            pairs = np.linalg.norm(hands[:, :, None] - hands[:, None], axis=-1)
            pairs[:, np.eye(pairs.shape[1], dtype=bool)] = np.inf
            verdict = json.loads((folder / "metrics.json").read_text())["verdict"]
            result.figures += [
                Figure(f"{arm}: every edge within {WITHIN_M} m after", settled_s, "s", 13.0),
                Figure(
                    f"{arm}: worst edge in the last {LAST_S:.0f} s",
                    float(worst[grid >= duration_s - LAST_S].max()),
                    "m",
                    limit_m,
                ),
                Figure(
                    f"{arm}: closest edge",
                    float(apart.min()),
                    "m",
                    recording.fleet.formation.safe_distance_m,
                    at_most=False,
                ),
                Figure(f"{arm}: closest pair of all", float(pairs.min()), "m"),
            ]
            result.details += [f"{arm}: {'passed' if verdict['passed'] else '; '.join(verdict['reasons'])}"]
    return result
