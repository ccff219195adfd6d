"""What a run's data do not hold, in words: of the fleet, of its robots, of its end."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import hypot, inf
from typing import Final

import numpy as np

from agent.supervision.state_machine import State
from deploy.analysis.analysis import Analysis
from deploy.analysis.presence import downs
from deploy.console.wording import NAMES_SHOWN, robots
from deploy.recording.recording import Recording
from deploy.verdict.overload import late_robots, on_late_machines
from deploy.verdict.standstills import Cause, Stall, stalls

SILENCE_S: Final = 2.0
"""An agent says its status five times a second; one that said nothing in the last so many is lost."""
GAP_S: Final = 0.5
"""Poses missing for longer than this make a run's data incomplete."""
_TOO_SLOW: Final = "their machine was too slow"
FEW_GAPS: Final = 3
"""So many that come of a machine that is too slow are told one by one."""
_PERIODS: Final = 2.5
"""Or for longer than so many periods of a slow body: a late tick is no missing pose."""


@dataclass(frozen=True)
class Gap:
    """A time without a pose of one robot.

    Attributes:
        rule: names the rule that stopped its plant, if one did.
        stall: when no robot of its machine sent a pose, and why, if that was so.
        is_late: whether its machine was too slow (`deploy.verdict.overload`).
        for_good: whether that rule killed it, agent and plant, without an end.
        moved_m: how far apart the poses before and after it are, m; inf where one is missing.
    """

    robot: int
    start_s: float
    end_s: float
    rule: str
    stall: Stall | None
    is_late: bool
    for_good: bool
    moved_m: float

    @property
    def lasts_s(self) -> float:
        return self.end_s - self.start_s


