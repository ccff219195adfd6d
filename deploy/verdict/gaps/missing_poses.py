"""Poses that a run's data lack: what is said of each gap, and which of them fail the verdict.

A gap of a robot with a place in the formation fails it where the robot can have come too near to something
meanwhile (`deploy.verdict.gaps.stakes`), where it moved further than it can, where it lasts to the end, and
where gaps are more than `SHARE_MAX` of the drive. Else it is a warning, and so is what a rule stopped on
purpose. What a machine that was too slow hides is a warning as well where the robot moved less than the safe
distance meanwhile: all robots of it are late at once, and bounds of all of them together say little.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import hypot, inf
from typing import Final

import numpy as np

from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.gaps import GAP_S, PoseGap, pose_gaps
from handfast.deploy.analysis.presence import downs
from handfast.deploy.console.wording import NAMES_SHOWN, robots
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.gaps.stakes import Stake, Stakes
from handfast.deploy.verdict.overload import late_robots, on_late_machines
from handfast.deploy.verdict.standstills import Cause, Stall, stalls

FEW_GAPS: Final = 3
"""So many of one kind are told one by one."""
SHARE_MAX: Final = 0.2
"""Gaps may be so large a share of a drive: what is judged of a robot is judged by its poses, and radios that
are fit to drive by lose a few per cent."""
_TOO_SLOW: Final = "their machine was too slow"


@dataclass(frozen=True)
class Gap:
    """A time without a pose of one robot (`deploy.analysis.gaps`), and what is known of it.

    Attributes:
        lasts: to the end of the drive.
        rule: names the rule that stopped its plant, if one did.
        is_lost: it comes of a damaged file.
        is_hidden: where the robot was meanwhile is not known.
        moved_m: how far apart the poses before and after it are, m; inf where one is missing.
        stall: when no robot of its machine sent a pose, and why, if that was so.
        is_late: whether its machine was too slow (`deploy.verdict.overload`).
        for_good: whether that rule killed it, agent and plant, without an end.
        stake: what it can have come nearest to; None where there is nothing, or it is not asked.
        too_far_m: by how much it moved further than it can, m.
    """

    robot: int
    start_s: float
    end_s: float
    lasts: bool = False
    rule: str = ""
    is_lost: bool = False
    is_hidden: bool = True
    moved_m: float = 0.0
    stall: Stall | None = None
    is_late: bool = False
    for_good: bool = False
    stake: Stake | None = None
    too_far_m: float = -inf

    @property
    def lasts_s(self) -> float:
        return self.end_s - self.start_s

    @property
    def is_of_machine(self) -> bool:
        """Whether a machine that was too slow, or stood, is why; a plant that hangs is no matter of it."""
        return self.is_late or (self.stall is not None and self.stall.cause is not Cause.PLANTS)

    @property
    def may_have_harmed(self) -> bool:
        """Whether it can have come too near to something, as far as it is known where it can have been."""
        return self.too_far_m > 0.0 or (self.stake is not None and self.stake.may_be_broken)

    @property
    def when(self) -> str:
        return f"from {self.start_s:.2f} s to {self.end_s:.2f} s"


class MissingPoses:
    """The gaps of a run, and the sentences about them."""

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording, self._a = recording, a
        self.gaps: Sequence[Gap] = _described(recording, a)

    @property
    def reasons(self) -> list[str]:
        """Sentences that fail the verdict: of each robot what weighs most."""
        worst: dict[int, Gap] = {}
        for gap in self.gaps:
            if self._matters(gap) and not gap.is_lost:
                known = worst.get(gap.robot)
                if known is None or _weight(gap) > _weight(known):
                    worst[gap.robot] = gap
        shares = {robot: share for robot, share in self._shares().items() if robot not in worst}
        late = self._of_one_cause(worst)
        together: dict[str, list[Gap]] = {}
        alone: list[Gap] = []
        for robot, gap in worst.items():
            cause = gap.stall.cause.value if gap.stall else _TOO_SLOW if robot in late else ""
            (together.setdefault(cause, []) if cause else alone).append(gap)
        out = []
        if len(alone) <= NAMES_SHOWN:
            out += [_failed(gap) for gap in alone]
        else:
            out.append(f"The data are incomplete: {_many(alone)}{_worst_stake(alone)}.")
        for cause, gaps in together.items():
            out.append(f"The data are incomplete: {_many(gaps)}: {cause}{_worst_stake(gaps)}.")
        out += [self._share_words(robot, share) for robot, share in shares.items()]
        return out

    @property
    def worst_lost(self) -> Gap | None:
        """Of the gaps that a damaged file has made and that fail the verdict, the worst; None without any."""
        lost = [gap for gap in self.gaps if gap.is_lost and self._matters(gap)]
        return max(lost, key=_weight, default=None)

    @property
    def warnings(self) -> list[str]:
        """Sentences that fail nothing."""
        known = [gap for gap in self.gaps if not self._matters(gap) and not gap.stall and not gap.is_lost]
        placed = [gap for gap in known if not gap.rule and self.is_placed(gap.robot, gap.end_s)]
        late = [gap for gap in placed if gap.is_late]
        if len(late) <= FEW_GAPS:
            out = [
                f"Robot {gap.robot} sent no pose {gap.when}, for its machine was too slow{_moved([gap])}."
                for gap in late
            ]
        else:
            who = f"{_many(late).capitalize()}, for a machine was too slow"
            out = [f"{who}{_moved(late, 'they')}."]
        out += _passed([gap for gap in placed if not gap.is_late])
        for gap in known:
            if gap in placed:
                continue
            until = "the end" if gap.lasts else f"{gap.end_s:.2f} s"
            what = f"Robot {gap.robot} had no place in the formation any more"
            if gap.rule:
                what = f"Rule '{gap.rule}' stopped robot {gap.robot}'s plant"
            more = f"; it {gap.stake.words}" if gap.stake and gap.stake.may_be_broken else ""
            lacks = "its place is not known" if gap.is_hidden else "it sent no pose"
            out.append(f"{what}: from {gap.start_s:.2f} s to {until} {lacks}{more}.")
        return out

    def is_placed(self, robot: int, t: float) -> bool:
        """Whether a robot has a place in the formation then."""
        a = self._a
        row = min(int(np.searchsorted(a.grid, t)), len(a.grid) - 1)
        return bool(np.isfinite(a.desired[row, a.ids.index(robot), 0]))

    def _matters(self, gap: Gap) -> bool:
        """Whether a gap fails the verdict."""
        # Of who has no place by then the formation lacks nothing; who was killed for good is dead on purpose:
        # what the formation lacks then, others say. A plant that should have come back leaves a formation of
        # which nothing is known.
        if not self.is_placed(gap.robot, gap.end_s) or gap.for_good:
            return False
        if gap.lasts:
            return True
        return gap.may_have_harmed and not self._is_explained(gap)

    def _is_explained(self, gap: Gap) -> bool:
        """Whether something else is why, that is no matter of the robot."""
        return bool(gap.rule) or (gap.is_of_machine and gap.moved_m <= self._a.safe_m)

    def _shares(self) -> dict[int, float]:
        """Of robots whose gaps are too large a share of the drive, that share."""
        missed_s: dict[int, float] = {}
        for gap in self.gaps:
            if not self._is_explained(gap) and not gap.is_lost and self.is_placed(gap.robot, gap.end_s):
                missed_s[gap.robot] = missed_s.get(gap.robot, 0.0) + gap.lasts_s
        shares = {robot: lost_s / self._recording.end_s for robot, lost_s in missed_s.items()}
        return {robot: share for robot, share in shares.items() if share > SHARE_MAX}

    def _share_words(self, robot: int, share: float) -> str:
        longest = max((gap for gap in self.gaps if gap.robot == robot), key=lambda gap: gap.lasts_s)
        return (
            f"The data are incomplete: in {100 * share:.0f} % of the drive robot {robot} sent no pose, where "
            f"{100 * SHARE_MAX:.0f} % is allowed; for longest {longest.when}{_late_words(longest)}."
        )

    def _of_one_cause(self, silent: Collection[int]) -> list[int]:
        return of_one_cause(self._recording, silent)


def of_one_cause(recording: Recording, silent: Collection[int]) -> list[int]:
    """Which of these are one matter, as they are of a machine that was too slow: what they said may not
    have come through. None where that is one alone."""
    late = sorted(on_late_machines(recording).intersection(silent))
    return late if len(late) > 1 else []


def _weight(gap: Gap) -> tuple[bool, bool, float]:
    """What is said of a robot first: that it was lost, that nothing bounds where it was, how near it came."""
    near_m = inf if gap.stake is None else gap.stake.least_m - gap.stake.safe_m
    return gap.lasts, gap.too_far_m > 0.0, gap.lasts_s if gap.lasts else -near_m


def _failed(gap: Gap) -> str:
    """The sentence for one that fails the verdict."""
    if gap.lasts:
        return f"The data are incomplete: robot {gap.robot} sent no pose {gap.when}{_late_words(gap)}."
    what = f"Robot {gap.robot} sent no pose {gap.when}{_late_words(gap)}"
    if gap.too_far_m > 0.0:
        return (
            f"{what}, and had moved by {gap.moved_m:.2f} m then, further than it can: where it was meanwhile "
            "is not known."
        )
    assert gap.stake is not None
    return f"{what}: it {gap.stake.words}."


def _late_words(gap: Gap) -> str:
    return ", for its machine was too slow" if gap.is_late else ""


def _passed(gaps: Sequence[Gap]) -> list[str]:
    """Sentences for those in which nothing can have happened; of a robot with many, one."""
    by_robot: dict[int, list[Gap]] = {}
    for gap in gaps:
        by_robot.setdefault(gap.robot, []).append(gap)
    if len(by_robot) > NAMES_SHOWN:
        return [f"{_many(gaps).capitalize()}{_moved(gaps, 'they')}{_no_nearer(gaps)}."]
    out = []
    for robot, each in by_robot.items():
        if len(each) <= FEW_GAPS:
            out += [
                f"Robot {robot} sent no pose {gap.when}{_moved([gap])}{_no_nearer([gap])}." for gap in each
            ]
            continue
        longest_s, whole_s = max(gap.lasts_s for gap in each), sum(gap.lasts_s for gap in each)
        out.append(
            f"{len(each)} times from {each[0].start_s:.2f} s to {each[-1].end_s:.2f} s robot {robot} sent no "
            f"pose, for up to {longest_s:.1f} s and {whole_s:.1f} s together{_moved(each)}{_no_nearer(each)}."
        )
    return out


def _no_nearer(gaps: Sequence[Gap]) -> str:
    """How near these can have come to anything, to be put behind a sentence."""
    stake = _nearest(gaps)
    if stake is None:
        return ""
    if stake.least_m < 0.0:
        return f", and cannot have been more than {-stake.least_m:.2f} m beyond {stake.what}"
    return f", and cannot have come nearer than {stake.least_m:.2f} m to {stake.what}"


def _worst_stake(gaps: Sequence[Gap]) -> str:
    stake = _nearest([gap for gap in gaps if not gap.lasts])
    return f"; one of them {stake.words}" if stake is not None and stake.may_be_broken else ""


def _nearest(gaps: Sequence[Gap]) -> Stake | None:
    found = [gap.stake for gap in gaps if gap.stake is not None]
    return min(found, key=lambda stake: stake.least_m - stake.safe_m, default=None)


def _moved(gaps: Sequence[Gap], who: str = "it") -> str:
    """How far these moved, to be put behind a sentence; "" where one began, or ends, without a pose."""
    most_m = max(gap.moved_m for gap in gaps)
    if most_m == inf:
        return ""
    return f": {who} moved {'up to ' if len(gaps) > 1 else ''}{most_m:.2f} m meanwhile"


def _many(gaps: Sequence[Gap]) -> str:
    """Of which robots no pose came, and for how long: a sentence without its end."""
    most_s = max(gap.lasts_s for gap in gaps)
    return f"no pose came of {robots(dict.fromkeys(gap.robot for gap in gaps))} for up to {most_s:.1f} s"


def _described(recording: Recording, a: Analysis) -> list[Gap]:
    """All gaps, with what is known of each."""
    stood, late, stakes = stalls(recording), late_robots(recording), Stakes(recording, a)
    return [
        _describe(recording, gap, stood, gap.robot in late, stakes, a.safe_m) for gap in pose_gaps(recording)
    ]


def _describe(
    recording: Recording, gap: PoseGap, stood: Sequence[Stall], is_late: bool, stakes: Stakes, safe_m: float
) -> Gap:
    host = recording.fleet.robot(gap.robot).host or ""
    stall = next(
        (
            each
            for each in stood
            if each.host == host and gap.lasts_s < each.lasts_s + GAP_S
            and each.start_s < gap.end_s and gap.start_s < each.end_s
        ),
        None,
    )  # fmt: skip
    body = recording.robots[gap.robot].body
    moved_m = inf
    if gap.before >= 0 and gap.after < len(body):
        moved_m = hypot(*(float(body[axis][gap.after] - body[axis][gap.before]) for axis in "xy"))
    dead = gap.lasts and all(
        any(down.what == "kill" and down.end_s == inf for down in downs(recording, gap.robot, role))
        for role in ("agent", "plant")
    )
    found = Gap(
        gap.robot, gap.start_s, gap.end_s, gap.lasts, gap.rule, gap.is_lost, gap.is_hidden, moved_m, stall,
        is_late, bool(gap.rule) and dead,
    )  # fmt: skip
    if gap.lasts or not gap.is_hidden or (found.is_of_machine and moved_m <= safe_m):
        return found
    return replace(found, stake=stakes.nearest(gap), too_far_m=stakes.too_far_m(gap))
