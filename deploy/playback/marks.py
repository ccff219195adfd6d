"""Marks on a run's time line: orders, faults, states, violations; and how the page and films show a state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from handfast.agent.supervision.state_machine import State
from handfast.deploy.console.wording import robots
from handfast.deploy.faults.process_actions import WORDS
from handfast.deploy.faults.rules import lanes
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.oracles_distance import SEPARATION
from handfast.deploy.verdict.run_result import RunResult

MARKS_MAX: Final = 2000
"""So many marks a page gets; of what is more the most important are kept."""
ORDER: Final = "order"
FAULT: Final = "fault"
STATE: Final = "state"
VIOLATION: Final = "violation"
VEHICLE: Final = "vehicle"
_WORTH: Final = (VIOLATION, ORDER, FAULT, STATE, VEHICLE)
_QUIET: Final = frozenset({State.READY.value, State.WAITING.value, State.STANDBY.value, State.STOPPING.value})
"""States in which a robot comes to drive, or to its end: no mark of their own."""


class Mark(NamedTuple):
    """Something that happened.

    Attributes:
        t_s: when it did, or began, fleet time.
        end_s: when it was over, None of a moment.
        kind: `ORDER`, `FAULT`, `STATE`, `VIOLATION` or `VEHICLE`.
        text: what it was.
        robots: whom to look at, ascending; none for all.
    """

    t_s: float
    end_s: float | None
    kind: str
    text: str
    robots: tuple[int, ...] = ()


def marks(result: RunResult) -> list[Mark]:
    """All that is to be marked in a run, in the order of time."""
    found = all_marks(result)
    if len(found) > MARKS_MAX:
        found = sorted(found, key=_worth)[:MARKS_MAX]
    return sorted(found, key=_in_time)


def all_marks(result: RunResult) -> list[Mark]:
    """As `marks`, however many there are."""
    recording = result.recording
    found = [*_orders(recording), *_faults(recording), *_states(recording), *_violations(result)]
    return sorted([*found, *_status_texts(recording)], key=_in_time)


def _worth(mark: Mark) -> tuple[int, float]:
    return _WORTH.index(mark.kind), mark.t_s


def _in_time(mark: Mark) -> tuple[float, int]:
    return mark.t_s, _WORTH.index(mark.kind)


def _status_texts(recording: Recording) -> list[Mark]:
    return [
        Mark(
            *(recording.fleet_time_s(said.time_ns), None, VEHICLE),
            f"the vehicle of robot {said.robot} says ({said.severity}): {said.text}",
            (said.robot,),
        )
        for said in recording.status_texts
    ]


def _orders(recording: Recording) -> list[Mark]:
    found = []
    for stop in recording.stops:
        text = "stop" + (f": {stop.reason}" if stop.reason else "")
        found.append(Mark(recording.fleet_time_s(stop.time_ns), None, ORDER, text))
    for resume in recording.resumes:
        who = robots(resume.robots) if resume.robots else "all robots"
        found.append(
            Mark(recording.fleet_time_s(resume.time_ns), None, ORDER, f"resume: {who}", tuple(resume.robots))
        )
    for mission in recording.held_missions:
        at_s = recording.fleet_time_s(mission.from_ns or mission.epoch_ns)
        found.append(Mark(at_s, None, ORDER, mission.note or "the drive begins"))
    return found


def _faults(recording: Recording) -> list[Mark]:
    found = []
    for lane in lanes(recording, recording.end_s):
        found += [Mark(start_s, end_s, FAULT, lane.text) for start_s, end_s in lane.times]
    for event in recording.events:
        text = f"{event.role} {event.robot} {WORDS[event.what]}"
        found.append(Mark(recording.fleet_time_s(event.time_ns), None, FAULT, text, (event.robot,)))
    return found


def _states(recording: Recording) -> list[Mark]:
    """Changes of state within the drive that are worth a mark: one for the same change of many robots in a
    tenth of a second."""
    changes: dict[tuple[float, str], list[int]] = {}
    for robot, data in recording.robots.items():
        away = False
        told = data.status.changes()
        before = [change._replace(t_s=0.0) for change in told if change.t_s < 0.0]
        for change in [*before[-1:], *(change for change in told if change.t_s >= 0.0)]:
            if change.state in _QUIET:
                continue
            if change.state == State.STOPPED.value and change.t_s >= recording.planned_s:
                continue
            if change.state == State.RUNNING.value and not away:
                continue  # it begins to drive
            away = change.state != State.RUNNING.value
            why = f": {change.reason}" if change.reason else ""
            changes.setdefault((round(change.t_s, 1), f"{change.state}{why}"), []).append(robot)
    return [
        Mark(t_s, None, STATE, f"{robots(sorted(ids))} {text}", tuple(sorted(ids)))
        for (t_s, text), ids in changes.items()
    ]


def _violations(result: RunResult) -> list[Mark]:
    analysis = result.analysis
    found = [
        Mark(
            *(near.t_s, None, VIOLATION),
            f"robots {near.pair[0]} and {near.pair[1]} {near.distance_m:.3f} m apart, less than the safe "
            f"distance of {analysis.safe_m:.3f} m",
            near.pair,
        )
        for approaches in (analysis.with_edge, analysis.without_edge)
        for near in (*approaches.unsafe, *approaches.unavoidable)
    ]
    for name, broken in result.violations.items():
        if name != SEPARATION:  # above it is pair by pair
            found += [Mark(each.t_s, None, VIOLATION, each.message) for each in broken or ()]
    return found


DRIVES: Final = "drives"
TROUBLED: Final = "troubled"
FAILED: Final = "failed"
RESTS: Final = "rests"
UNREADY: Final = "unready"
SILENT: Final = "silent"
"""Instead of its state, where a robot is not heard any more."""

LOOKS: Final[Mapping[str, str]] = {
    State.RUNNING.value: DRIVES,
    State.DEGRADED.value: TROUBLED,
    State.HOLDING.value: TROUBLED,
    State.RELEASED.value: TROUBLED,
    State.FAULT.value: FAILED,
    State.STOPPING.value: RESTS,
    State.STOPPED.value: RESTS,
    State.WAITING.value: UNREADY,
    State.READY.value: UNREADY,
    State.STANDBY.value: UNREADY,
    SILENT: TROUBLED,
    "": UNREADY,
}
"""By the state's name, "" where a robot has said none."""
