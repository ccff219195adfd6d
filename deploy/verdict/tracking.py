"""Whether all robots are at their places in the end, and if not, what keeps them: sentences for the verdict.

A formation may have all its distances and be nowhere near where it should be: behind a course that is too
fast for it, say. Who is not at its place (`deploy.analysis.places`) in all of the last `LAST_S` fails the
verdict, unless that is too early to say: it is off its place since something happened to the fleet less
than `RECOVERED_S` ago, or it has never been there yet, or was kept from it of late, and will be there as
soon as that at the rate at which it comes nearer. A place that moves faster than robots may is never too
early to say. Those who are off `together` only warn. Robots that could not follow are not judged: released
to their operators, ordered to stand, killed, in fault.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.control.safety_distances import speed_max
from handfast.agent.fleet.fault_rules import ACTION_FIELDS
from handfast.agent.formation.points import Floats
from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.gaps import kept_through
from handfast.deploy.analysis.places import LAST_S, allowed_m, distances_m, together
from handfast.deploy.analysis.presence import Flags, downs, said
from handfast.deploy.console.wording import robots
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.causes import LOOK_S, Causes, kept_from
from handfast.deploy.verdict.completeness import last_states
from handfast.deploy.verdict.oracles_drive import RECOVERED_S
from handfast.deploy.verdict.violations import REACTION_S, is_constant, windows

LONG_S: Final = 10.0
"""Who was off its place for longer than this in mid-drive fell behind."""
CAUSES_MAX: Final = 8
"""So many causes are told one by one."""
FIRST_S: Final = 5.0
"""A course may begin at full speed: who is off its place from so early on has not been there yet."""
_DROVE: Final = DRIVING_NAMES | {State.STOPPING.value, State.STOPPED.value}
"""States in which a drive ends for who drove until then."""
_START_S: Final = 0.5
"""What is over so soon after the start has not happened to a fleet that drove."""


@dataclass(frozen=True)
class Off:
    """A robot that is not at its place at the end.

    Attributes:
        index: of the robot.
        distance_m: how far it is from there.
        causes: what keeps it, in words.
        due_s: how soon it will be there as it comes nearer; inf: it does not.
        troubled: it is off its place since something happened to the fleet that lasted until `RECOVERED_S`
            before the end, or longer; the start is such a thing.
        begun: it was never there yet; or, in the last `RECOVERED_S`, was kept from it, or something happened.
        too_fast: its place moves faster than robots may.
        together: it is off as all are, and not too far.
    """

    index: int
    distance_m: float
    causes: tuple[str, ...]
    due_s: float
    troubled: bool
    begun: bool
    too_fast: bool
    together: bool

    @property
    def excused(self) -> bool:
        """Whether it is near enough with the others, or it is too early to say."""
        early = self.troubled or (self.begun and self.due_s <= RECOVERED_S)
        return not self.too_fast and (early or self.together)


class _Behind(NamedTuple):
    """A robot that was off its place for a while, and by how much at the worst moment."""

    distance_m: float
    robot: int
    start_s: float
    end_s: float
    worst_s: float


class Tracking:
    """Who is not at its place at the end of a drive, and who fell behind before.

    Attributes:
        off: robots that are not there at the end, of those that drove.
    """

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording, self._a = recording, a
        self._allowed_m = allowed_m(a)
        self._distances = distances_m(a)
        self._far: Flags = kept_through(self._distances > self._allowed_m, a.unknown)  # False for NaN
        self.off: Sequence[Off] = tuple(self._at_the_end())

    @cached_property
    def causes(self) -> Causes:
        """What kept robots from their places at the end."""
        return Causes(self._recording, self._a, self._far[-1])

    @property
    def reasons(self) -> list[str]:
        """Sentences that fail the verdict, one for all robots with the same cause."""
        out = []
        for why, each in _by_cause([off for off in self.off if not off.excused]):
            comes = all(off.due_s < inf for off in each)
            unsaid = "on the way, and coming nearer" if comes else "the recording does not say why"
            out.append(f"{self._how_far(each)}: {'; '.join(why) or unsaid}.")
        return out

    @property
    def warnings(self) -> list[str]:
        """Sentences for those of whom it is too early to say, and for those that fell behind in mid-drive."""
        out = []
        together = [off for off in self.off if off.excused and off.together]
        if together:
            out.append(f"{self._how_far(together)}: the formation as a whole, which was right in itself.")
        for why, each in _by_cause([off for off in self.off if off.excused and not off.together]):
            text = f": {'; '.join(why)}" if why else ""
            coming = ", and coming nearer" if all(off.due_s < inf for off in each) else ""
            out.append(f"{self._how_far(each)}{coming}{text}. The drive ended too early to judge that.")
        return out + self.behind

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
        candidates = np.flatnonzero(self._far[lately].all(axis=0) & known).tolist()
        alike = together(a)
        troubles = [each for each in self._troubles if each[1] + RECOVERED_S >= end_s]
        for index in candidates:
            robot = a.ids[index]
            state, last = recording.robots[robot].status.at(end_s), last_states(recording)[robot]
            if (state and state[0] not in DRIVING_NAMES) or (last and last[0] not in _DROVE):
                continue  # which is said in its own words
            since_s = float(a.grid[_stretches(self._far[:, index])[-1][0]])
            never = since_s <= FIRST_S
            yield Off(
                index,
                float(self._distances[-1, index]),
                tuple(self.causes.of(index)),
                _due_s(self._distances[lately, index], min(LAST_S, end_s)),
                (never and end_s <= RECOVERED_S) or any(t <= since_s + REACTION_S for t, _ in troubles),
                never or bool(troubles or kept_from(recording, robot, end_s - RECOVERED_S, end_s)),
                self.causes.place_speed(index) > speed_max(recording.fleet),
                bool(alike[index]),
            )

    @property
    def behind(self) -> list[str]:
        """Sentences for who fell behind in mid-drive, though nothing had happened or was in its way."""
        recording, a = self._recording, self._a
        found: dict[tuple[str, ...], list[_Behind]] = {}
        for index, robot in enumerate(a.ids):
            for first, last in _stretches(self._far[:, index]):
                start_s, end_s = float(a.grid[first]), float(a.grid[last])
                if end_s - start_s <= LONG_S or start_s <= FIRST_S or last == len(a.grid) - 1:
                    continue
                row = first + int(np.nanargmax(self._distances[first : last + 1, index]))
                worst_s = float(a.grid[row])
                driving = said(recording.robots[robot].status, a.grid[first : last + 1], DRIVING_NAMES)
                after = start_s + REACTION_S
                if (
                    any(t <= after <= until_s + RECOVERED_S for t, until_s in self._troubles)
                    or kept_from(recording, robot, worst_s - LOOK_S, worst_s)
                    or not driving.all()
                ):
                    continue
                why = tuple(Causes(recording, a, self._far[row], row).of(index))
                distance_m = float(self._distances[row, index])
                found.setdefault(why, []).append(_Behind(distance_m, robot, start_s, end_s, worst_s))
        out = []
        groups = list(found.items())
        if len(groups) > CAUSES_MAX:
            groups.sort(key=lambda item: max(item[1]), reverse=True)
        for why, each in groups[:CAUSES_MAX]:
            worst = max(each)
            others = sorted({other.robot for other in each} - {worst.robot})
            more = f" (so did {robots(others)})" if others else ""
            text = f": {'; '.join(why)}" if why else ""
            out.append(
                f"Robot {worst.robot} was off its place from {worst.start_s:.1f} s to {worst.end_s:.1f} s, "
                f"by up to {worst.distance_m:.2f} m at {worst.worst_s:.1f} s{more}{text}."
            )
        if rest := sorted({behind.robot for _, each in groups[CAUSES_MAX:] for behind in each}):
            out.append(f"So it was with {robots(rest)}, which were off by less, for reasons like these.")
        return out

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


def _by_cause(found: Sequence[Off]) -> list[tuple[tuple[str, ...], list[Off]]]:
    """Those with the same causes together. Of many causes the rest are one: as of a machine that is too slow,
    where each of two hundred robots gives another reason."""
    groups: dict[tuple[str, ...], list[Off]] = {}
    for off in found:
        groups.setdefault(off.causes, []).append(off)
    if len(groups) <= CAUSES_MAX:
        return list(groups.items())
    by_worst = sorted(groups.items(), key=lambda each: max(off.distance_m for off in each[1]), reverse=True)
    rest = [off for _, each in by_worst[CAUSES_MAX - 1 :] for off in each]
    more = f"for {len(groups) - CAUSES_MAX + 1} more reasons like these"
    return [*by_worst[: CAUSES_MAX - 1], ((more,), sorted(rest, key=lambda off: off.index))]


def _stretches(flags: Flags) -> list[tuple[int, int]]:
    """(first, last) row of every stretch of true ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(after) - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)]


def _due_s(distances: Floats, span_s: float) -> float:
    """How soon a robot is at its place that comes nearer as it did in `span_s`, s; inf: never."""
    known = distances[np.isfinite(distances)]
    rate = float(known[0] - known[-1]) / span_s if span_s > 0.0 else 0.0
    return float(known[-1]) / rate if rate > 0.0 else inf
