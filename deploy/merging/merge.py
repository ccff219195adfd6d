"""Makes one run's folder of what robots' computers recorded; `handfast report` works on it as on any other.

Messages come in the order of their reception, each by the clock of its robot's computer. A robot's own
recording is believed about that robot, and most robots' or the operators' seals about the fleet
(`deploy.merging.believed`). What is missing is said in warnings, which the report shows.
"""

from __future__ import annotations

import heapq
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median_high, median_low
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode, newer
from handfast.agent.messages.types import TIME_NS_MAX, Mission, Resume, Stop
from handfast.agent.recorder.recorder import Received
from handfast.agent.security.sealed_order import Opener
from handfast.deploy.merging.believed import FleetFiles, HeldFaults, Order, orders_given
from handfast.deploy.merging.robot_files import GAP_NS, Damage, MergeError, RobotFile, by_time, recordings
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report.run_folder import RunFolder
from handfast.deploy.verdict.run_result import RunResult

MARGIN_NS: Final = 5 * NS_PER_S
"""Time before and after the last mission that is taken as well."""
GAPS_SHOWN: Final = 5


@dataclass(frozen=True)
class Choice:
    """The part of the recordings that is made into a run.

    By default the fleet's last mission, from `MARGIN_NS` before its epoch until `MARGIN_NS` after its end.

    Args:
        fleet: name of the fleet.
        since_ns, until_ns: beginning and end (wall clock) instead.
        everything: all that there is, instead.
    """

    fleet: str
    since_ns: int | None = None
    until_ns: int | None = None
    everything: bool = False


class Known(NamedTuple):
    """What the operator's computer knows by itself.

    Args:
        fleet: its own fleet file.
        opener: of orders that the fleet's operators have sealed; None: orders count that most robots have.
        fetched_before: robots whose recordings are copies of some time ago.
    """

    fleet: Fleet | None = None
    opener: Opener | None = None
    fetched_before: Collection[int] = ()


class Merged(NamedTuple):
    """The run that was made of recordings, and its `result`."""

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
    choice: Choice,
    *,
    known: Known | None = None,
    warnings: Sequence[str] = (),
    report: bool = True,
) -> Merged:
    """Makes the run's folder `out` of what robots recorded; when it cannot be made, nothing stays of it.

    Args:
        folders: by robot, with its files.
        known: what the operator's computer knows by itself.
        warnings: other warnings about the recordings.

    Raises:
        MergeError: there is nothing to make it of, or something cannot be read.
        handfast.deploy.report.run_folder.FolderError: `out` is not empty or cannot be written.
        handfast.deploy.recording.run_files.RecordingError: the recording cannot be written.
    """
    damage = Damage()
    plan = _plan(recordings(folders, damage), choice, known or Known())
    folder = RunFolder(out, plan.fleet, "run")
    count = 0
    try:
        for received_ns, key, payload in heapq.merge(plan.orders, _messages(plan, damage)):
            folder.record(received_ns, key, payload)
            count += 1
        if count == len(plan.orders):
            what = (
                "all that was recorded {} is damaged" if damage.pieces.total() else "nothing was recorded {}"
            )
            raise MergeError(what.format(_times(plan.since_ns, plan.until_ns)))
        said = (*warnings, *plan.warnings, *_missing(plan, damage))
        result = folder.finish(warnings=said, report=report)
    except BaseException:  # Ctrl-C as well
        with suppress(RecordingError):
            folder.close()
        shutil.rmtree(out, ignore_errors=True)
        raise
    return Merged(out, tuple(sorted(plan.robots)), count, plan.since_ns, plan.until_ns, said, result)


# --- what is taken --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Plan:
    """Files of one fleet that are read, within a time (wall clock, ns).

    `orders`: by the time at which they were given, those within the time and earlier ones that still hold.
    """

    files: Sequence[RobotFile]
    fleet: Fleet
    since_ns: int
    until_ns: int
    epoch_ns: int | None
    orders: Sequence[Received]
    warnings: Sequence[str]

    @property
    def robots(self) -> frozenset[int]:
        return frozenset(file.robot for file in self.files)


