"""What a run's data do not hold, in words: of the fleet, of its robots, of its end."""

from __future__ import annotations

from math import inf
from typing import Final

from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.gaps import GAP_S, is_lost
from handfast.deploy.analysis.presence import downs
from handfast.deploy.console.wording import robots
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.gaps import damage
from handfast.deploy.verdict.gaps.missing_poses import MissingPoses, of_one_cause

SILENCE_S: Final = 2.0
"""An agent says its status five times a second; one that said nothing in the last so many is lost."""


class Completeness:
    """What the data of a run lack.

    A robot without a place in the formation at the end (replaced, sent away, in reserve) is nobody whom the
    formation lacks: what is missing of it is a warning.
    """

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording = recording
        self._poses = MissingPoses(recording, a)
        self.members = frozenset(robot for robot in a.ids if self._poses.is_placed(robot, recording.end_s))
        """Robots that had a place at the end."""

    @property
    def reasons(self) -> list[str]:
        """Sentences that fail the verdict."""
        recording = self._recording
        out = []
        if recording.epoch_ns is None:
            out.append("No mission was recorded: the fleet was never told to start, so it did not drive.")
        is_damaged = is_lost(recording, 0.0, recording.end_s)  # then that is why
        silent = [robot for robot, data in recording.robots.items() if not len(data.body)]
        if silent and not is_damaged:
            out.append(f"The data are incomplete: no pose of {robots(silent)} was recorded.")
        mute = [robot for robot, data in recording.robots.items() if not len(data.status)]
        if mute and not is_damaged:
            verb = "agent of" if len(mute) == 1 else "agents of"
            out.append(f"The data are incomplete: the {verb} {robots(mute)} never said a word.")
        if recording.epoch_ns is None:
            return out
        damaged = damage.reasons(recording, self._poses.worst_lost)
        cut = damage.cut_short(recording)
        return [
            *damaged, *out, *self._poses.reasons, *self._fell_silent(self.members),
            *(_cut_short(recording) if cut is None else []),
        ]  # fmt: skip

    @property
    def warnings(self) -> list[str]:
        """Sentences that fail nothing."""
        end_s = self._recording.end_s
        out = self._poses.warnings
        out += self._fell_silent(frozenset(self._recording.ids) - self.members)
        for robot in sorted(self.members):
            for down in downs(self._recording, robot, "agent"):
                if down.what == "kill" and down.end_s == inf and down.start_s < end_s:
                    out.append(
                        f"The agent of robot {robot} was killed at {down.start_s:.1f} s for good, and nobody "
                        "took its place."
                    )
        return out

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
            is_damaged = is_lost(recording, last_s, recording.end_s)
            if robot in among and silence_s > SILENCE_S and not ordered and not is_damaged:
                found[robot] = last_s, silence_s
        late = of_one_cause(recording, found)
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
