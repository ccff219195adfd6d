"""Robots that were not at their places, and what kept them, as far as the recording tells.

Their edges may all be right then, as when a whole formation falls behind a course that is too fast. A robot
that was not at its place (`deploy.analysis.places`) in all of the last `LAST_S` fails the verdict, unless it
is too early to say: something happened to the fleet less than `RECOVERED_S` ago, or the robot was never there
yet or kept from there of late, and will be there as soon at the rate at which it comes nearer. A place that
moves faster than robots may is never too early to say. Robots that are off alike only warn. Robots that could
not follow are not judged: released, stopped, killed, in fault.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Final

import numpy as np

from handfast.agent.control.limits import speed_max
from handfast.agent.fleet.fault_rules import ACTION_FIELDS
from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.deploy.analysis.analysis import Analysis, norm
from handfast.deploy.analysis.places import LAST_S, allowed_m, distances_m, rest_shapes, together
from handfast.deploy.analysis.presence import Flags, downs, kept_through, said
from handfast.deploy.console.wording import robots, speed_limit
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.missing import last_states
from handfast.deploy.verdict.oracles_drive import RECOVERED_S
from handfast.deploy.verdict.violations import REACTION_S, is_constant, windows

LONG_S: Final = 10.0
"""Time off its place above which a robot fell behind in mid-drive, s."""
CAUSES_MAX: Final = 8
"""Maximum number of causes that are said one by one."""
FIRST_S: Final = 5.0
"""A robot that is off its place from earlier on has not been there yet, s."""
LOOK_S: Final = 2.0
"""Time before a moment in which it is looked what held a robot, s."""
WORDS_S: Final = 5.0
"""Age up to which an agent's reason may still be why its robot is where it is, s."""
SILENT_S: Final = 2.0
"""Age of its last status above which an agent is silent, s."""
SHARE: Final = 0.1
"""Share of a robot's ticks in which the safety filter acted above which something held the robot."""
FAST: Final = 0.8
"""Share of the greatest speed above which a place is hard to catch up with."""
_DROVE: Final = DRIVING_NAMES | {State.STOPPING.value, State.STOPPED.value}
_START_S: Final = 0.5
_LIMITS: Final[Mapping[str, str]] = {
    "speed": "control.max_speed_mps",
    "actuators": "max_force_n or max_torque_nm",
    "turning": "the greatest yaw rate",
    "acceleration": "control.max_acceleration",
    "late links": "what late messages allow",
}
"""What the safety filter calls the limits of motion, and what sets them."""


@dataclass(frozen=True)
class Off:
    """A robot that is not at its place at the end.

    Attributes:
        causes: what keeps it, in words.
        comes: it comes nearer.
        excused: it is off alike with the others, or it is too early to say.
        together: it is off as all are, and not too far.
    """

    index: int
    distance_m: float
    causes: str
    comes: bool
    excused: bool
    together: bool


