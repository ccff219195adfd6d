"""Oracles of the drive: limits that commands and bodies keep, formation at first and after faults, errors."""

from __future__ import annotations

from math import inf
from typing import Final

import numpy as np

from handfast.agent.common.quantities import DISTANCE_MIN
from handfast.agent.control.boundaries import fence_of, obstacles_of
from handfast.agent.control.limits import avoidance_distance, barrier_rate, speed_max
from handfast.agent.control.limits import clearance as clearance_of
from handfast.agent.fleet.fault_rules import ACTION_FIELDS, EFFECTS, PROCESS_FIELDS, SENSOR_FIELDS, Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import FENCE_WARN_M
from handfast.agent.formation.points import Floats
from handfast.agent.formation.trajectory import maximum_speed
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.deploy.analysis.analysis import Analysis, norm
from handfast.deploy.analysis.places import LAST_S, allowed_m, caught, distances_m, last_caught_s, together
from handfast.deploy.analysis.presence import Flags, downs, said
from handfast.deploy.analysis.shapes import distances
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.tables import StatusTable
from handfast.deploy.verdict.violations import Violation, is_constant, lasting, windows

SPEED_SHARE: Final = 1.1
SPEED_MORE_MPS: Final = 0.1
FASTER_S: Final = 0.5
"""To get out of each other's way robots may be faster for so long."""
_COMMAND_SHARE: Final = 1.0 + 1e-6
RECOVERED_S: Final = 20.0
"""Within so long after the last fault or change all drive in formation again."""
BACK_S: Final = 3.0
"""By then a robot follows again that could not, and its way can be seen."""
ERROR_M: Final = 0.1
"""Largest error of an edge's distance at the end, where only links fail and the formation has settled."""
LATE_MAX_S: Final = 1.25
LOST_MAX: Final = 0.5
_HARSH: Final = ("reorder", "corrupt", "rate", "range")
_NEAR_SHARE: Final = 1.05
_EXCUSED: Final = frozenset({State.RELEASED.value})
_HOLDING: Final = frozenset({State.HOLDING.value})


