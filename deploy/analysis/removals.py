"""When bodies were not on the field: an operator had said so, and nobody had heard their robots since."""

from __future__ import annotations

from math import inf

import numpy as np

from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.presence import Flags
from handfast.deploy.recording.recording import Recording


def carried_off(recording: Recording, grid: Floats) -> Flags:
    """(k, n): where a robot's body had been carried off, and its agent had not said a word since."""
    out = np.zeros((len(grid), len(recording.ids)), dtype=np.bool_)
    for robot, time_ns in {row for mission in recording.held_missions for row in mission.removed}:
        if robot not in recording.robots:
            continue
        since_s, said = recording.fleet_time_s(time_ns), recording.robots[robot].status.t
        after = int(np.searchsorted(said, since_s, side="right"))
        until_s = float(said[after]) if after < len(said) else inf
        out[:, recording.ids.index(robot)] |= (grid >= since_s) & (grid < until_s)
    return out