class Tracking:
    """Robots that are not at their places at the end of a drive, and that fell behind before."""

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording, self._a = recording, a
        self._allowed_m, self._distances = allowed_m(a), distances_m(a)
        self._far: Flags = kept_through(self._distances > self._allowed_m, a.unknown)  # False for NaN
        self.off: Sequence[Off] = tuple(self._at_the_end())

    @property
    def reasons(self) -> list[str]:
        """Sentences that fail the verdict, one for all robots with the same causes."""
        out = []
        for why, each in _by_causes([off for off in self.off if not off.excused]):
            comes = all(off.comes for off in each)
            unsaid = "on the way, and coming nearer" if comes else "the recording does not say why"
            out.append(f"{self._how_far(each)}: {why or unsaid}.")
        return out

    @property
    def warnings(self) -> list[str]:
        """Sentences for robots that are off alike, or of which it is too early to say."""
        out = []
        if alike := [off for off in self.off if off.excused and off.together]:
            out.append(f"{self._how_far(alike)}: the formation as a whole, which was right in itself.")
        for why, each in _by_causes([off for off in self.off if off.excused and not off.together]):
            coming = ", and coming nearer" if all(off.comes for off in each) else ""
            why = f": {why}" if why else ""
            out.append(f"{self._how_far(each)}{coming}{why}. The drive ended too early to judge that.")
        return out + self.behind

    @property
    def behind(self) -> list[str]:
        """A sentence if robots fell behind in mid-drive, though nothing had happened or was in their way."""
        a, found = self._a, []
        for index, robot in enumerate(a.ids):
            for first, last in _stretches(self._far[:, index]):
                start_s, end_s = float(a.grid[first]), float(a.grid[last])
                if end_s - start_s > LONG_S and start_s > FIRST_S and last < len(a.grid) - 1:
                    row = first + int(np.nanargmax(self._distances[first : last + 1, index]))
                    if not self._is_explained(robot, first, last, row):
                        found.append((float(self._distances[row, index]), robot, start_s, end_s))
        if not found:
            return []
        distance_m, robot, start_s, end_s = max(found)
        others = sorted({each[1] for each in found} - {robot})
        more = f" (so did {robots(others)})" if others else ""
        return [
            f"Robot {robot} was off its place from {start_s:.1f} s to {end_s:.1f} s, by up to "
            f"{distance_m:.2f} m{more}."
        ]

    def causes(self, index: int) -> str:
        """What keeps a robot from its place at the end, or else its neighbours; "" if unknown."""
        if own := self._own_causes(index):
            return "; ".join(own)
        ends = sorted({other for edge in self._edges if index in edge for other in edge} - {index})
        kept = [
            f"robot {self._a.ids[other]} ({why[0]})" for other in ends if (why := self._own_causes(other))
        ]
        return f"held back by {' and '.join(kept)}" if kept else ""

    @cached_property
    def _edges(self) -> list[list[int]]:
        """Edges in force at the end."""
        edges: list[list[int]] = self._a.edges[np.isfinite(self._a.wanted[-1])].tolist()
        return edges

    @cached_property
    def _shapes(self) -> list[list[int]]:
        return rest_shapes(self._a, self._recording.fleet, self._far[-1])

    def _own_causes(self, index: int) -> list[str]:
        """The robot's shape at rest, its agent's silence and last reason, what held it up, limits."""
        recording, a, t = self._recording, self._a, float(self._a.grid[-1])
        robot, limit = a.ids[index], speed_limit(recording.fleet)
        shapes = [shape for shape in self._shapes if index in shape]
        found = [
            f"{robots([a.ids[each] for each in shape])} are at rest in another shape" for shape in shapes
        ]
        if silent_s := self._silent_s(robot):
            found.append(f"its agent has said nothing for {silent_s:.0f} s")
        told = self._last_words(robot)
        found += [told] if told else []
        held = held_by(recording, robot, t - LOOK_S, t)
        held = [name for name in held if f"{name} " not in f"{told} "]
        keepers = [f"{name}{self._silence(name)}" for name in held if name not in _LIMITS]
        found += [f"held up by {' and '.join(keepers)}"] if keepers else []
        limits = [_LIMITS[name] for name in held if name in _LIMITS and name not in told]
        found += [f"at the limit of {' and of '.join(limits)}"] if limits else []
        if (fast_mps := self._place_speed(index)) > FAST * speed_max(recording.fleet):
            found.append(f"places move at {fast_mps:.2f} m/s and the limit is {limit}")
        return found

    def _last_words(self, robot: int) -> str:
        """The last reason of an agent, and until when if it gives none any more; "" if that is long ago."""
        status, t = self._recording.robots[robot].status, float(self._a.grid[-1])
        rows = np.flatnonzero((status.t > max(t - WORDS_S, 0.0)) & (status.t <= t)).tolist()
        for row in reversed(rows):
            if status.reasons[row]:
                until = "" if row == rows[-1] else f" until {status.t[row]:.1f} s"
                return f"{status.reasons[row]}{until}"
        return ""

    def _silence(self, name: str) -> str:
        """For how long something that holds a robot up is silent, if it is a robot and is."""
        kind, _, number = name.partition(" ")
        known = kind == "robot" and number.isdigit() and int(number) in self._recording.robots
        silent_s = self._silent_s(int(number)) if known else 0.0
        return f" (silent for {silent_s:.0f} s)" if silent_s else ""

    def _silent_s(self, robot: int) -> float:
        """For how long an agent has sent no status, s; 0 if that is usual."""
        times, t = self._recording.robots[robot].status.t, float(self._a.grid[-1])
        heard = times[times <= t]
        silent_s = t - max(float(heard[-1]), 0.0) if len(heard) else t
        return silent_s if silent_s > SILENT_S else 0.0

    def _place_speed(self, index: int) -> float:
        """Mean speed of a robot's place in the last `LOOK_S`, m/s; 0 without one."""
        places, grid = self._a.desired[:, index], self._a.grid
        first = int(np.searchsorted(grid, grid[-1] - LOOK_S))
        moved_m, span_s = float(norm(places[-1] - places[first])), float(grid[-1] - grid[first])
        return moved_m / span_s if span_s > 0.0 and np.isfinite(moved_m) else 0.0

    def _how_far(self, group: Sequence[Off]) -> str:
        a = self._a
        worst = max(group, key=lambda off: off.distance_m)
        ids = [a.ids[off.index] for off in group]
        end = f"at the end ({a.grid[-1]:.1f} s), where {self._allowed_m:.2f} m is allowed"
        if len(ids) == 1:
            return f"Robot {ids[0]} was {worst.distance_m:.2f} m from its place {end}"
        most = f"up to {worst.distance_m:.2f} m (robot {a.ids[worst.index]})"
        return f"{robots(ids).capitalize()} were {most} from their places {end}"

    def _at_the_end(self) -> Iterator[Off]:
        recording, a = self._recording, self._a
        end_s = float(a.grid[-1])
        lately = a.grid >= end_s - LAST_S
        known = np.isfinite(self._distances[-1])  # else its poses end before the drive, which is said
        alike, lasts = together(a), last_states(recording)
        troubles = [each for each in self._troubles if each[1] + RECOVERED_S >= end_s]
        for index in np.flatnonzero(self._far[lately].all(axis=0) & known).tolist():
            robot = a.ids[index]
            state, last = recording.robots[robot].status.at(end_s), lasts[robot]
            if (state and state[0] not in DRIVING_NAMES) or (last and last[0] not in _DROVE):
                continue  # which is said in its own words
            since_s = float(a.grid[_stretches(self._far[:, index])[-1][0]])
            never, near = since_s <= FIRST_S, self._distances[lately, index]
            near = near[np.isfinite(near)]
            rate_mps = float(near[0] - near[-1]) / min(LAST_S, end_s)
            due_s = float(near[-1]) / rate_mps if rate_mps > 0.0 else inf
            troubled = never and end_s <= RECOVERED_S
            troubled |= any(start_s <= since_s + REACTION_S for start_s, _ in troubles)
            begun = never or bool(troubles or kept_from(recording, robot, end_s - RECOVERED_S, end_s))
            excused = troubled or (begun and due_s <= RECOVERED_S) or bool(alike[index])
            excused &= self._place_speed(index) <= speed_max(recording.fleet)
            distance_m = float(self._distances[-1, index])
            yield Off(index, distance_m, self.causes(index), due_s < inf, excused, bool(alike[index]))

    def _is_explained(self, robot: int, first: int, last: int, row: int) -> bool:
        """Whether something had happened before a robot fell behind, or kept it when it was farthest off."""
        recording, grid = self._recording, self._a.grid
        after, worst_s = float(grid[first]) + REACTION_S, float(grid[row])
        return (
            any(start_s <= after <= until_s + RECOVERED_S for start_s, until_s in self._troubles)
            or bool(kept_from(recording, robot, worst_s - LOOK_S, worst_s))
            or not said(recording.robots[robot].status, grid[first : last + 1], DRIVING_NAMES).all()
        )

    @property
    def last_trouble_s(self) -> float | None:
        """When what happened to the fleet last was over; None when nothing did."""
        return max((until_s for _, until_s in self._troubles), default=None)

    @cached_property
    def _troubles(self) -> list[tuple[float, float]]:
        """Times (start, end) in which something happened to the fleet: faults that do not always hold,
        changes of mission, orders to stand, processes that came or went, robots that could follow again."""
        recording, a = self._recording, self._a
        end_s = recording.end_s
        found = [(settled.change.t_s, settled.change.t_s) for settled in a.changes]
        found += [
            (span.start_s, min(span.end_s, end_s))
            for span in windows(recording)
            # What is killed for good is a fault of one moment, which the process's own times tell.
            if not is_constant(span.rule) and not span.rule.given(ACTION_FIELDS)
        ]
        for index, robot in enumerate(recording.ids):
            found += [(start, min(end, end_s)) for start, end in recording.halts(robot)]
            lost = [down for role in ("agent", "plant") for down in downs(recording, robot, role)]
            found += [(t, t) for down in lost for t in (down.start_s, down.end_s)]
            found += [(t, t) for t in a.grid[1:][np.diff(a.away[:, index])].tolist()]
            holds = recording.robots[robot].status.periods(State.HOLDING.value)
            found += [(end, end) for _, end, _ in holds if end is not None]
        return [(start_s, until_s) for start_s, until_s in found if start_s <= end_s and until_s > _START_S]