class Completeness:
    """What the data of a run lack.

    A robot without a place in the formation at the end (replaced, sent away, in reserve) is nobody whom the
    formation lacks: what is missing of it is a warning.
    """

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording, self._a = recording, a
        self.members = frozenset(robot for robot in a.ids if self._placed(robot, recording.end_s))
        """Robots that had a place at the end."""
        self._gaps = _gaps(recording)

    @property
    def reasons(self) -> list[str]:
        """Sentences that fail the verdict."""
        recording = self._recording
        out = []
        if recording.epoch_ns is None:
            out.append("No mission was recorded: the fleet was never told to start, so it did not drive.")
        silent = [robot for robot, data in recording.robots.items() if not len(data.body)]
        if silent:
            out.append(f"The data are incomplete: no pose of {robots(silent)} was recorded.")
        mute = [robot for robot, data in recording.robots.items() if not len(data.status)]
        if mute:
            verb = "agent of" if len(mute) == 1 else "agents of"
            out.append(f"The data are incomplete: the {verb} {robots(mute)} never said a word.")
        if recording.epoch_ns is None:
            return out
        longest: dict[int, Gap] = {}
        for gap in self._gaps:
            known = longest.get(gap.robot)
            if self._matters(gap) and (known is None or gap.lasts_s > known.lasts_s):
                longest[gap.robot] = gap
        late = self._of_one_cause(longest)
        together: dict[str, list[Gap]] = {}
        alone: list[Gap] = []
        for robot, gap in longest.items():
            cause = gap.stall.cause.value if gap.stall else _TOO_SLOW if robot in late else ""
            (together.setdefault(cause, []) if cause else alone).append(gap)
        if len(alone) <= NAMES_SHOWN:
            out += [
                f"The data are incomplete: robot {gap.robot} sent no pose from {gap.start_s:.2f} s to "
                f"{gap.end_s:.2f} s{', for its machine was too slow' if gap.is_late else ''}."
                for gap in alone
            ]
        else:
            out.append(f"The data are incomplete: {_many(alone)}.")
        for cause, gaps in together.items():
            out.append(f"The data are incomplete: {_many(gaps)}: {cause}.")
        return [*out, *self._fell_silent(self.members), *_cut_short(recording)]

    @property
    def warnings(self) -> list[str]:
        """Sentences that fail nothing."""
        end_s = self._recording.end_s
        known = [gap for gap in self._gaps if not self._matters(gap) and not gap.stall]
        late = [gap for gap in known if self._is_of_machine(gap)]
        if len(late) <= FEW_GAPS:
            out = [
                f"Robot {gap.robot} sent no pose from {gap.start_s:.2f} s to {gap.end_s:.2f} s, for its "
                f"machine was too slow: it moved {gap.moved_m:.2f} m meanwhile."
                for gap in late
            ]
        else:
            most_m = max(gap.moved_m for gap in late)
            who = f"{_many(late).capitalize()}, for a machine was too slow"
            out = [f"{who}: they moved up to {most_m:.2f} m meanwhile."]
        for gap in known:
            if self._is_of_machine(gap):
                continue
            until = "the end" if gap.end_s >= end_s else f"{gap.end_s:.2f} s"
            when = f"from {gap.start_s:.2f} s to {until} its place is not known"
            taken = "" if gap.end_s >= end_s else ", and taken from what came before and after"
            what = f"Robot {gap.robot} had no place in the formation any more"
            if gap.rule:
                what = f"Rule '{gap.rule}' stopped robot {gap.robot}'s plant"
            out.append(f"{what}: {when}{taken}.")
        out += self._fell_silent(frozenset(self._recording.ids) - self.members)
        for robot in sorted(self.members):
            for down in downs(self._recording, robot, "agent"):
                if down.what == "kill" and down.end_s == inf and down.start_s < end_s:
                    out.append(
                        f"The agent of robot {robot} was killed at {down.start_s:.1f} s for good, and nobody "
                        "took its place."
                    )
        return out

    def _placed(self, robot: int, t: float) -> bool:
        """Whether a robot has a place in the formation then."""
        a = self._a
        row = min(int(np.searchsorted(a.grid, t)), len(a.grid) - 1)
        return bool(np.isfinite(a.desired[row, a.ids.index(robot), 0]))

    def _matters(self, gap: Gap) -> bool:
        """Whether the formation lacked what the gap hides: not, if the robot had no place by its end."""
        if not self._placed(gap.robot, gap.end_s):
            return False
        # Who was killed for good is dead on purpose: what the formation lacks then, others say. A plant that
        # should have come back leaves a formation of which nothing is known, and what a machine hides may be
        # what it broke.
        if gap.for_good:
            return False
        # A plant that hangs is no matter of the machine, nor are all of them.
        hidden = (gap.stall and gap.stall.cause is not Cause.PLANTS) or gap.is_late
        known = gap.rule or (hidden and gap.moved_m <= self._a.safe_m)
        return not (known and gap.end_s < self._recording.end_s)

    def _is_of_machine(self, gap: Gap) -> bool:
        """Whether a machine that was too slow hides a robot that had a place, and nobody had stopped it."""
        return gap.is_late and not gap.rule and self._placed(gap.robot, gap.end_s)

    def _of_one_cause(self, silent: Collection[int]) -> list[int]:
        """Which of these are one matter, as they are of a machine that was too slow: what they said may not
        have come through. None where that is one alone."""
        late = sorted(on_late_machines(self._recording).intersection(silent))
        return late if len(late) > 1 else []

    def _fell_silent(self, among: frozenset[int]) -> list[str]:
        """Sentences for agents that said nothing more to the end, though nobody had stopped them."""
        found: dict[int, tuple[float, float]] = {}
        recording = self._recording
        law = recording.fleet.control.law
        hint = "" if law is None else f" Its law, {law}, may hang."
        for robot, data in recording.robots.items():
            last_s = float(data.status.t[-1]) if len(data.status) else inf
            # Before the drive robots may speak seldom; one that ends at once has nothing to miss.
            silence_s = recording.end_s - max(last_s, 0.0)
            ordered = any(
                down.start_s <= last_s + SILENCE_S and down.end_s > last_s + SILENCE_S
                for down in downs(recording, robot, "agent")
            )
            if robot in among and silence_s > SILENCE_S and not ordered:
                found[robot] = last_s, silence_s
        late = self._of_one_cause(found)
        out = [
            f"The agent of robot {robot} said nothing more from {last_s:.1f} s on, in the last "
            f"{silence_s:.1f} s of the drive.{hint}"
            for robot, (last_s, silence_s) in found.items()
            if robot not in late
        ]
        if late:
            first_s = min(found[robot][0] for robot in late)
            out.append(
                f"Nothing more came of the agents of {robots(late)}, of the first from {first_s:.1f} "
                "s on: their machine was too slow, for them, their router or the program that records."
            )
        return out


