"""Makes one run's folder of what robots' computers recorded; `handfast report` works on it as on any other.

Messages come in the order of their reception, each by the clock of its robot's computer. What robots say is
believed of each robot by its own recording; what all of them share, the fleet file, orders and fault rules,
by what most have, or an operator has sealed. What is missing is said in warnings, which the report shows.
"""

from __future__ import annotations

import heapq
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode, newer
from handfast.agent.messages.types import TIME_NS_MAX, Mission, Resume, Stop
from handfast.agent.recorder.segments import Received
from handfast.agent.security.sealed_order import Openers
from handfast.deploy.merging.fleet_files import FleetFiles, Ruling, taken
from handfast.deploy.merging.held_faults import HeldFaults
from handfast.deploy.merging.missing import Window, missing, times
from handfast.deploy.merging.orders import Order, Orders, orders_given
from handfast.deploy.merging.robot_recording import Damage, MergeError, SegmentFile, by_time, recordings
from handfast.deploy.recording.recorder import RecordingError
from handfast.deploy.report.run_folder import RunFolder
from handfast.deploy.verdict.run_result import RunResult

MARGIN_NS: Final = 5 * NS_PER_S
"""Of the last mission so much before and after is taken as well."""


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


class Known(NamedTuple):
    """What the operator's computer knows by itself.

    Args:
        fleet: its own fleet file.
        opener: of orders that the fleet's operators have sealed; None: what most robots have counts.
        fetched_before: robots whose recordings are copies of some time ago.
    """

    fleet: Fleet | None = None
    opener: Openers | None = None
    fetched_before: Collection[int] = ()


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
    known: Known | None = None,
    warnings: Sequence[str] = (),
    report: bool = True,
) -> Merged:
    """Makes the run's folder `out` of what robots recorded; when it cannot be made, nothing stays of it.

    Where robots had different fleet files in that time, those count whose file is the mission's, the
    operator's or most robots'; warnings name the others.

    Args:
        folders: by robot, with its segments.
        known: what the operator's computer knows by itself.
        warnings: what else has to be said of the recordings.

    Raises:
        MergeError: there is nothing to make it of, or something cannot be read.
        handfast.deploy.report.run_folder.FolderError: `out` is not empty or cannot be written.
        handfast.deploy.recording.recorder.RecordingError: the recording cannot be written.
    """
    there_is = recordings(folders)
    plan = _plan(there_is.segments, choice or Choice(), known or Known())
    fleet = plan.ruling.fleet
    damage = Damage()
    folder = RunFolder(out, fleet, "run")
    count = 0
    try:
        for received_ns, key, payload in heapq.merge(plan.orders, _messages(plan, damage)):
            folder.record(received_ns, key, payload)
            count += 1
        if count == len(plan.orders):
            when = times(plan.since_ns, plan.until_ns)
            raise MergeError(
                f"all that was recorded {when} is damaged"
                if damage.pieces
                else f"nothing was recorded {when}"
            )
        window = Window(plan.since_ns, plan.until_ns, plan.epoch_ns)
        said = (*warnings, *plan.warnings, *missing(plan.segments, there_is.refused, damage, fleet, window))
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

    `orders`: by the time at which they were given, those within the time and those from before that still
    hold.
    """

    segments: Sequence[SegmentFile]
    ruling: Ruling
    since_ns: int
    until_ns: int
    epoch_ns: int | None
    orders: Sequence[Received]
    warnings: Sequence[str]


def _plan(segments: Sequence[SegmentFile], choice: Choice, known: Known) -> _Plan:
    if not segments:
        raise MergeError("there are no recordings of robots in what was given")
    name = choice.fleet or max(segments, key=_begun).about.fleet
    ours = [segment for segment in segments if segment.about.fleet == name]
    if not ours:
        there_are = ", ".join(sorted({printable(segment.about.fleet) for segment in segments}))
        raise MergeError(f"there are no recordings of a fleet {name}; there are some of {there_are}")
    files = FleetFiles(known.fleet)
    orders = _orders_in(ours, known)
    given = [order for order in orders.given if choice.until_ns is None or order.time_ns <= choice.until_ns]
    mission = _last_mission(given, files, ours)
    since_ns, until_ns, warnings = _window(choice, mission)
    inside = [segment for segment in ours if segment.overlaps(since_ns, until_ns)]
    if not inside:
        first_ns = min(segment.first_ns for segment in ours)
        last_ns = max(segment.last_ns for segment in ours)
        raise MergeError(f"nothing was recorded {times(since_ns, until_ns)}, only {times(first_ns, last_ns)}")
    ruling = files.choose(inside, None if mission is None else mission.digest)
    found, said = taken(files, inside, ruling)
    warnings += [*said, *_not_given(orders, files, known)]
    robots = frozenset(segment.about.robot for segment in found)
    given = [order for order in given if order.time_ns <= until_ns]
    holding = [
        (order.time_ns, _key(name, order), encode(order))
        for order in _holding(given, mission, since_ns, robots)
    ]
    epoch_ns = None if mission is None else mission.epoch_ns
    return _Plan(found, ruling, since_ns, until_ns, epoch_ns, holding, warnings)


def _begun(segment: SegmentFile) -> int:
    return segment.first_ns


def _orders_in(segments: Sequence[SegmentFile], known: Known) -> Orders:
    recorded: dict[int, list[bytes]] = {}
    last_ns: dict[int, int] = {}
    for segment in segments:
        robot = segment.about.robot
        recorded.setdefault(robot, []).extend(segment.orders)
        last_ns[robot] = max(segment.last_ns, last_ns.get(robot, 0))

    def voters(given_ns: int) -> int:
        # A copy of before tells nothing of what came after it. All others have a vote: what a recording says
        # of its own time must not take it from them.
        away = {robot for robot in known.fetched_before if last_ns.get(robot, 0) < given_ns}
        return len(recorded.keys() - away)

    return orders_given(recorded, known.opener, voters)


def _not_given(orders: Orders, files: FleetFiles, known: Known) -> list[str]:
    why = "no operator has sealed" if known.opener is not None else "most robots' recordings do not have"
    counts = {
        robot: "an order is" if count == 1 else f"{count} orders are"
        for robot, count in sorted(orders.left_out.items())
    }
    return [f"of {files.who(robot)} {count} left out, which {why}" for robot, count in counts.items()]


def _key(fleet: str, order: Order) -> str:
    """Where operators give such an order."""
    if isinstance(order, Mission):
        return key_expressions.mission(fleet)
    return key_expressions.stop(fleet) if isinstance(order, Stop) else key_expressions.resume(fleet)


def _last_mission(
    given: Iterable[Order], files: FleetFiles, segments: Sequence[SegmentFile]
) -> Mission | None:
    """The last one whose fleet file is in the recordings."""
    missions = [order for order in given if isinstance(order, Mission)]
    there_is = {
        digest: any(each.about.digest == digest for each in segments)
        and files.ruling(digest, segments) is not None
        for digest in {mission.digest for mission in missions}
    }
    last: Mission | None = None
    for mission in missions:
        if there_is[mission.digest] and newer(mission, last):
            last = mission
    return last


def _window(choice: Choice, mission: Mission | None) -> tuple[int, int, list[str]]:
    """From when and until when, and what is to be said of it."""
    if choice.since_ns is not None or choice.until_ns is not None:
        since_ns = 0 if choice.since_ns is None else choice.since_ns
        until_ns = TIME_NS_MAX if choice.until_ns is None else choice.until_ns
        if since_ns >= until_ns:
            raise MergeError(f"nothing can be {times(since_ns, until_ns)}: the end is before the beginning")
        return since_ns, until_ns, []
    if choice.everything:
        return 0, TIME_NS_MAX, []
    if mission is None:
        return 0, TIME_NS_MAX, ["no mission was recorded: this is all that there is"]
    return mission.epoch_ns - MARGIN_NS, mission.epoch_ns + mission.duration_ns + MARGIN_NS, []


def _holding(
    given: Sequence[Order], mission: Mission | None, since_ns: int, robots: frozenset[int]
) -> Iterator[Order]:
    """The orders from `since_ns` on; of those before what belongs to the mission, and a stop that still holds
    for one of `robots`, with the resumes after it."""
    earlier = [order for order in given if order.time_ns < since_ns]
    stopped = max((order.version for order in earlier if isinstance(order, Stop)), default=None)
    halted = robots if stopped is not None else frozenset()
    for order in earlier:
        if stopped is not None and isinstance(order, Resume) and order.version >= stopped:
            halted -= frozenset(order.robots) or robots
    for order in given:
        if isinstance(order, Mission):
            holds = mission is not None and order.epoch_ns == mission.epoch_ns
        else:
            holds = bool(halted) and stopped is not None and order.version >= stopped
        if holds or order.time_ns >= since_ns:
            yield order


def _messages(plan: _Plan, damage: Damage) -> Iterator[Received]:
    """What robots said, by time, but for fault rules that one robot alone says it held."""
    robots = {segment.about.robot for segment in plan.segments}
    every = by_time(plan.segments, plan.since_ns, plan.until_ns, Damage())
    held = HeldFaults(plan.ruling.fleet.fleet.name, robots, every)
    for received in by_time(plan.segments, plan.since_ns, plan.until_ns, damage):
        if (robot := held.made_up_by(*received[1:])) is None:
            yield received
        else:
            damage.add(robot, 0, 1)