def held_by(recording: Recording, robot: int, start_s: float, end_s: float) -> list[str]:
    """Return what made the safety filter change what a robot's law asked for in more than a few ticks, most
    often first: ``robot 3``, an obstacle's name, one of `_LIMITS`."""
    status, start = recording.robots[robot].status, "filtered."
    within = np.flatnonzero((status.t > start_s) & (status.t <= end_s))
    if not len(within):
        return []
    first, last = max(int(within[0]) - 1, 0), int(within[-1])
    counts = Counter(status.counters[last])
    counts.subtract(status.counters[first])
    ticks = float(status.t[last] - status.t[first]) * recording.fleet.fleet.rate_hz
    return [
        name.removeprefix(start)
        for name, count in counts.most_common()
        if name.startswith(start) and name != f"{start}any" and count > SHARE * ticks
    ]


def kept_from(recording: Recording, robot: int, start_s: float, end_s: float) -> list[str]:
    """Return those of `held_by` that are robots, obstacles or the geofence."""
    return [name for name in held_by(recording, robot, start_s, end_s) if name not in _LIMITS]


def _by_causes(found: Sequence[Off]) -> list[tuple[str, list[Off]]]:
    """Those with the same causes together. Of many causes the rest are one, as on a machine that is too slow,
    where each of two hundred robots gives another reason."""
    groups: dict[str, list[Off]] = {}
    for off in sorted(found, key=lambda off: off.distance_m, reverse=True):
        groups.setdefault(off.causes, []).append(off)
    listed = list(groups.items())
    rest = sorted((off for _, each in listed[CAUSES_MAX:] for off in each), key=lambda off: off.index)
    out = [(why, sorted(each, key=lambda off: off.index)) for why, each in listed[:CAUSES_MAX]]
    return [*out, (f"for {len(listed) - CAUSES_MAX} more reasons like these", rest)] if rest else out


def _stretches(flags: Flags) -> list[tuple[int, int]]:
    """(first, last) row of every stretch of true ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(after) - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)]
