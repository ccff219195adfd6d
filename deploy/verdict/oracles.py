"""Oracles: rules that must hold in every run, and the violations found in a recording.

An oracle returns a violation for each time that its rule was broken, or None if it does not apply (no
obstacle, no process that was killed). The oracles of reactions to dead processes, stops and operators'
orders are here; the others are in `oracles_distance` and `oracles_drive`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.control.limits import acceleration_max
from handfast.agent.fleet.fault_rules import Impairments, Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.points import Floats
from handfast.agent.messages.types import TOPICS
from handfast.agent.supervision.state_machine import DRIVING_NAMES, REST_SPEED, status_hz
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.presence import Down, Flags, downs
from handfast.deploy.recording.recording import Recording, RobotData
from handfast.deploy.verdict import oracles_distance, oracles_drive
from handfast.deploy.verdict.violations import REACTION_S, Violation, reaction_s, windows
from handfast.plant.unicycle import BRAKE_DECELERATION_MAX, BRAKE_TIME_S

STOP_S: Final = 0.2
"""From a stop to the last plant that brakes, on one machine."""
ARRIVES_ON_HOSTS_S: Final = 0.8
"""On hosts a stop may take so much longer to get to a robot: where links do not let it through, over ssh. No
longer than until the robot's agent says that it has it."""
VEHICLE_STAND_S: Final = 5.0
"""A real vehicle may take so long to come to rest: how hard it brakes is not known."""
VEHICLE_STANDS_LATER_S: Final = 1.0
"""An EKF has a vehicle at rest so long after it stands: it goes on at 0.05 to 0.1 m/s, and fades."""
AGREED_S: Final = 3.0
"""What an operator ordered so long ago, all have acknowledged."""
_LOSS_MAX: Final = 0.5
_DELAY_MAX_S: Final = 0.5
"""Statuses, five a second, come through in time where links lose no more and delay no longer."""
HEARD_S: Final = 1.0
"""An agent that says nothing for so long, or twice what is between two statuses, is not taken to be alive."""
_DONE: Final = {"kill": "killed", "stop": "paused"}


