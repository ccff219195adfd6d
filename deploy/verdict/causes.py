"""What keeps a robot from its place, as far as a recording tells: in words that stand after a colon."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Final

import numpy as np

from handfast.agent.control.safety_distances import avoidance_distance, speed_max
from handfast.deploy.analysis.analysis import Analysis, norm
from handfast.deploy.analysis.balance import rest_shapes
from handfast.deploy.analysis.presence import Flags
from handfast.deploy.console.wording import robots, speed_limit
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.tables import StatusTable

LOOK_S: Final = 2.0
"""Over so long before a moment it is looked what held a robot."""
WORDS_S: Final = 5.0
"""What an agent said so long before a moment may still be why its robot is where it is."""
SHARE: Final = 0.1
"""Who changed what the law asked for in a smaller share of a robot's ticks than this did not hold it."""
FAST: Final = 0.8
"""Above this share of the greatest speed a place is hard to catch up with, and a robot as fast as it can."""
SILENT_S: Final = 2.0
"""A robot that has said nothing for so long is silent; its agent speaks five times a second."""
_NEAR: Final = 1.05
_LAST_NAME: Final = re.compile(r"robot \d+$")
_LIMITS: Final[Mapping[str, str]] = {
    "speed": "control.max_speed_mps",
    "actuators": "max_force_n or max_torque_nm",
    "turning": "the greatest yaw rate",
    "acceleration": "control.max_acceleration",
    "late links": "what late messages allow",
}
"""What the safety filter calls the limits of motion, and what sets them."""


class Causes:
    """What keeps robots from their places at a row of the grid, as far as the recording tells.

    Args:
        far: (n,) who is not at its place then.
    """

    def __init__(self, recording: Recording, a: Analysis, far: Flags, row: int = -1) -> None:
        self._recording, self._a, self._row = recording, a, row
        self._t = float(a.grid[row])
        self._shapes = rest_shapes(a, recording.fleet, far, row)
        self._edges = {
            (min(i, j), max(i, j)): float(distance)
            for (i, j), distance in zip(a.edges.tolist(), a.wanted[row].tolist(), strict=True)
            if distance == distance
        }

    def of(self, index: int) -> list[str]:
        """Of one robot, else of those that it shares edges with; empty when the recording does not say."""
        return self._own(index) or self._of_neighbours(index)

    def _own(self, index: int) -> list[str]:
        """What keeps the robot itself.

        The shape in which it is at rest (`deploy.analysis.balance`), for how long its agent has been silent,
        what that said, from whom or what the safety filter kept it, who stands before it, and how fast its
        place is.
        """
        recording, a, t = self._recording, self._a, self._t
        fleet, robot = recording.fleet, a.ids[index]
        found = [
            f"{robots([a.ids[each] for each in shape])} are at rest in another shape"
            for shape in self._shapes
            if index in shape
        ]
        silent_s = self._silent_s(robot)
        if silent_s > SILENT_S:
            found.append(f"its agent has said nothing for {silent_s:.0f} s")
        told = _last_words(recording.robots[robot].status, t)
        if told:
            named = _LAST_NAME.search(told)
            found.append(told + (self._silence(named[0]) if named else ""))
        held = held_by(recording, robot, t - LOOK_S, t)
        keepers = [name for name in held if name not in _LIMITS]
        keepers += [name for name in self._before(index) if name not in held]
        keepers = [f"{name}{self._silence(name)}" for name in keepers if f"{name} " not in f"{told} "]
        if keepers:
            found.append(f"held up by {' and '.join(keepers)}")
        most_mps, fast_mps = speed_max(fleet), self.place_speed(index)
        limits = [said for name, said in _LIMITS.items() if name in held and name not in told]
        if limits:
            found.append(f"at the limit of {' and of '.join(limits)}")
        if not limits and self._approach(index) > FAST * most_mps:
            found.append(f"as fast as {speed_limit(fleet)} allows")
        if fast_mps > FAST * most_mps:
            found.append(f"places move at {fast_mps:.2f} m/s and the limit is {speed_limit(fleet)}")
        return found

    def _of_neighbours(self, index: int) -> list[str]:
        """Those at the other ends of its edges that something keeps, each with the first thing that does."""
        ends = [each for edge in self._edges if index in edge for each in edge if each != index]
        kept = [(self._a.ids[other], why) for other in sorted(ends) if (why := self._own(other))]
        return (
            [f"held back by {' and '.join(f'robot {robot} ({why[0]})' for robot, why in kept)}"]
            if kept
            else []
        )

    def place_speed(self, index: int) -> float:
        """Mean speed of a robot's place in the last `LOOK_S`, m/s; 0 without one."""
        return self._mean(
            lambda first: norm(self._a.desired[self._row, index] - self._a.desired[first, index])
        )

    def _approach(self, index: int) -> float:
        """By how much a robot came nearer to its place in a second of the last `LOOK_S`, m/s."""
        away = norm(self._a.desired[:, index] - self._a.hands[:, index])
        return self._mean(lambda first: away[first] - away[self._row])

    def _mean(self, over: Callable[[int], Any]) -> float:
        """What changed from a row of the grid `LOOK_S` ago until now, in a second; 0 where unknown."""
        grid = self._a.grid
        first = int(np.searchsorted(grid, self._t - LOOK_S))
        span_s, changed = self._t - float(grid[first]), float(over(first))
        return changed / span_s if span_s > 0.0 and np.isfinite(changed) else 0.0

    @cached_property
    def _near_m(self) -> float:
        """From where on robots without an edge push each other apart (U1), m."""
        places = self._a.desired[self._row]
        members = np.flatnonzero(np.isfinite(places[:, 0])).tolist()
        offsets = {each: (float(places[each, 0]), float(places[each, 1])) for each in members}
        avoidance = self._recording.fleet.avoidance
        if not avoidance.enabled:
            return 0.0
        return _NEAR * avoidance_distance(avoidance.distance_m, self._a.safe_m, self._edges, offsets)

    def _before(self, index: int) -> list[str]:
        """Robots without an edge to this one that it pushes against: on the side of its place."""
        a, hands = self._a, self._a.hands[self._row]
        apart = hands - hands[index]
        ahead = apart @ (a.desired[self._row, index] - hands[index]) > 0.0  # False for NaN
        close = np.flatnonzero(ahead & (norm(apart) < self._near_m)).tolist()
        return [
            f"robot {a.ids[other]}"
            for other in close
            if (min(index, other), max(index, other)) not in self._edges
        ]

    def _silence(self, name: str) -> str:
        """What is to be said of who holds a robot up: for how long it is silent, if it is a robot and is."""
        kind, _, number = name.partition(" ")
        if kind != "robot" or not number.isdigit() or int(number) not in self._recording.robots:
            return ""
        silent_s = self._silent_s(int(number))
        return f" (silent for {silent_s:.0f} s)" if silent_s > SILENT_S else ""

    def _silent_s(self, robot: int) -> float:
        """Since when the robot's agent has said nothing, s; since the drive began if it never did."""
        times = self._recording.robots[robot].status.t
        heard = times[times <= self._t]
        return self._t - max(float(heard[-1]), 0.0) if len(heard) else self._t