def _plan(recorded: Sequence[RobotFile], choice: Choice, known: Known) -> _Plan:
    name = choice.fleet
    ours = [file for file in recorded if file.about and file.about.fleet == name]
    if not ours:
        raise MergeError(f"there are no recordings of a fleet {name} in what was given")
    files = FleetFiles(known.fleet)
    given, left_out = _orders(ours, known, files, choice.until_ns)
    mission = _last_mission(given, files.digests(ours))
    since_ns, until_ns, warnings = _window(choice, mission)
    inside = [file for file in ours if file.overlaps(since_ns, until_ns)]
    if not inside:
        there_is = _times(min(file.first_ns for file in ours), max(file.last_ns for file in ours))
        raise MergeError(f"nothing was recorded {_times(since_ns, until_ns)}, only {there_is}")
    fleet, found, said = files.choose(inside, mission.digest if mission else None)
    given = [order for order in given if order.time_ns <= until_ns]
    holding = _holding(given, mission, since_ns, frozenset(file.robot for file in found))
    received = [(order.time_ns, _key(name, order), encode(order)) for order in holding]
    epoch_ns = mission.epoch_ns if mission else None
    return _Plan(found, fleet, since_ns, until_ns, epoch_ns, received, [*warnings, *said, *left_out])


def _last_mission(given: Sequence[Order], digests: Collection[str]) -> Mission | None:
    """The last mission of one of these fleet files."""
    last: Mission | None = None
    for order in given:
        if isinstance(order, Mission) and order.digest in digests and newer(order, last):
            last = order
    return last


def _orders(
    ours: Sequence[RobotFile], known: Known, files: FleetFiles, until_ns: int | None
) -> tuple[list[Order], list[str]]:
    """The orders that count, and a line for each robot whose recording has others."""
    orders: dict[int, list[bytes]] = {}
    last_ns: dict[int, int] = {}
    for file in ours:
        orders.setdefault(file.robot, []).extend(payload for _, _, payload in file.orders)
        last_ns[file.robot] = max(file.last_ns, last_ns.get(file.robot, 0))

    def voters(given_ns: int) -> int:
        # An earlier copy says nothing of later orders. All others have a vote: what a recording says of its
        # own time must not take it from them.
        return sum(robot not in known.fetched_before or last_ns[robot] >= given_ns for robot in orders)

    given, left_out = orders_given(orders, known.opener, voters)
    why = "no operator has sealed" if known.opener is not None else "most robots' recordings do not have"
    lines = []
    for robot, count in sorted(left_out.items()):
        what = "an order is" if count == 1 else f"{count} orders are"
        lines.append(f"of {files.who(robot)} {what} left out, which {why}")
    return [order for order in given if until_ns is None or order.time_ns <= until_ns], lines


def _key(fleet: str, order: Order) -> str:
    """The key on which operators give such an order."""
    if isinstance(order, Mission):
        return key_expressions.mission(fleet)
    return key_expressions.stop(fleet) if isinstance(order, Stop) else key_expressions.resume(fleet)


def _window(choice: Choice, mission: Mission | None) -> tuple[int, int, list[str]]:
    """Beginning, end, and warnings about them."""
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


def _holding(
    given: Sequence[Order], mission: Mission | None, since_ns: int, robots: frozenset[int]
) -> Iterator[Order]:
    """The orders from `since_ns` on; of earlier ones the mission's, and a stop that still holds for one of
    `robots`, with the resumes after it."""
    earlier = [order for order in given if order.time_ns < since_ns]
    stopped = max((order.version for order in earlier if isinstance(order, Stop)), default=TIME_NS_MAX)
    resumes = [order for order in earlier if isinstance(order, Resume) and order.version >= stopped]
    is_halted = not robots <= frozenset().union(*(order.robots or robots for order in resumes))
    for order in given:
        if isinstance(order, Mission):
            holds = mission is not None and order.epoch_ns == mission.epoch_ns
        else:
            holds = is_halted and order.version >= stopped
        if holds or order.time_ns >= since_ns:
            yield order


