"""What a run is judged by: pure functions from a recording to numbers and a verdict.

Distances are between hand points, the points that the law controls. All values SI unless named.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent.fleet import Fleet, law_name
from agent.formation import Geometry
from agent.supervision import State
from agent.trajectory import make_trajectory
from deploy import link_metrics
from deploy.link_data import Floats
from deploy.recorder import RecordingError
from deploy.recording import Recording
from deploy.rounding import largest, number, percentile
from deploy.stability import SETTLED
from deploy.wording import robots

GAP_S: Final = 0.5
"""Poses missing for longer than this make a run's data incomplete."""
MESSAGES: Final = ("sent", "received", "lost", "delayed", "duplicated", "corrupted", "rejected")
_REJECTED: Final = "rejected."
_GOOD_STATES: Final = (State.RUNNING.value, State.STOPPING.value, State.STOPPED.value, State.RELEASED.value)
"""Of a robot at the end of its drive. Its operator may take it whenever he likes: that is a warning."""


@dataclass(frozen=True)
class Analysis:
    """A run on one grid of k times, for n robots and m edges.

    `hands` and `desired` (k, n, 2) m; `distances` (k, m) m. NaN where a robot sent no pose at all.
    """

    grid: Floats
    hands: Floats
    desired: Floats
    edges: NDArray[np.int64]
    wanted: Floats
    distances: Floats
    off: NDArray[np.bool_]
    """(k, m): the edge is further than `SETTLED` from its distance."""
    settling_s: float | None
    """Last time that any edge was off, 0 when none was, None when one is at the end (or nothing is known)."""


def analyse(recording: Recording, geometry: Geometry) -> Analysis:
    """The run's hand points, desired hand points and edge distances over time."""
    grid = recording.grid
    hands = recording.hand_positions(grid)
    edges = np.asarray(geometry.edges, dtype=np.int64).reshape(-1, 2)
    wanted = np.asarray(geometry.distances, dtype=np.float64)
    trajectory = make_trajectory(recording.fleet.trajectory)
    centre = np.array([trajectory.at(float(t))[:2] for t in grid])
    desired = centre[:, None, :] + np.asarray(geometry.offsets, dtype=np.float64)[None, :, :]
    distances = _norm(hands[:, edges[:, 0]] - hands[:, edges[:, 1]])
    off = np.abs(distances - wanted) > SETTLED * wanted  # False for NaN
    return Analysis(grid, hands, desired, edges, wanted, distances, off, _settling(grid, distances, off))


def _settling(grid: Floats, distances: Floats, off: NDArray[np.bool_]) -> float | None:
    if not np.isfinite(distances).any() or off[-1].any():
        return None
    when = np.flatnonzero(off.any(axis=1))
    return float(grid[when[-1]]) if len(when) else 0.0


def _norm(vectors: Floats) -> Floats:
    length: Floats = np.hypot(vectors[..., 0], vectors[..., 1])
    return length


@dataclass(frozen=True)
class Closest:
    """The closest that a pair of robots came, and the number of pairs that came below the safe distance."""

    distance_m: float
    t_s: float
    pair: tuple[int, int]
    unsafe: int


def closest(analysis: Analysis, ids: Sequence[int], safe_m: float, *, sharing_edge: bool) -> Closest | None:
    """The closest approach among the pairs with (or without) an edge; None when there is no such pair."""
    edges = {(min(i, j), max(i, j)) for i, j in analysis.edges.tolist()}
    best: Closest | None = None
    unsafe = 0
    for i in range(len(ids) - 1):  # a robot at a time: all pairs of a large fleet at once would not fit
        others = [j for j in range(i + 1, len(ids)) if ((i, j) in edges) == sharing_edge]
        between = _norm(analysis.hands[:, others] - analysis.hands[:, i : i + 1])
        between[np.isnan(between)] = np.inf
        if not others:
            continue
        unsafe += int((between.min(axis=0) < safe_m).sum())
        k, column = divmod(int(between.argmin()), len(others))
        distance = float(between[k, column])
        if isfinite(distance) and (best is None or distance < best.distance_m):
            best = Closest(distance, float(analysis.grid[k]), (ids[i], ids[others[column]]), 0)
    return None if best is None else Closest(best.distance_m, best.t_s, best.pair, unsafe)


