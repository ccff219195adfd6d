"""Makes one run's folder of what robots' computers recorded; `handfast report` works on it as on any other.

Messages come in the order of their reception, each by the clock of its robot's computer. What is missing is
said in warnings, which the report shows.
"""

from __future__ import annotations

import heapq
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from agent.common.time import NS_PER_S
from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.messages.codec import newer
from agent.messages.types import TIME_NS_MAX, Mission, Resume, Stop
from agent.recorder.segments import Received
from deploy.hosts.robot_recording import (
    GAP_NS,
    Damage,
    MergeError,
    RecordedOrder,
    SegmentFile,
    by_time,
    recordings,
)
from deploy.recording.recorder import RecordingError
from deploy.report.run_folder import RunFolder
from deploy.verdict.run_result import RunResult

MARGIN_NS: Final = 5 * NS_PER_S
"""Of the last mission so much before and after is taken as well."""
GAPS_SHOWN: Final = 5


@dataclass(frozen=True)
class Choice:
    """Which part of the recordings is made into a run.

    By default the last mission of the fleet that was recorded last, from `MARGIN_NS` before its epoch until
    so long after its end.

    Args:
        fleet: name of the fleet.
        since_ns, until_ns: from when and until when (wall clock) instead.
        everything: all that there is, instead.
    """

    fleet: str | None = None
    since_ns: int | None = None
    until_ns: int | None = None
    everything: bool = False


class Merged(NamedTuple):
    """The run that was made of recordings. `result` is what came of it."""

    folder: Path
    robots: tuple[int, ...]
    messages: int
    since_ns: int
    until_ns: int
    warnings: tuple[str, ...]
    result: RunResult


def merge(
    folders: Mapping[int, Path],
    out: Path,
    choice: Choice | None = None,
    *,
    warnings: Sequence[str] = (),
    report: bool = True,
) -> Merged:
    """Makes the run's folder `out` of what robots recorded; when it cannot be made, nothing stays of it.

    Where robots had different fleet files in that time, those count whose file is the mission's, or most
    robots'; warnings name the others.

    Args:
        folders: by robot, with its segments.
        warnings: what else has to be said of the recordings.

    Raises:
        MergeError: there is nothing to make it of, or something cannot be read.
        agent.fleet.model.FleetError: the fleet file in the recordings is none that this version can read.
        deploy.report.run_folder.FolderError: `out` is not empty or cannot be written.
        deploy.recording.recorder.RecordingError: the recording cannot be written.
    """
    there_is = recordings(folders)
    plan = _plan(there_is.segments, choice or Choice())
    fleet = resolved(
        parse_fleet(
            plan.newest.about.fleet_toml, source=f"the fleet file in {plan.newest.path}", recorded=True
        )
    )
    damage = Damage()
    folder = RunFolder(out, fleet, "run")
    count = 0
    try:
        for received_ns, key, payload in _messages(plan, damage):
            folder.record(received_ns, key, payload)
            count += 1
        if count == len(plan.orders):
            times = _times(plan.since_ns, plan.until_ns)
            raise MergeError(
                f"all that was recorded {times} is damaged"
                if damage.pieces
                else f"nothing was recorded {times}"
            )
        said = (*warnings, *plan.warnings, *_refused(there_is.refused), *_missing(plan, fleet, damage))
        result = folder.finish(warnings=said, report=report)
    except BaseException:  # Ctrl-C as well
        with suppress(RecordingError):
            folder.close()
        shutil.rmtree(out, ignore_errors=True)
        raise
    robots = sorted({segment.about.robot for segment in plan.segments})
    return Merged(out, tuple(robots), count, plan.since_ns, plan.until_ns, said, result)


# --- what is taken --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Plan:
    """What is read: segments of one fleet file, within a time (wall clock, ns).

    `orders`: by the time of their reception, those within the time and those from before that still hold.
    """

    segments: Sequence[SegmentFile]
    newest: SegmentFile
    since_ns: int
    until_ns: int
    epoch_ns: int | None
    orders: Sequence[Received]
    warnings: Sequence[str]


