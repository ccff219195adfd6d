"""What a run's verdict says in words: why it failed, and what else is to be known (PURE)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from handfast.agent.supervision.state_machine import DRIVING, PLANT_SILENT, State
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.console.wording import NAMES_SHOWN, grouped, robots
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict import lateness, link_metrics
from handfast.deploy.verdict.missing import Missing, cut_short, last_states
from handfast.deploy.verdict.oracles_drive import RECOVERED_S
from handfast.deploy.verdict.tracking import Tracking
from handfast.deploy.verdict.violations import Violation

_GOOD_STATES: Final = frozenset(
    state.value for state in (*DRIVING, State.STOPPING, State.STOPPED, State.RELEASED, State.STANDBY)
)
"""States of a robot at the end of a good drive. Its operator may take it at any time: that is a warning."""
NOT_ITS_OPERATORS: Final = (
    "does not follow its commands",
    "stands before its own fence",
    "its own failsafe has it",
)
"""Beginnings of the reasons with which a bridge lets go of a vehicle that no operator has taken."""
PERHAPS_ITS_OPERATORS: Final = (
    "its bridge has started in mid-drive",
    "nothing was heard of it",
    "it has rebooted",
)
"""The same of a vehicle that its operator may have had: a loss unless he is seen to have taken it."""
FEW: Final = 3
"""Number of failures above which a machine that was too slow is said first."""
_IN_FAULT: Final = f" ended the drive in state {State.FAULT.value}: "


def reasons(
    recording: Recording,
    a: Analysis,
    violations: Mapping[str, Sequence[Violation] | None],
    tracking: Tracking,
) -> list[str]:
    """Return sentences that fail the verdict, those of the operator's side first. None: it passed."""
    data = Missing(recording, a)
    lost = [each.words for each in releases(recording) if each.is_loss and each.robot in data.members]
    states = [*_states(recording, data.members), *lost]
    # Where no mission was given, nobody was to go anywhere; what is cut off does not tell of the end.
    ends, unsettled = cut_short(recording) is None, []
    if recording.epoch_ns is not None and ends:
        unsettled = [*_unsettled(recording, a, tracking), *tracking.reasons]
    found = [*recording.reasons, *sorted([*data.reasons, *states], key=lambda text: not of_fault(text))]
    for name, each in violations.items():
        if name not in ("recovery", "formed") or not (states or unsettled or not ends):  # else said already
            found += [violation.message for violation in each or ()]
    found += unsettled
    if len(found) > FEW and 2 * len(lateness.late_robots(recording)) > len(recording.ids):
        found.insert(0, f"{lateness.warnings(recording)[0]} What follows may come of that alone.")
    return found


def of_fault(reason: str) -> bool:
    """Return True if one of `reasons` is that robots were in fault, which others may come of."""
    return _IN_FAULT in reason


def warnings(
    recording: Recording, a: Analysis, about_links: Mapping[str, Any], tracking: Tracking
) -> list[str]:
    """Return sentences that fail nothing.

    Args:
        about_links: as `deploy.verdict.link_metrics.describe_links` gives it.
    """
    data = Missing(recording, a)
    found = [f"{warning}." for warning in recording.warnings]
    found += [
        each.words for each in releases(recording) if not each.is_loss or each.robot not in data.members
    ]
    found += [*data.warnings, *_states(recording, frozenset(recording.ids) - data.members)]
    found += lateness.warnings(recording)
    found += tracking.warnings if cut_short(recording) is None else tracking.behind
    found += link_metrics.clock_warnings(recording, about_links["clock_offsets"])
    if any(len(robot.hand) for robot in recording.robots.values()):  # else links were not looked at
        found += link_metrics.idle_rules(recording, a)
    return found


class Release(NamedTuple):
    """A time in the drive in which a robot was released, to `end_s`, or None if to the end of the drive."""

    robot: int
    start_s: float
    end_s: float | None
    reason: str
    by_operator: bool

    @property
    def is_loss(self) -> bool:
        """Whether the robot was lost to the drive, and nobody had wanted that."""
        return self.end_s is None and not self.by_operator

    @property
    def words(self) -> str:
        """One sentence."""
        until = "the end" if self.end_s is None else f"{self.end_s:.1f} s"
        if self.is_loss:
            who = f"Robot {self.robot} followed no more from {self.start_s:.1f} s to {until}"
            return f"{who}, and its operator had not taken it: {self.reason}."
        why = f" ({self.reason})" if self.reason else ""
        whose = " to its operator" if self.by_operator else ""
        return f"Robot {self.robot} was released{whose} from {self.start_s:.1f} s to {until}{why}."