def compute(
    recording: Recording,
    fleet: Fleet,
    geometry: Geometry,
    *,
    mode: str,
    seed: int,
    reasons: Sequence[str] = (),
    analysis: Analysis | None = None,
) -> dict[str, Any]:
    """The content of ``metrics.json``, in the order of its description.

    mode: ``run`` or ``simulate`` (virtual time has no tick times: null).
    reasons: full sentences that fail the verdict and that the recording does not know, such as a
        process that died; they come first.
    analysis: that of `analyse`, when it is at hand.
    """
    a = analyse(recording, geometry) if analysis is None else analysis
    safe_m = fleet.formation.safe_distance_m
    with_edge = closest(a, recording.ids, safe_m, sharing_edge=True)
    without = closest(a, recording.ids, safe_m, sharing_edge=False)
    errors = a.distances - a.wanted
    tracking = _norm(a.hands[-1] - a.desired[-1])
    totals: Counter[str] = Counter()
    for robot in recording.robots.values():
        totals.update(robot.status.totals())
    rejected = {
        name.removeprefix(_REJECTED): count
        for name, count in sorted(totals.items())
        if name.startswith(_REJECTED) and count
    }
    # Before the start and after the end, neighbours come and go: such ages say nothing about the drive.
    statuses = [robot.status for robot in recording.robots.values()]
    ages_ms = np.concatenate([status.ages_between(0.0, recording.end_s) for status in statuses]) / 1e3
    ticks_us = np.concatenate([status.tick_us for status in statuses])
    if mode == "simulate":
        ticks_us = ticks_us[:0]
    found = [
        *reasons,
        *_incomplete(recording),
        *_states(recording),
        *_unsafe(with_edge, safe_m, "share an edge"),
        *_unsettled(a, recording.ids),
    ]
    # The law keeps neighbours apart and says nothing about others: not its failure, but not to be hidden.
    warnings = [f"{warning}." for warning in recording.warnings] + _releases(recording)
    for sentence in _unsafe(without, safe_m, "share no edge"):
        warnings.append(f"{sentence} The law keeps apart only robots that share an edge.")
    for gap in _gaps(recording):
        if gap.rule:
            warnings.append(
                f"Rule '{gap.rule}' stopped robot {gap.robot}'s plant: from {gap.start_s:.2f} s to "
                f"{gap.end_s:.2f} s its place is not known, and taken between what came before and after."
            )
    about_links = link_metrics.describe_links(recording)
    warnings += link_metrics.clock_warnings(recording, about_links["clock_offsets"])
    if any(len(robot.hand) for robot in recording.robots.values()):  # else links were not looked at
        warnings += link_metrics.idle_rules(recording)
    warnings += link_metrics.audit_warnings(about_links["links_audit"])
    metrics: dict[str, Any] = {
        "fleet": fleet.fleet.name,
        "law": law_name(fleet.control),
        "seed": seed,
        "mode": mode,
        "robots": len(fleet.robots),
        "edges": len(a.edges),
        "rate_hz": number(fleet.fleet.rate_hz),
        "duration_s": number(recording.end_s),
        "min_distance_m": {
            "edge": number(with_edge.distance_m) if with_edge else None,
            "any": _least(with_edge, without),
        },
        "settling_time_s": number(a.settling_s),
        "final_distance_error_m": largest(np.abs(errors[-1])),
        "final_tracking_error_m": largest(tracking),
        "rms_distance_error_m": _rms(errors),
        "messages": {name: totals[name] for name in MESSAGES},
        "age_of_information_ms": {
            "p50": percentile(ages_ms, 50),
            "p99": percentile(ages_ms, 99),
            "max": largest(ages_ms),
        },
        "tick": {
            "p50_us": percentile(ticks_us, 50),
            "p99_us": percentile(ticks_us, 99),
            "overruns": totals["overruns"],
        },
        **about_links,
        "verdict": {"passed": not found, "reasons": found, "warnings": warnings},
    }
    if rejected:
        metrics["messages_rejected_by_reason"] = rejected
    return metrics


