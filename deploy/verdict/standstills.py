"""What stood still when nothing came of robots: machine, plants, agents, router, or what records (PURE).

An agent counts for how long its own loop stood (`stood_ms`), and how many hand states it has received. That
tells who stood: a machine makes many processes late at once; an agent that is frozen alone stands while the
others are on time; where a router passes nothing on, all agents are on time, and none hears the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis.gaps import is_lost
from handfast.deploy.analysis.presence import downs
from handfast.deploy.recording.recording import Recording, once
from handfast.deploy.recording.tables import StatusTable
from handfast.deploy.verdict.lateness import grown, made_late, stood_s

STALL_S: Final = 0.5
"""What says nothing, or does not run, for longer than this stood still."""
ALONE_SHARE: Final = 3
"""Where more agents of a machine than one in so many, and more than one, do not run, it is the machine: one
that is too slow makes most of them stand for a quarter as long as the worst (17 to 29 of 30, measured)."""
USUAL_S: Final = 3.0
"""How much an agent received in so long before says what is usual."""


class Cause(Enum):
    """Why no robot of a machine sent a pose: the end of a sentence that says so."""

    MACHINE = "their machine stood still"
    PLANTS = "their plants stood still, while their agents ran"
    ROUTER = "their router passed nothing on, while their agents ran"
    NETWORK = "their network carried nothing, while their agents ran"
    RECORDING = "the program that records heard nothing, while their agents ran and heard each other"


class Stall(NamedTuple):
    """A time in which no robot of a machine sent a pose; `host` is its name in the fleet file, "" without."""

    host: str
    start_s: float
    end_s: float
    cause: Cause

    @property
    def lasts_s(self) -> float:
        return self.end_s - self.start_s


class Stand(NamedTuple):
    """The agent of a robot stood still for `lasts_s`, while its machine ran: most others did."""

    robot: int
    start_s: float
    lasts_s: float

    @property
    def end_s(self) -> float:
        return self.start_s + self.lasts_s


class _Account(NamedTuple):
    """What an agent's statuses say of a span: whether its loop stood for most of it, whether statuses came
    all the while, whether these told of a plant in trouble, and whether it went on hearing other robots."""

    stood: bool
    spoke: bool
    lacked_plant: bool
    heard: bool


def machines(recording: Recording) -> Mapping[str, Sequence[int]]:
    """The robots of each machine, by the name of its host."""
    found: dict[str, list[int]] = {}
    for robot in recording.ids:
        found.setdefault(recording.fleet.robot(robot).host or "", []).append(robot)
    return found


@once
def stalls(recording: Recording) -> Sequence[Stall]:
    """The times in which nothing came of the robots of a machine, of those that went on before the end, and
    had more than one robot: a plant that hangs is no machine."""
    if recording.mode == "simulate":
        return []
    found = []
    for host, ids in machines(recording).items():
        if len(ids) < 2:
            continue
        times = np.unique(np.concatenate([recording.robots[robot].body.t for robot in ids]))
        times = times[: int(np.searchsorted(times, recording.end_s, side="right"))]
        paused = [down for robot in ids for down in downs(recording, robot, "plant")]
        for k in np.flatnonzero(np.diff(times) > STALL_S).tolist():
            start_s, end_s = float(times[k]), float(times[k + 1])
            on_purpose = any(down.start_s < end_s and down.end_s > start_s - STALL_S for down in paused)
            if end_s > 0.0 and not on_purpose and not is_lost(recording, start_s, end_s):
                found.append(Stall(host, start_s, end_s, _cause(recording, ids, start_s, end_s)))
    return found


@once
def stood_alone(recording: Recording) -> Sequence[Stand]:
    """The agents that stood still while most others of their machine, and of its plants, ran, and that nobody
    had made stand on purpose."""
    if recording.mode == "simulate":
        return []
    found = []
    for ids in machines(recording).values():
        for robot in ids:
            status, made = recording.robots[robot].status, made_late(recording, robot)
            for k in np.flatnonzero(np.diff(status.t) > STALL_S).tolist():
                start_s, lasts_s = float(status.t[k]), stood_s(recording, status, k, k + 1)
                end_s = start_s + lasts_s
                if (
                    lasts_s > STALL_S
                    and end_s > 0.0
                    and not any(each.makes_stand(start_s, end_s) for each in made)
                    and _runs(recording, ids, start_s, end_s)
                ):
                    found.append(Stand(robot, start_s, lasts_s))
    return found


def _cause(recording: Recording, ids: Sequence[int], start_s: float, end_s: float) -> Cause:
    """Why nothing came of these robots of a machine, by what most of their agents say."""
    said = [
        _account(recording, recording.robots[robot].status, start_s, end_s)
        for robot in ids
        if len(recording.robots[robot].status)
    ]

    def most(count: int) -> bool:
        return 2 * count > len(said)

    if not said or most(sum(each.stood for each in said)):
        return Cause.MACHINE
    if most(sum(each.spoke and each.lacked_plant for each in said)):
        return Cause.PLANTS
    if most(sum(each.heard for each in said)):
        return Cause.RECORDING
    return Cause.ROUTER if recording.fleet.is_routed else Cause.NETWORK


def _account(recording: Recording, status: StatusTable, start_s: float, end_s: float) -> _Account:
    """See `_Account`: from the last status before the span to the first after it."""
    before, after = _around(status, start_s, end_s)
    within = np.flatnonzero((status.t > start_s) & (status.t < end_s)).tolist()
    holes = np.diff([start_s, *status.t[within].tolist(), end_s])
    span_s = end_s - start_s
    usually = int(np.searchsorted(status.t, status.t[before] - USUAL_S))
    # What waited in a router comes after the span: where statuses are within, they tell what came in it.
    last = within[-1] if within and 2.0 * float(status.t[within[-1]] - start_s) > span_s else after
    before_s, there_s = (float(status.t[b] - status.t[a]) for a, b in ((usually, before), (before, last)))
    usual, received = (grown(status, "received", a, b) for a, b in ((usually, before), (before, last)))
    return _Account(
        2 * stood_s(recording, status, before, after) > span_s,
        2 * float(holes.max()) <= span_s,
        any(status.states[k] == State.FAULT.value for k in within),
        usual > 0 and 2 * received * before_s > usual * there_s,
    )


def _runs(recording: Recording, ids: Sequence[int], start_s: float, end_s: float) -> bool:
    """Whether a machine ran in a span in which one of its agents stood: most others, and most of its plants,
    went on. Agents have more to do than plants, so that it is they who tell."""
    stood = hung = 0
    for robot in ids:
        status, t = recording.robots[robot].status, recording.robots[robot].body.t
        if len(status):
            before, after = _around(status, start_s, end_s)
            stood += 4 * stood_s(recording, status, before, after) > end_s - start_s
        times = t[(t > start_s) & (t < end_s)].tolist()
        hung += 2 * float(np.diff([start_s, *times, end_s]).max()) > end_s - start_s
    return stood <= max(1, len(ids) // ALONE_SHARE) and 2 * hung <= len(ids)


def _around(status: StatusTable, start_s: float, end_s: float) -> tuple[int, int]:
    """The last status before a span, and the first after it."""
    before = max(int(np.searchsorted(status.t, start_s, side="right")) - 1, 0)
    return before, min(int(np.searchsorted(status.t, end_s)), len(status) - 1)