def limits(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """Hands are not faster, and commands not larger, than the fleet file allows."""
    if not fleet.avoidance.enabled:
        return None
    most_mps = SPEED_SHARE * fleet.control.max_speed_mps + SPEED_MORE_MPS
    found = []
    for robot, data in recording.robots.items():
        settings, body, wrench = fleet.robot(robot), data.body, data.wrench
        driven = (body.t >= 0.0) & (body.t <= recording.end_s) & (body["obeying"] > 0.0)
        speed = np.hypot(body["speed"], settings.hand_offset_m * body["yaw_rate"])
        since_s = lasting(driven & (speed > most_mps), body.t, FASTER_S)
        if since_s is not None:
            message = (
                f"The hand of robot {robot} was faster than {most_mps:.2f} m/s from {since_s:.2f} s on, up "
                f"to {speed[driven].max():.2f} m/s: control.max_speed_mps is {fleet.control.max_speed_mps:g}."
            )
            found.append(Violation("limits", since_s, message))
        for name, most, unit in (
            ("force", settings.max_force_n, "N"),
            ("torque", settings.max_torque_nm, "N m"),
        ):
            if most is None or not len(wrench):
                continue
            over = ~(np.abs(wrench[name]) <= most * _COMMAND_SHARE)  # true for what is not a number
            if over.any():
                k = int(np.argmax(over))
                message = (
                    f"The agent of robot {robot} asked for a {name} of {wrench[name][k]:.4g} {unit} at "
                    f"{wrench.t[k]:.2f} s: its body can give {most:g}."
                )
                found.append(Violation("limits", float(wrench.t[k]), message))
    return found


def recovery(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """Some time after the last fault and the last change all members drive, and their edges are right as soon
    as the way that was left then allows (`formed_by_s`).

    Where links fail all the time a robot may hold now and then, as long as it drives in between.

    Who was held up by an obstacle, or by a robot that it shares no edge with, gets as long after that. So
    do edges where the formation has come to rest in another shape (`deploy.analysis.balance`): that is no
    matter of recovery.

    Beside bodies that nobody hears any more some cannot go on, and some not to their places: there, who holds
    has to say why, and where edges are off at the end somebody has to have done so of late.
    """
    end_s = recording.end_s
    last_s = last_trouble_s(recording, a)
    if last_s is None or last_s + RECOVERED_S >= end_s:
        return None
    rows = a.grid >= last_s + RECOVERED_S
    plan = FaultPlan(fleet)
    rules = (_whole(fleet), *(span.rule for span in windows(recording)))
    lossy = any(is_constant(rule) and rule.given(EFFECTS) for rule in rules)
    gone = {
        robot
        for robot in recording.ids
        if any(down.end_s > end_s for role in ROLES for down in downs(recording, robot, role))
    }
    found = []
    for index, (robot, data) in enumerate(recording.robots.items()):
        if robot in gone or not len(data.status):
            continue
        grid = a.grid[rows]
        skew_ns, drift = plan.clock(robot)
        own_end_s = end_s - skew_ns / 1e9 - drift * end_s  # by a clock that is wrong on purpose
        is_due = np.isfinite(a.desired[rows, index, 0]) & (grid < own_end_s)
        idle = is_due & ~said(data.status, grid, DRIVING_NAMES | _EXCUSED)
        if lossy and (is_due & ~idle).any():  # by chance nothing may come for long, time and again
            idle &= ~said(data.status, grid, _HOLDING)
        if gone:
            idle &= ~_says_why(data.status, grid)
        if idle.any():
            t_s = float(grid[np.argmax(idle)])
            state, reason = data.status.at(t_s) or ("", "")
            why = f" ({reason})" if reason else ""
            message = (
                f"Robot {robot} did not drive at {t_s:.1f} s but was {state}{why}: the last fault or change "
                f"was at {last_s:.1f} s."
            )
            found.append(Violation("recovery", t_s, message))
    free_s = max(last_s, _held_up_s(a, fleet))
    left = (a.grid >= free_s) & (a.grid <= free_s + BACK_S)
    way_m = float(np.nan_to_num(distances_m(a)[left]).max(initial=0.0))
    due_s = free_s + formed_by_s(way_m, maximum_speed(fleet.trajectory), fleet)
    off = a.off & (a.grid >= due_s)[:, None]
    if off.any():  # what follows takes its time
        off &= (a.grid >= last_caught_s(a, fleet, last_s) + RECOVERED_S)[:, None]
    if gone:
        off[:-1] = False
        off[-1] &= not _named_lately(
            recording, a
        ).any()  # who is held pulls at its neighbours, and they at theirs
    if off.any():
        k, column = (int(index) for index in np.argwhere(off)[-1])
        i, j = (a.ids[index] for index in a.edges[column])
        t_s = float(a.grid[k])
        message = (
            f"Robots {i} and {j} were {a.distances[k, column]:.3f} m apart instead of "
            f"{a.wanted[k, column]:.3f} m at {t_s:.1f} s: the last fault or change was at {last_s:.1f} s."
        )
        found.append(Violation("recovery", t_s, message))
    return found


def _says_why(status: StatusTable, grid: Floats) -> Flags:
    """(k,): whether a robot names what holds it at these times."""
    return np.array([bool((status.at(float(t)) or ("", ""))[1]) for t in grid], dtype=bool)


def _named_lately(recording: Recording, a: Analysis) -> Flags:
    """(n,): which robots have named what holds them in the last `RECOVERED_S`."""
    lately = a.grid[a.grid >= a.grid[-1] - RECOVERED_S]
    return np.array([_says_why(recording.robots[robot].status, lately).any() for robot in a.ids], dtype=bool)


def last_trouble_s(recording: Recording, a: Analysis) -> float | None:
    """When the last fault or change was over; None when there was none."""
    end_s = recording.end_s
    times = [settled.change.t_s for settled in a.changes]
    times += [t for event in recording.events if 0.0 <= (t := recording.fleet_time_s(event.time_ns)) <= end_s]
    for robot in recording.ids:
        times += [end for start, end in recording.halts(robot) if start < end_s]
        # Who was let go, and is back, has its way to go; others wait for it.
        released = recording.robots[robot].status.periods(State.RELEASED.value)
        times += [end for _, end, _ in released if end is not None and end <= end_s]
    for span in windows(recording):
        if span.rule.given(ACTION_FIELDS):  # a fault of one moment, for good or until its process is back
            times.append(span.start_s)
        elif not is_constant(span.rule):
            times.append(span.end_s)
    for robot in recording.ids:
        for role in ROLES:
            lost = downs(recording, robot, role)
            times += [t for down in lost for t in (down.start_s, down.end_s) if 0.0 <= t <= end_s]
    return max(times, default=None)


def _held_up_s(a: Analysis, fleet: Fleet) -> float:
    """When a robot was last where it is kept back from another or from a boundary; -inf: never.

    From another robot by (U1), or behind it by (F4): at 2 V/p besides what is kept, both can still brake.
    """
    places = a.desired[-1]
    members = np.flatnonzero(np.isfinite(places[:, 0])).tolist()
    edges = {
        (min(i, j), max(i, j)): float(distance)
        for (i, j), distance in zip(a.edges.tolist(), a.wanted[-1].tolist(), strict=True)
        if distance == distance
    }
    offsets = {index: (float(places[index, 0]), float(places[index, 1])) for index in members}
    near_m = _NEAR_SHARE * avoidance_distance(fleet.avoidance.distance_m, a.safe_m, edges, offsets)
    keep_m, rate = a.safe_m + fleet.avoidance.margin_m, barrier_rate(fleet)
    velocities = np.gradient(a.hands, a.grid, axis=0)
    held = np.zeros(len(a.grid), dtype=np.bool_)
    for j in range(1, len(a.ids)):
        for i in range(j):
            if (i, j) not in edges:
                offset = a.hands[:, j] - a.hands[:, i]
                away = norm(offset)
                towards = np.maximum(
                    (velocities[:, i] * offset).sum(axis=1), -(velocities[:, j] * offset).sum(axis=1)
                ) / np.maximum(away, DISTANCE_MIN)
                room_m = keep_m + 2.0 * np.maximum(towards, 0.0) / rate
                held |= away < np.maximum(near_m, room_m)  # False for NaN
    reach_m = clearance_of(fleet.avoidance.clearance_m, a.safe_m) + near_m
    fence = fence_of(fleet)
    boundaries = [(obstacle, reach_m) for obstacle in obstacles_of(fleet)]
    if fence is not None and fleet.geofence is not None:
        boundaries.append((fence, FENCE_WARN_M))
    for boundary, least_m in boundaries:
        for index in range(len(a.ids)):
            held |= distances(boundary, a.hands[:, index]) < least_m
    return float(a.grid[held].max(initial=-inf))


def formed(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """A fleet to which nothing happens is in formation in the end, and where its course has it.

    Messages may be late by up to `LATE_MAX_S` and lost up to `LOST_MAX` all the time. Not judged among
    obstacles, which may be in the way, nor before `formed_by_s`.
    """
    rules = (_whole(fleet), *(span.rule for span in windows(recording)))
    calm = not (recording.events or a.changes or recording.resumes or recording.stopped_s is not None)
    if (
        not calm
        or not all(is_constant(rule) and is_mild(rule) for rule in rules)
        or not fleet.avoidance.enabled
    ):
        return None
    if fleet.obstacles or fleet.geofence is not None:
        return None
    end_s = float(a.grid[-1])
    error_m = np.nan_to_num(distances_m(a))  # of those who have a place
    if end_s < formed_by_s(float(error_m[0].max()), maximum_speed(fleet.trajectory), fleet):
        return None
    found = []
    off = np.flatnonzero(a.off[-1])
    if len(off):
        column = int(off[np.argmax(np.abs(a.distances[-1] / a.wanted[-1] - 1.0)[off])])
        i, j = (a.ids[index] for index in a.edges[column])
        rest = ", at rest in another shape" if caught(a, fleet) else ""
        message = (
            f"Robots {i} and {j} were {a.distances[-1, column]:.3f} m apart instead of "
            f"{a.wanted[-1, column]:.3f} m at the end{rest}, although nothing had happened to the fleet."
        )
        found.append(Violation("formed", end_s, message))
    lately = np.where(a.unknown, np.inf, error_m)[a.grid >= end_s - LAST_S].min(axis=0)  # as far as is known
    least_m = np.where(together(a) | np.isinf(lately), 0.0, lately)
    far = int(least_m.argmax())
    if least_m[far] > allowed_m(a):
        message = (
            f"Robot {a.ids[far]} was {least_m[far]:.2f} m from its place at the end, although nothing "
            "had happened to the fleet."
        )
        found.append(Violation("formed", end_s, message))
    return found


def is_mild(rule: Rule) -> bool:
    """Whether links that suffer this all the time let a formation be taken up."""
    if rule.given((*PROCESS_FIELDS, *SENSOR_FIELDS)) or rule.partition is not None or rule.topic != "hand":
        return False
    if any(getattr(rule, name) is not None for name in _HARSH):
        return False
    delays = () if rule.delay is None else (rule.delay.start, rule.delay.end)
    losses = () if rule.loss is None else (rule.loss.start, rule.loss.end)
    return all(delay is None or delay.mean + delay.jitter <= LATE_MAX_S for delay in delays) and all(
        loss is None or loss.rate <= LOST_MAX for loss in losses
    )


def formed_by_s(way_m: float, course_mps: float, fleet: Fleet) -> float:
    """By when a fleet stands whose farthest robot is `way_m` from its place at the start: s.

    It catches up with a course that does not wait, from rest, with what its greatest speed leaves it,
    v t = way + u^2/2a, v = V - u and at least V/10, and then has as long as after a fault.
    """
    most = speed_max(fleet)
    spare = max(most - course_mps, 0.1 * most)
    lost_m = 0.5 * min(course_mps, most) ** 2 / fleet.control.max_acceleration
    return RECOVERED_S + (way_m + lost_m) / spare


def _whole(fleet: Fleet) -> Rule:
    """What the fleet file says of all links."""
    return Rule(**{name: getattr(fleet.faults, name) for name in EFFECTS})


def errors(recording: Recording, a: Analysis, fleet: Fleet) -> list[Violation] | None:
    """Where only links fail, all the time, a formation that has settled is a good one.

    Not judged where a robot was held up in the last `RECOVERED_S`.
    """
    rules = [span.rule for span in windows(recording)]
    others = (*PROCESS_FIELDS, *SENSOR_FIELDS)
    only_links = all(is_constant(rule) and not rule.given(others) for rule in rules)
    if (
        not (rules or _whole(fleet).given(EFFECTS))
        or not only_links
        or a.settling_s is None
        or recording.events
    ):
        return None
    if _held_up_s(a, fleet) + RECOVERED_S > recording.end_s:
        return None
    error = np.where(a.counts[-1], np.abs(a.distances[-1] - a.wanted[-1]), 0.0)
    if not len(error) or not error.max() > ERROR_M:
        return []
    column = int(error.argmax())
    i, j = (a.ids[index] for index in a.edges[column])
    t_s = float(a.grid[-1])
    message = (
        f"Robots {i} and {j} were {error[column]:.3f} m off their distance of {a.wanted[-1, column]:.3f} m "
        f"at the end, although only links failed: at most {ERROR_M:g} m is allowed."
    )
    return [Violation("errors", t_s, message)]
