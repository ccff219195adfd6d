"""A rover whose way leads through one that has gone silent goes round it, and says so.

Real autopilots: a rover behind one that nobody heard any more stood for 36 s without a word, and drove on at
once when the other was heard.
"""

from __future__ import annotations

from itertools import pairwise
from math import remainder, tau
from typing import Final

import numpy as np
import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.recording.recording import Recording
from handfast.deploy.sweep.run import drive

SILENT, FOLLOWERS = 1, (2, 3)
SILENT_S, UNTIL_S, DURATION_S = 8.0, 44.0, 50.0
COLUMN: Final = (
    "formation.edges=[[1,2],[2,3]]",
    "formation.offsets=[[3,0],[0,0],[-3,0]]",
    "trajectory.start_m=[0,0]",
    "trajectory.velocity_mps=[0.34,0]",
    *(
        f"robot.{robot}.{axis}_m={at}"
        for robot, x in ((1, 2.6), (2, -0.4), (3, -3.4))
        for axis, at in (("x", x), ("y", 0.0))
    ),
    f"fleet.duration_s={DURATION_S}",
)
"""Three rovers, one behind the other, on a course through where the first will stand."""
STANDS_MPS, SOON_S = 0.06, 3.0


def driven(rule: str) -> Recording:
    text = (FLEETS / "rovers.toml").read_text(encoding="utf-8")
    text = "[[robot]]".join(text.split("[[robot]]")[:4]) + f"\n[[faults.rule]]\n{rule}\n"
    return drive(resolved(parse_fleet(text, source="here", overrides=COLUMN)), lambda: True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "rule",
    [
        f'partition = "alone {SILENT}"\nat = {SILENT_S}\nfor = {UNTIL_S - SILENT_S}',
        f'kill = "both"\nrobot = {SILENT}\nat = {SILENT_S}',
    ],
    ids=["cut off", "killed"],
)
def test_who_comes_behind_it_goes_round_it_and_says_so(rule: str) -> None:
    recording = driven(rule)
    times = np.arange(SILENT_S, UNTIL_S, 0.1)
    for robot in FOLLOWERS:
        data = recording.robots[robot]
        x, y, heading = (np.interp(times, data.body.t, data.body[name]) for name in ("x", "y", "heading"))
        speed = np.hypot(np.gradient(x, times), np.gradient(y, times))
        said = [(data.status.at(float(t)) or ("", ""))[1] for t in times]
        assert any(f"on its way round robot {SILENT}" in text for text in said)
        begun = 0
        for row, standing in enumerate(speed < STANDS_MPS):
            if not standing or f"robot {SILENT}" in said[row]:
                begun = row
            assert times[row] - times[begun] < SOON_S, f"robot {robot} stands at {times[row]:.1f} s, silently"
        turns = sum(remainder(after - before, tau) for before, after in pairwise(heading))
        assert abs(turns) < 0.5 * tau, "it goes past, and not round and round"
        place = 0.34 * UNTIL_S - (0.0 if robot == 2 else 3.0)
        assert np.hypot(x[-1] - place, y[-1]) < 1.0, "and is back in its place"
    a, b = (recording.hand_positions(times)[:, recording.ids.index(robot)] for robot in FOLLOWERS)
    dead = recording.hand_positions(times)[:, recording.ids.index(SILENT)]
    for one, other in ((a, b), (a, dead), (b, dead)):
        assert np.nanmin(np.hypot(*(one - other).T)) >= recording.fleet.formation.safe_distance_m
