"""What has to be said of the recordings that a run was made of: what is missing, or damaged."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from statistics import median_high, median_low
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import TIME_NS_MAX
from handfast.deploy.merging.robot_recording import GAP_NS, Damage, SegmentFile

GAPS_SHOWN: Final = 5
VERSION_MAX: Final = 60
"""Characters of a version that are shown: what a recording says is anybody's words."""


class Window(NamedTuple):
    """What was looked at (wall clock, ns), and when fleet time began, None without a mission."""

    since_ns: int
    until_ns: int
    epoch_ns: int | None


def missing(
    taken: Sequence[SegmentFile], refused: Sequence[int], damage: Damage, fleet: Fleet, window: Window
) -> list[str]:
    """What has to be said of the recordings that a run was made of.

    Args:
        refused: robots in whose folders were segments of another robot.
    """
    found = [
        f"robot {robot}'s computer also gave recordings of other robots: they are left out"
        for robot in refused
    ]
    by_robot: dict[int, list[SegmentFile]] = {robot: [] for robot in fleet.ids}
    for segment in taken:
        by_robot.setdefault(segment.about.robot, []).append(segment)
    silent = [robot for robot in fleet.ids if not by_robot[robot]]
    if silent:
        found.append(
            f"nothing that {'robot' if len(silent) == 1 else 'robots'} {_list(silent)} recorded is here"
        )
    versions: dict[str, list[int]] = {}
    for robot, segments in by_robot.items():
        for version in sorted({printable(segment.about.version)[:VERSION_MAX] for segment in segments}):
            versions.setdefault(version, []).append(robot)
    if len(versions) > 1:
        said = "; ".join(f"{version} on {_list(robots)}" for version, robots in versions.items())
        found.append(f"robots had different versions of handfast: {said}")
    begin_ns, end_ns = _most_recorded([each for each in by_robot.values() if each], window)
    for robot, segments in by_robot.items():
        if not segments:
            continue
        gaps = _gaps(segments, begin_ns, end_ns)
        if gaps:
            shown = ", ".join(
                f"{_when(a, window.epoch_ns)} to {_when(b, window.epoch_ns)}" for a, b in gaps[:GAPS_SHOWN]
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
            found.append(f"of robot {robot}'s recording {what} left out that it alone tells of, or cannot")
    return found


def _most_recorded(of_robots: Sequence[Sequence[SegmentFile]], window: Window) -> tuple[int, int]:
    """From when and until when most robots were recorded: one that says it was for longer says nothing of the
    others."""
    firsts, lasts = [], []
    for segments in of_robots:
        stretches = [
            stretch
            for segment in segments
            for stretch in segment.stretches
            if stretch[0] <= window.until_ns and stretch[1] >= window.since_ns
        ]
        if stretches:
            firsts.append(max(min(first_ns for first_ns, _ in stretches), window.since_ns))
            lasts.append(min(max(last_ns for _, last_ns in stretches), window.until_ns))
    return (median_high(firsts), median_low(lasts)) if firsts else (0, 0)


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


def times(since_ns: int, until_ns: int) -> str:
    """In words; "at all" for all times."""
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