def _messages(plan: _Plan, damage: Damage) -> Iterator[Received]:
    """The robots' messages by time, without fault rules that one robot alone says it held."""
    held = HeldFaults(plan.fleet.fleet.name, plan.robots)
    held.count(by_time(plan.files, plan.since_ns, plan.until_ns, Damage(), held.keys))
    for received in by_time(plan.files, plan.since_ns, plan.until_ns, damage):
        if (robot := held.made_up_by(*received[1:])) is None:
            yield received
        else:
            damage.foreign[robot] += 1


# --- what is missing ------------------------------------------------------------------------------


def _missing(plan: _Plan, damage: Damage) -> Iterator[str]:
    """Sentences about what is missing in the recordings."""
    for robot in sorted(damage.refused):
        yield f"robot {robot}'s computer also gave recordings of other robots: they are left out"
    silent = [robot for robot in plan.fleet.ids if robot not in plan.robots]
    if silent:
        yield f"nothing that {'robot' if len(silent) == 1 else 'robots'} {_list(silent)} recorded is here"
    recorded: dict[int, list[RobotFile]] = {robot: [] for robot in sorted(plan.robots)}
    for file in plan.files:
        recorded[file.robot].append(file)
    begin_ns, end_ns = _most_recorded(plan)
    for robot, files in recorded.items():
        if gaps := _gaps(files, begin_ns, end_ns):
            spans = [f"{_when(a, plan.epoch_ns)} to {_when(b, plan.epoch_ns)}" for a, b in gaps]
            more = f" and {len(gaps) - GAPS_SHOWN} times more" if len(gaps) > GAPS_SHOWN else ""
            yield f"nothing was recorded of robot {robot} from {', '.join(spans[:GAPS_SHOWN])}{more}"
        if pieces := damage.pieces[robot]:
            what = "a damaged piece is" if pieces == 1 else f"{pieces} damaged pieces are"
            yield f"of robot {robot}'s recording {what} left out"
        if foreign := damage.foreign[robot]:
            what = "a message is" if foreign == 1 else f"{foreign} messages are"
            yield f"of robot {robot}'s recording {what} left out that it alone tells of, or cannot"


def _most_recorded(plan: _Plan) -> tuple[int, int]:
    """Beginning and end of the time in which most robots were recorded: one robot's longer recording says
    nothing of the others."""
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    for file in plan.files:
        for first_ns, last_ns in file.stretches:
            if first_ns <= plan.until_ns and last_ns >= plan.since_ns:
                first[file.robot] = max(min(first_ns, first.get(file.robot, first_ns)), plan.since_ns)
                last[file.robot] = min(max(last_ns, last.get(file.robot, last_ns)), plan.until_ns)
    return (median_high(first.values()), median_low(last.values())) if first else (0, 0)


def _gaps(files: Sequence[RobotFile], begin_ns: int, end_ns: int) -> list[tuple[int, int]]:
    """Times (from, to) of at least `GAP_NS` in which nothing is recorded."""
    gaps = []
    reached_ns = begin_ns
    for first_ns, last_ns in sorted(stretch for file in files for stretch in file.stretches):
        if min(first_ns, end_ns) - reached_ns >= GAP_NS:
            gaps.append((reached_ns, min(first_ns, end_ns)))
        reached_ns = max(reached_ns, last_ns)
    return [*gaps, (reached_ns, end_ns)] if end_ns - reached_ns >= GAP_NS else gaps


def _when(at_ns: int, epoch_ns: int | None) -> str:
    """Fleet time, or the wall clock where there is no epoch."""
    return _clock(at_ns) if epoch_ns is None else f"{(at_ns - epoch_ns) / NS_PER_S:.1f} s"


def _times(since_ns: int, until_ns: int) -> str:
    """A time in words; "at all" for all times."""
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