def write(path: str | PathLike[str], metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``: the same metrics give the same bytes, which end in a newline.

    Raises:
        RecordingError: when it cannot be written.
    """
    text = json.dumps(metrics, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror or error}") from error


def _rms(errors: Floats) -> float | None:
    finite = errors[np.isfinite(errors)]
    return number(float(np.sqrt(np.mean(finite**2)))) if finite.size else None


def _least(*found: Closest | None) -> float | None:
    distances = [each.distance_m for each in found if each is not None]
    return number(min(distances)) if distances else None


def _incomplete(recording: Recording) -> list[str]:
    """Sentences for what the data do not hold."""
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
    end_s, planned_s = recording.end_s, recording.planned_s
    longest: dict[int, Gap] = {}
    for gap in _gaps(recording):
        known = longest.get(gap.robot)
        if not gap.rule and (known is None or gap.end_s - gap.start_s > known.end_s - known.start_s):
            longest[gap.robot] = gap
    out += [
        f"The data are incomplete: robot {robot} sent no pose from {gap.start_s:.2f} s to {gap.end_s:.2f} s."
        for robot, gap in longest.items()
    ]
    if end_s < planned_s - GAP_S:
        why = ""
        if recording.stopped_s is not None and recording.stopped_s <= end_s + GAP_S:
            why = ": it was stopped"
        elif recording.interrupted:
            why = ": it was interrupted"
        out.append(f"The run ended after {end_s:.1f} s of the {planned_s:.1f} s that were planned{why}.")
    return out


@dataclass(frozen=True)
class Gap:
    """A time without a pose of one robot; `rule` names the rule that stopped its plant, if one did."""

    robot: int
    start_s: float
    end_s: float
    rule: str


def _gaps(recording: Recording) -> list[Gap]:
    """Gaps longer than `GAP_S`."""
    out = []
    end_s, epoch_ns = recording.end_s, recording.epoch_ns or 0
    for robot, data in recording.robots.items():
        if not len(data.body):
            continue
        times = np.concatenate([[0.0], np.clip(data.body.t, 0.0, end_s), [end_s]])
        for k in np.flatnonzero(np.diff(times) > GAP_S).tolist():
            start_s, stop_s = float(times[k]), float(times[k + 1])
            asked = [
                event.rule
                for event in recording.events
                if event.robot == robot
                and event.role == "plant"
                and event.what in ("kill", "stop")
                and start_s - GAP_S <= (event.time_ns - epoch_ns) / 1e9 <= stop_s
            ]
            # A plant that never came back leaves a formation of which nothing is known.
            out.append(Gap(robot, start_s, stop_s, asked[0] if asked and stop_s < end_s else ""))
    return out


def _states(recording: Recording) -> list[str]:
    """Sentences for robots that did not drive at the end of the drive."""
    out = []
    for robot, data in recording.robots.items():
        last = data.status.at(recording.end_s)
        if last is None or last[0] in _GOOD_STATES:
            continue
        state, reason = last
        why = f" ({reason})" if reason else ""
        meaning = {
            State.FAULT.value: "it braked because something of its own was wrong",
            State.HOLDING.value: "it braked because a neighbour was silent for too long",
        }.get(state, "it did not drive")
        out.append(f"Robot {robot} ended the drive in state {state}: {meaning}{why}.")
    return out


def _releases(recording: Recording) -> list[str]:
    """Sentences for the times in which robots were their operators'."""
    out = []
    for robot, data in recording.robots.items():
        for start_s, end_s, reason in data.status.periods(State.RELEASED.value):
            if start_s >= recording.end_s:
                continue
            until = "the end" if end_s is None or end_s >= recording.end_s else f"{end_s:.1f} s"
            why = f" ({reason})" if reason else ""
            out.append(
                f"Robot {robot} was released to its operator from {start_s:.1f} s to {until}{why}: it did "
                "not follow the law then."
            )
    return out


def _unsafe(found: Closest | None, safe_m: float, relation: str) -> list[str]:
    if found is None or not found.unsafe:
        return []
    i, j = found.pair
    others = {1: "", 2: " One other such pair came too close as well."}.get(
        found.unsafe, f" {found.unsafe - 1} other such pairs came too close as well."
    )
    return [
        f"Robots {i} and {j}, which {relation}, came within {found.distance_m:.3f} m of each other at "
        f"{found.t_s:.2f} s; the safe distance is {safe_m:.3f} m.{others}"
    ]


def _unsettled(a: Analysis, ids: Sequence[int]) -> list[str]:
    off = np.flatnonzero(a.off[-1])
    if not len(off):
        return []
    error = np.abs(a.distances[-1] - a.wanted)
    worst = int(off[np.argmax((error / a.wanted)[off])])
    i, j = (ids[index] for index in a.edges[worst])
    others = {1: "", 2: " One other edge was off as well."}.get(
        len(off), f" {len(off) - 1} other edges were off as well."
    )
    return [
        f"The formation had not settled at the end ({a.grid[-1]:.1f} s): robots {i} and {j} were "
        f"{a.distances[-1, worst]:.3f} m apart instead of {a.wanted[worst]:.3f} m, "
        f"{100 * error[worst] / a.wanted[worst]:.0f} % off where {100 * SETTLED:.0f} % is allowed.{others}"
    ]
