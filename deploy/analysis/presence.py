"""When processes of a run were up, and when robots could follow, from what was done to them and they said."""

from __future__ import annotations

from collections.abc import Collection
from math import inf
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.formation.points import Floats
from handfast.agent.supervision.state_machine import State
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.tables import StatusTable

Flags = NDArray[np.bool_]

_AWAY: Final = frozenset({State.RELEASED.value, State.FAULT.value})


class Down(NamedTuple):
    """A process did not run from `start_s` to `end_s` (fleet time; inf: to the end). `what` was done to it
    first: ``kill`` or ``stop``."""

    start_s: float
    end_s: float
    what: str


def downs(recording: Recording, robot: int, role: str) -> list[Down]:
    """The times in which a process was killed or paused on purpose."""
    found: list[Down] = []
    is_up, is_paused = True, False
    for event in sorted(recording.events, key=lambda event: (event.time_ns, event.sequence)):
        if event.robot != robot or event.role != role:
            continue
        was_running = is_up and not is_paused
        if event.what in ("kill", "start"):
            is_up, is_paused = event.what == "start", False
        else:
            is_paused = event.what == "stop"
        runs = is_up and not is_paused
        t = recording.fleet_time_s(event.time_ns)
        if was_running and not runs:
            found.append(Down(t, inf, event.what))
        elif runs and not was_running and found:
            found[-1] = found[-1]._replace(end_s=t)
    return found


class Uncommanded(NamedTuple):
    """(k, n) each: where a vehicle went on by itself, as nothing commanded it; and where nobody steered a
    robot at all: that, or its agent was dead, so that it could do nothing for its distances."""

    rolling: Flags
    helpless: Flags


def uncommanded(recording: Recording, grid: Floats) -> Uncommanded:
    """Of whom nobody can say that they should have kept away, by what was done to them on purpose."""
    rolling = np.zeros((len(grid), len(recording.ids)), dtype=np.bool_)
    helpless = rolling.copy()
    for index, robot in enumerate(recording.ids):
        if recording.fleet.robot(robot).kind.rolls_on_s:
            for start_s, end_s in untold(recording, robot):
                rolling[:, index] |= (grid > start_s) & (grid < end_s)
        for down in downs(recording, robot, "agent"):
            helpless[:, index] |= (grid > down.start_s) & (grid <= down.end_s)
    return Uncommanded(rolling, helpless | rolling)


def untold(recording: Recording, robot: int) -> list[tuple[float, float]]:
    """The times (start s, end s) in which a robot's plant, killed or paused on purpose, told of no pose.

    A new one needs a while until it knows one.
    """
    plant = recording.robots[robot].plant
    told_s = plant.t[plant["healthy"] > 0.0]
    lost = downs(recording, robot, "plant")
    after = np.searchsorted(told_s, [down.end_s for down in lost])
    ends = np.append(told_s, inf)[after]
    return [(down.start_s, float(end_s)) for down, end_s in zip(lost, ends, strict=True)]


def said(status: StatusTable, grid: Floats, states: Collection[str]) -> Flags:
    """(k,): where the last status until then tells of one of `states`; False before the first."""
    if not len(status):
        return np.zeros(len(grid), dtype=np.bool_)
    is_one = np.array([False, *(state in states for state in status.states)])
    is_now: Flags = is_one[np.searchsorted(status.t, grid, side="right")]
    return is_now


def away(recording: Recording, grid: Floats) -> Flags:
    """(k, n): where a robot could not follow: released to its operator, in fault, ordered to stand, or its
    agent or plant killed or paused. What is not known of it is not held against it."""
    out = np.zeros((len(grid), len(recording.ids)), dtype=np.bool_)
    for index, (robot, data) in enumerate(recording.robots.items()):
        out[:, index] = said(data.status, grid, _AWAY)
        times = [
            (down.start_s, down.end_s)
            for role in ("agent", "plant")
            for down in downs(recording, robot, role)
        ]
        for start_s, end_s in [*times, *recording.halts(robot)]:
            out[:, index] |= (grid > start_s) & (grid <= end_s)
    return out