def releases(recording: Recording) -> Iterator[Release]:
    """Yield all times in which robots were released. Only the bridge's reason tells who did it."""
    for robot, data in recording.robots.items():
        status = data.status
        for start_s, end_s, first in status.periods(State.RELEASED.value):
            if start_s >= recording.end_s:
                continue
            told = [
                reason
                for t, reason in zip(status.t.tolist(), status.reasons, strict=True)
                if start_s <= t and (end_s is None or t < end_s)
            ]
            # Its operator may have come for it later.
            own = next((reason for reason in told if reason.startswith(NOT_ITS_OPERATORS)), None)
            if own is None and told[-1].startswith(PERHAPS_ITS_OPERATORS):
                own = told[-1]
            until_s = None if end_s is None or end_s >= recording.end_s else end_s
            yield Release(robot, start_s, until_s, own or first, own is None)


def _states(recording: Recording, among: frozenset[int]) -> list[str]:
    """Sentences for those of some robots that did not drive at the end, one for all with the same reason."""
    by_state: dict[str, list[tuple[str, int]]] = {}
    for robot, last in last_states(recording).items():
        if robot in among and last is not None and last[0] not in _GOOD_STATES:
            by_state.setdefault(last[0], []).append((last[1], robot))
    out = []
    for state, told in by_state.items():
        same = grouped(told)
        if len(same) > NAMES_SHOWN:
            reason, ids = same[0]
            first = f"{robots(ids)}: {reason}" if reason else robots(ids)
            others = f"{first}; the others for {len(same) - 1} other reasons"
            same = [(others, sorted(robot for _, robot in told))]
        for reason, ids in same:
            own = {each.plant for each in map(recording.fleet.robot, ids) if each.kind.is_plugin}
            hint = f" Its plant, {', '.join(sorted(own))}, may hang." if own else ""
            out.append(_ended(ids, state, reason) + hint * reason.startswith(PLANT_SILENT))
    return out


def _ended(ids: Sequence[int], state: str, reason: str) -> str:
    they, its = ("it", "its") if len(ids) == 1 else ("they", "their")
    why = f" ({reason})" if reason else ""
    meaning = {
        State.FAULT.value: f"{they} did not drive on, as something of {its} own was wrong",
        State.HOLDING.value: f"{they} braked, and waited until {they} might drive again",
    }.get(state, f"{they} did not drive")
    return f"{robots(ids).capitalize()} ended the drive in state {state}: {meaning}{why}."


def _unsettled(recording: Recording, a: Analysis, tracking: Tracking) -> list[str]:
    off = np.flatnonzero(a.off[-1])
    if not len(off):
        return []
    distances, wanted = a.distances[-1], a.wanted[-1]
    error = np.abs(distances - wanted)
    worst = int(off[np.argmax((error / wanted)[off])])
    i, j = (a.ids[index] for index in a.edges[worst])
    why = ""
    if not tracking.off:  # else that is said of them
        told = [(a.ids[index], tracking.causes(index)) for index in a.edges[worst].tolist()]
        why = "".join(f" Robot {robot}: {each}." for robot, each in told if each)
    last_s = tracking.last_trouble_s
    if last_s is not None and last_s + RECOVERED_S > recording.end_s:
        why += f" The last fault or change was at {last_s:.1f} s."
    others = {1: "", 2: " One other edge was off as well."}.get(
        len(off), f" {len(off) - 1} other edges were off as well."
    )
    return [
        f"The formation had not settled at the end ({a.grid[-1]:.1f} s): robots {i} and {j} were "
        f"{distances[worst]:.3f} m apart instead of {wanted[worst]:.3f} m, "
        f"{100 * error[worst] / wanted[worst]:.0f} % off where {100 * SETTLED:.0f} % is allowed.{others}{why}"
    ]