def _last_words(status: StatusTable, t: float) -> str:
    """The reason that an agent gave for its state last, and until when if it gives none any more; empty when
    it has given none for `WORDS_S`, nor since the drive began."""
    rows = np.flatnonzero((status.t > max(t - WORDS_S, 0.0)) & (status.t <= t)).tolist()
    for row in reversed(rows):
        if status.reasons[row]:
            until = "" if row == rows[-1] else f" until {status.t[row]:.1f} s"
            return f"{status.reasons[row]}{until}"
    return ""


def held_by(recording: Recording, robot: int, start_s: float, end_s: float) -> list[str]:
    """Names of what made the safety filter change what a robot's law asked for in more than a few ticks, most
    often first: ``robot 3``, an obstacle's, one of `_LIMITS`."""
    status = recording.robots[robot].status
    within = np.flatnonzero((status.t > start_s) & (status.t <= end_s))
    if not len(within):
        return []
    first, last = max(int(within[0]) - 1, 0), int(within[-1])
    counts = Counter(status.counters[last])
    counts.subtract(status.counters[first])
    ticks = (float(status.t[last]) - float(status.t[first])) * recording.fleet.fleet.rate_hz
    start = "filtered."
    return [
        name.removeprefix(start)
        for name, count in counts.most_common()
        if name.startswith(start) and name != f"{start}any" and count > SHARE * ticks
    ]


def kept_from(recording: Recording, robot: int, start_s: float, end_s: float) -> list[str]:
    """Those of `held_by` that are robots, obstacles or the geofence."""
    return [name for name in held_by(recording, robot, start_s, end_s) if name not in _LIMITS]