def _plan(segments: Sequence[SegmentFile], choice: Choice) -> _Plan:
    if not segments:
        raise MergeError("there are no recordings of robots in what was given")
    name = choice.fleet or max(segments, key=_begun).about.fleet
    ours = [segment for segment in segments if segment.about.fleet == name]
    if not ours:
        there_are = ", ".join(sorted({segment.about.fleet for segment in segments}))
        raise MergeError(f"there are no recordings of a fleet {name}; there are some of {there_are}")
    recorded = sorted(
        (order for segment in ours for order in segment.orders), key=lambda each: each.received[0]
    )
    mission = _last_mission(recorded, {segment.about.digest for segment in ours}, choice.until_ns)
    since_ns, until_ns, warnings = _window(choice, mission)
    inside = [segment for segment in ours if segment.overlaps(since_ns, until_ns)]
    if not inside:
        first_ns = min(segment.first_ns for segment in ours)
        last_ns = max(segment.last_ns for segment in ours)
        raise MergeError(
            f"nothing was recorded {_times(since_ns, until_ns)}, only {_times(first_ns, last_ns)}"
        )
    digest = mission.digest if mission is not None else ""
    if digest not in {segment.about.digest for segment in inside}:
        digest = _digest_of_most(inside)
    taken = [segment for segment in inside if segment.about.digest == digest]
    others = sorted({segment.about.robot for segment in inside if segment.about.digest != digest})
    if others:
        which = "robot" if len(others) == 1 else "robots"
        warnings.append(
            f"{which} {_list(others)} ran another fleet file in this time: its recording is left out"
        )
    robots = frozenset(segment.about.robot for segment in taken)
    orders = _orders([each for each in recorded if each.received[0] <= until_ns], mission, since_ns, robots)
    newest = max(taken, key=_begun)
    epoch_ns = None if mission is None else mission.epoch_ns
    return _Plan(taken, newest, since_ns, until_ns, epoch_ns, orders, warnings)


def _begun(segment: SegmentFile) -> int:
    return segment.first_ns


def _last_mission(
    recorded: Iterable[RecordedOrder], digests: set[str], until_ns: int | None
) -> Mission | None:
    last: Mission | None = None
    for (received_ns, *_), order in recorded:
        if (
            isinstance(order, Mission)
            and order.digest in digests
            and (until_ns is None or received_ns <= until_ns)
            and newer(order, last)
        ):
            last = order
    return last


def _window(choice: Choice, mission: Mission | None) -> tuple[int, int, list[str]]:
    """From when and until when, and what is to be said of it."""
    if choice.since_ns is not None or choice.until_ns is not None:
        since_ns = 0 if choice.since_ns is None else choice.since_ns
        until_ns = TIME_NS_MAX if choice.until_ns is None else choice.until_ns
        if since_ns >= until_ns:
            raise MergeError(f"nothing can be {_times(since_ns, until_ns)}: the end is before the beginning")
        return since_ns, until_ns, []
    if choice.everything:
        return 0, TIME_NS_MAX, []
    if mission is None:
        return 0, TIME_NS_MAX, ["no mission was recorded: this is all that there is"]
    return mission.epoch_ns - MARGIN_NS, mission.epoch_ns + mission.duration_ns + MARGIN_NS, []


def _digest_of_most(segments: Sequence[SegmentFile]) -> str:
    """The fleet file of most robots, by the newest segment of each."""
    newest = {segment.about.robot: segment for segment in sorted(segments, key=_begun)}
    counts = Counter(segment.about.digest for segment in newest.values())
    return max(
        newest.values(), key=lambda segment: (counts[segment.about.digest], _begun(segment))
    ).about.digest


def _orders(
    recorded: Sequence[RecordedOrder], mission: Mission | None, since_ns: int, robots: frozenset[int]
) -> list[Received]:
    """The orders from `since_ns` on; of those before what belongs to the mission, and a stop that still holds
    for one of `robots`, with the resumes after it."""
    earlier = [order for received, order in recorded if received[0] < since_ns]
    stopped = max((order.version for order in earlier if isinstance(order, Stop)), default=None)
    halted = robots if stopped is not None else frozenset()
    for order in earlier:
        if stopped is not None and isinstance(order, Resume) and order.version >= stopped:
            halted -= frozenset(order.robots) or robots
    kept = set()
    for received, order in recorded:
        if isinstance(order, Mission):
            holds = mission is not None and order.epoch_ns == mission.epoch_ns
        else:
            holds = bool(halted) and stopped is not None and order.version >= stopped
        if holds or received[0] >= since_ns:
            kept.add(received)
    return sorted(kept)


# --- what is missing ------------------------------------------------------------------------------


def _messages(plan: _Plan, damage: Damage) -> Iterator[Received]:
    """All that goes into the run, by time. Orders whose own segment is gone are known from others."""
    orders = set(plan.orders)
    others = by_time(plan.segments, plan.since_ns, plan.until_ns, damage)
    return heapq.merge(plan.orders, (received for received in others if received not in orders))