def agent_dead(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """A plant whose agent is killed or paused brakes, until there is an agent again."""
    limit_s = fleet.control.wrench_timeout_s + reaction_s(recording)
    found, is_checked = [], False
    for robot, data in recording.robots.items():
        for down in downs(recording, robot, "agent"):
            is_checked = True
            first_s = _first(data.plant.t, data.plant["driving"] > 0.0, down, limit_s, recording.end_s)
            if first_s is not None:
                message = (
                    f"The plant of robot {robot} drove at {first_s:.2f} s: its agent was {_DONE[down.what]} "
                    f"at {down.start_s:.2f} s, and {limit_s:.2f} s later it must brake."
                )
                found.append(Violation("agent_dead", first_s, message))
    return found if is_checked else None


def plant_dead(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """An agent whose plant is killed or paused does not go on driving."""
    limit_s = fleet.control.plant_timeout_s + reaction_s(recording)
    found, is_checked = [], False
    for robot, data in recording.robots.items():
        own = downs(recording, robot, "agent")
        for down in downs(recording, robot, "plant"):
            is_checked = True
            due_s = down.start_s + limit_s
            drives = np.array([state in DRIVING_NAMES for state in data.status.states], dtype=np.bool_)
            times = data.status.t
            before = int(np.searchsorted(times, due_s, side="right")) - 1
            # What it said last holds until it says another thing, if it can speak.
            if before >= 0 and not any(each.start_s <= due_s and each.end_s >= down.start_s for each in own):
                times, drives = np.append(times, due_s + 1e-9), np.append(drives, drives[before])
            first_s = _first(times, drives, down, limit_s, recording.end_s)
            if first_s is not None:
                message = (
                    f"The agent of robot {robot} went on driving at {first_s:.2f} s: its plant was "
                    f"{_DONE[down.what]} at {down.start_s:.2f} s, and {limit_s:.2f} s later it must be in "
                    "fault."
                )
                found.append(Violation("plant_dead", first_s, message))
    return found if is_checked else None


def _first(times: Floats, bad: Flags, down: Down, limit_s: float, end_s: float) -> float | None:
    """First time (s) at which something is bad, from `limit_s` after a process went until it is back."""
    when = times[bad & (times > down.start_s + limit_s) & (times < min(down.end_s, end_s))]
    return float(when.min()) if len(when) else None


def stopped(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """After a stop no plant drives until a resume, and every body comes to a stand.

    How fast it braked after a stop from before this drive is a matter of the drive that it ended.
    """
    reacts_s = STOP_S + reaction_s(recording) - REACTION_S
    found, is_checked = [], False
    begun_s = -np.inf if recording.begun_s is None else recording.begun_s
    for robot, data in recording.robots.items():
        limit_s = reacts_s + _wrench_delay_s(recording, robot)
        for start_s, end_s in recording.halts(robot):
            is_checked = True
            if fleet.hosts:
                start_s += _arrives_s(recording, data, start_s)
            from_s = begun_s if start_s < begun_s else start_s
            t = data.plant.t
            after = (t > max(start_s + limit_s, from_s)) & (t < end_s)
            driven = t[after & (data.plant["driving"] > 0.0)]
            if len(driven):
                message = (
                    f"The plant of robot {robot} drove at {driven[0]:.2f} s, {driven[0] - start_s:.2f} s "
                    f"after the stop at {start_s:.2f} s: it must brake after {limit_s:.2f} s, "
                    "until a resume."
                )
                found.append(Violation("stopped", float(driven[0]), message))
                continue
            moves_s = _moves(recording, fleet, data, (start_s, end_s), from_s, limit_s)
            if moves_s is not None:
                message = f"Robot {robot} still moved at {moves_s:.2f} s, after the stop at {start_s:.2f} s."
                found.append(Violation("stopped", moves_s, message))
    return found if is_checked else None


def _arrives_s(recording: Recording, data: RobotData, given_s: float) -> float:
    """How much later than it was given a stop was there, s: as the agent says, and no more than it may be."""
    versions = [stop.version for stop in recording.stops if recording.fleet_time_s(stop.time_ns) == given_s]
    status = data.status
    known = status.t[(status.t >= given_s) & (status.order_versions >= max(versions, default=0))]
    return min(float(known.min(initial=np.inf)) - given_s, ARRIVES_ON_HOSTS_S)


def _moves(
    recording: Recording,
    fleet: Fleet,
    data: RobotData,
    halt: tuple[float, float],
    from_s: float,
    limit_s: float,
) -> float | None:
    """First time from `from_s` on at which a body still moves although it has had the time to brake within
    `halt`; None when it stands."""
    start_s, end_s = halt
    body = fleet.robot(data.id)
    t, speed = data.body.t, np.abs(data.body["speed"])
    is_own = data.body["obeying"] > 0.0
    braking_s = VEHICLE_STAND_S
    if not body.kind.is_plugin and (not body.kind.vehicle or recording.mode == "simulate"):
        at = int(np.searchsorted(t, start_s))
        most = float(speed[at : at + 20].max(initial=0.0))
        hardest = BRAKE_DECELERATION_MAX if body.max_force_n is None else body.max_force_n / body.mass_kg
        later_s = 5.0 * BRAKE_TIME_S
        if body.kind.vehicle:  # it brakes as the fleet counts on, not as a unicycle can
            hardest, later_s = acceleration_max(fleet), later_s + VEHICLE_STANDS_LATER_S
        braking_s = most / min(BRAKE_DECELERATION_MAX, hardest) + later_s
    due = t > max(start_s + limit_s + braking_s, from_s)
    for down in downs(recording, data.id, "plant"):
        # It could not brake by rule while it was down, and begins when it is back.
        due &= ~((t > down.start_s) & (t <= down.end_s + limit_s + braking_s))
    late = t[due & (t < end_s) & (speed >= REST_SPEED) & is_own]
    return float(late[0]) if len(late) else None


def _wrench_delay_s(recording: Recording, robot: int) -> float:
    links = recording.links
    delays = links.delay_us[(links.topic == TOPICS.index("wrench")) & (links.destination == robot)]
    return float(delays.max(initial=0)) / 1e6


def _cuts(faults: Impairments) -> bool:
    """Whether these settings can keep two robots from hearing of each other for seconds."""
    if isinstance(faults, Rule) and faults.partition is not None:
        return True
    if any(getattr(faults, name) is not None for name in ("corrupt", "rate", "range")):
        return True
    losses = () if faults.loss is None else (faults.loss.start, faults.loss.end)
    delays = () if faults.delay is None else (faults.delay.start, faults.delay.end)
    return any(loss is not None and loss.rate > _LOSS_MAX for loss in losses) or any(
        delay is not None and delay.mean + delay.jitter > _DELAY_MAX_S for delay in delays
    )


def _newest(recording: Recording, said: Collection[int]) -> int:
    """Version of the last stop or resume that agents say they have: one that was recorded, or that most have,
    as it may have been given before. What one agent alone claims makes no others late."""
    given = {order.version for order in recording.stops} | {order.version for order in recording.resumes}
    counts = Counter(said)
    credible = [version for version in counts if version in given or 2 * counts[version] > len(said)]
    return max(credible or counts)


def one_mission(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """All agents have acknowledged the same mission and last stop or resume, once they had the time to."""
    end_s = recording.end_s
    stamps = [mission.time_ns for mission in recording.missions]
    stamps += [stop.time_ns for stop in recording.stops]
    stamps += [resume.time_ns for resume in recording.resumes]
    times = [recording.fleet_time_s(time_ns) for time_ns in stamps]
    quiet_s = end_s - AGREED_S
    if not recording.missions or any(quiet_s < t <= end_s for t in times) or end_s < AGREED_S:
        return None
    if any(_cuts(span.rule) and span.end_s >= quiet_s for span in windows(recording)) or _cuts(fleet.faults):
        return None
    heard_s = max(HEARD_S, 2.0 / status_hz(len(fleet.robots)))
    known: dict[int, tuple[int, int]] = {}
    for robot, data in recording.robots.items():
        status = data.status
        last = int(np.searchsorted(status.t, end_s, side="right")) - 1
        if last < 0 or status.t[last] < end_s - heard_s:
            continue
        if any(down.end_s >= quiet_s for down in downs(recording, robot, "agent")):
            continue
        known[robot] = int(status.mission_versions[last]), int(status.order_versions[last])
    if not known:
        return None
    found = []
    for number, what in ((0, "mission"), (1, "last stop or resume")):
        versions = {robot: pair[number] for robot, pair in known.items()}
        newest = a.mission_version if number == 0 else _newest(recording, versions.values())
        behind = [robot for robot, version in versions.items() if version != newest]
        if behind:
            message = (
                f"At {end_s:.1f} s not all had acknowledged the same {what}: robot {behind[0]} had version "
                f"{versions[behind[0]]}, the newest is {newest}."
            )
            found.append(Violation("one_mission", end_s, message))
    return found


class Oracle(NamedTuple):
    """One of `ORACLES`; `says` is what it holds a run to, in words."""

    name: str
    says: str
    look: Callable[[Recording, Analysis, Fleet], list[Violation] | None]


ORACLES: Final[tuple[Oracle, ...]] = (
    Oracle(
        oracles_distance.SEPARATION,
        "No two hands come nearer to each other than the safe distance.",
        oracles_distance.separation,
    ),
    Oracle(
        "clearance", "No hand comes nearer to an obstacle than the clearance.", oracles_distance.clearance
    ),
    Oracle("geofence", "A robot outside the geofence holds, as soon as it can.", oracles_distance.geofence),
    Oracle(
        "agent_dead",
        "A plant brakes within the wrench timeout when its agent is gone.",
        agent_dead,
    ),
    Oracle(
        "plant_dead",
        "An agent is in fault within the plant timeout when its plant is gone.",
        plant_dead,
    ),
    Oracle("stopped", "After a stop nothing drives until a resume.", stopped),
    Oracle(
        "one_mission",
        "All agents end up with the same mission, and the same last stop or resume.",
        one_mission,
    ),
    Oracle("limits", "Speeds, forces and torques stay within the fleet file's.", oracles_drive.limits),
    Oracle(
        "recovery",
        f"{oracles_drive.RECOVERED_S:g} s after the last fault or change, and as long as the way takes that "
        "is left, all are in formation again; beside an agent that is gone for good, who is not says why.",
        oracles_drive.recovery,
    ),
    Oracle(
        "formed",
        "A fleet to which nothing happens is in formation in the end, and where its course has it.",
        oracles_drive.formed,
    ),
    Oracle("errors", "Failing links alone leave no error behind.", oracles_drive.errors),
)


def examine(recording: Recording, analysis: Analysis, fleet: Fleet) -> dict[str, list[Violation] | None]:
    """What every oracle found, in the order of `ORACLES`; None where it does not apply."""
    return {oracle.name: oracle.look(recording, analysis, fleet) for oracle in ORACLES}