def _many(gaps: Sequence[Gap]) -> str:
    """Of which robots no pose came, and for how long: a sentence without its end."""
    most_s = max(gap.lasts_s for gap in gaps)
    return f"no pose came of {robots(dict.fromkeys(gap.robot for gap in gaps))} for up to {most_s:.1f} s"


def last_states(recording: Recording) -> dict[int, tuple[str, str] | None]:
    """State and reason of each robot when it was to drive no more, though poses may have ended before."""
    stopped_s = recording.stopped_s
    until_s = recording.planned_s if stopped_s is None else stopped_s
    return {robot: data.status.at(until_s) for robot, data in recording.robots.items()}


def _cut_short(recording: Recording) -> list[str]:
    """Sentences if the run ended early, and nobody had planned that."""
    end_s, planned_s, stopped_s = recording.end_s, recording.planned_s, recording.stopped_s
    if end_s >= planned_s - GAP_S or _stopped_by_order(recording):
        return []
    said_s = [float(data.status.t[-1]) for data in recording.robots.values() if len(data.status)]
    unheard_s = 0.0 if stopped_s is None else stopped_s - max(end_s, *said_s, 0.0)
    why = ""
    if stopped_s is not None and stopped_s <= end_s + GAP_S:
        why = ": it was stopped"
    elif all(last and last[0] == State.FAULT.value for last in last_states(recording).values()):
        why = ": no robot could drive any more"
    elif recording.interrupted:
        why = ": it was interrupted"
    cut_s = end_s if stopped_s is None or unheard_s <= GAP_S else stopped_s
    ended = f"The run ended after {cut_s:.1f} s of the {planned_s:.1f} s that were planned{why}."
    if cut_s == end_s:
        return [ended]
    routed = ": its router may have stood" if recording.fleet.is_routed else ""
    return [f"The data are incomplete: nothing came of any robot after {end_s:.1f} s{routed}.", ended]


def _stopped_by_order(recording: Recording) -> bool:
    """Whether it ended with a stop of its fleet file."""
    stopped_s = recording.stopped_s
    return stopped_s is not None and any(
        order.kind == "stop" and abs(order.at - stopped_s) < GAP_S for order in recording.fleet.orders
    )


def _gaps(recording: Recording) -> list[Gap]:
    """Gaps longer than `GAP_S`, or `_PERIODS`."""
    longest_s = max(GAP_S, _PERIODS * recording.fleet.period_ns / 1e9)
    out = []
    end_s, epoch_ns = recording.end_s, recording.epoch_ns or 0
    stood, late = stalls(recording), late_robots(recording)
    for robot, data in recording.robots.items():
        if not len(data.body):
            continue
        host = recording.fleet.robot(robot).host or ""
        times = np.concatenate([[0.0], np.clip(data.body.t, 0.0, end_s), [end_s]])
        for k in np.flatnonzero(np.diff(times) > longest_s).tolist():
            start_s, stop_s = float(times[k]), float(times[k + 1])
            asked = [
                event.rule
                for event in recording.events
                if event.robot == robot
                and event.role == "plant"
                and event.what in ("kill", "stop")
                and start_s - GAP_S <= (event.time_ns - epoch_ns) / 1e9 <= stop_s
            ]
            stall = [
                each
                for each in stood
                if each.host == host
                and stop_s - start_s < each.end_s - each.start_s + GAP_S
                and each.start_s < stop_s
                and start_s < each.end_s
            ]
            after = int(np.searchsorted(data.body.t, 0.5 * (start_s + stop_s)))
            moved_m = inf
            if 0 < after < len(data.body):
                moved_m = hypot(*(float(np.diff(data.body[axis][after - 1 : after + 1])[0]) for axis in "xy"))
            rule = asked[0] if asked else ""
            dead = stop_s >= end_s and all(
                any(down.what == "kill" and down.end_s == inf for down in downs(recording, robot, role))
                for role in ("agent", "plant")
            )
            stalled = next(iter(stall), None)
            out.append(
                Gap(robot, start_s, stop_s, rule, stalled, robot in late, bool(rule) and dead, moved_m)
            )
    return out