def _refused(robots: Sequence[int]) -> list[str]:
    return [
        f"robot {robot}'s computer also gave recordings of other robots: they are left out"
        for robot in robots
    ]


def _missing(plan: _Plan, fleet: Fleet, damage: Damage) -> list[str]:
    """What has to be said of the recordings that a run was made of."""
    by_robot: dict[int, list[SegmentFile]] = {robot: [] for robot in fleet.ids}
    for segment in plan.segments:
        by_robot.setdefault(segment.about.robot, []).append(segment)
    found = []
    silent = [robot for robot in fleet.ids if not by_robot[robot]]
    if silent:
        found.append(
            f"nothing that {'robot' if len(silent) == 1 else 'robots'} {_list(silent)} recorded is here"
        )
    versions: dict[str, list[int]] = {}
    for robot, segments in by_robot.items():
        for version in sorted({segment.about.version for segment in segments}):
            versions.setdefault(version, []).append(robot)
    if len(versions) > 1:
        said = "; ".join(f"{version} on {_list(robots)}" for version, robots in versions.items())
        found.append(f"robots had different versions of handfast: {said}")
    stretches = [
        (max(first_ns, plan.since_ns), min(last_ns, plan.until_ns))
        for segment in plan.segments
        for first_ns, last_ns in segment.stretches
        if first_ns <= plan.until_ns and last_ns >= plan.since_ns
    ]
    begin_ns = min((first_ns for first_ns, _ in stretches), default=0)
    end_ns = max((last_ns for _, last_ns in stretches), default=0)
    for robot, segments in by_robot.items():
        if not segments:
            continue
        gaps = _gaps(segments, begin_ns, end_ns)
        if gaps:
            shown = ", ".join(
                f"{_when(a, plan.epoch_ns)} to {_when(b, plan.epoch_ns)}" for a, b in gaps[:GAPS_SHOWN]
            )
            more = f" and {len(gaps) - GAPS_SHOWN} times more" if len(gaps) > GAPS_SHOWN else ""
            found.append(f"nothing was recorded of robot {robot} from {shown}{more}")
        losses = [loss for segment in segments for loss in segment.losses if begin_ns <= loss.at_ns <= end_ns]
        if lost := sum(loss.messages for loss in losses):
            found.append(f"the disk of robot {robot}'s computer did not take {lost} messages")
        if any(loss.overflow for loss in losses):
            found.append(f"robot {robot}'s recorder did not keep up: some messages are missing")
        if pieces := damage.pieces.get(robot, 0):
            what = "a damaged piece is" if pieces == 1 else f"{pieces} damaged pieces are"
            found.append(f"of robot {robot}'s recording {what} left out")
        if foreign := damage.foreign.get(robot, 0):
            what = "a message is" if foreign == 1 else f"{foreign} messages are"
            found.append(f"of robot {robot}'s recording {what} left out that it cannot have heard")
    return found


def _gaps(segments: Sequence[SegmentFile], begin_ns: int, end_ns: int) -> list[tuple[int, int]]:
    """Times (from, to) of at least `GAP_NS` between two others in which nothing is recorded."""
    gaps = []
    reached_ns = begin_ns
    for first_ns, last_ns in sorted(stretch for segment in segments for stretch in segment.stretches):
        if min(first_ns, end_ns) - reached_ns >= GAP_NS:
            gaps.append((reached_ns, min(first_ns, end_ns)))
        reached_ns = max(reached_ns, last_ns)
    if end_ns - reached_ns >= GAP_NS:
        gaps.append((reached_ns, end_ns))
    return gaps


# --- words ----------------------------------------------------------------------------------------


def _when(at_ns: int, epoch_ns: int | None) -> str:
    """Fleet time, or where there is none the wall clock."""
    return _clock(at_ns) if epoch_ns is None else f"{(at_ns - epoch_ns) / NS_PER_S:.1f} s"


def _times(since_ns: int, until_ns: int) -> str:
    words = [f"from {_clock(since_ns)}"] if since_ns > 0 else []
    words += [f"until {_clock(until_ns)}"] if until_ns < TIME_NS_MAX else []
    return " ".join(words) or "at all"


def _clock(at_ns: int) -> str:
    try:
        return f"{datetime.fromtimestamp(at_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError, OSError):
        return f"{at_ns} ns"


def _list(robots: Sequence[int]) -> str:
    return ", ".join(map(str, robots))
