"""What a run's verdict says in words: why it failed, and what else is to be known (pure functions)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from handfast.agent.supervision.state_machine import DRIVING, PLANT_SILENT, State
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.patience import SHARE_MAX
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.console.wording import NAMES_SHOWN, grouped, robots
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict import link_metrics, overload, releases
from handfast.deploy.verdict.completeness import Completeness, last_states
from handfast.deploy.verdict.gaps import damage
from handfast.deploy.verdict.oracles_drive import RECOVERED_S
from handfast.deploy.verdict.overload import SKIPPED_SHARE
from handfast.deploy.verdict.tracking import Tracking
from handfast.deploy.verdict.violations import Violation

_GOOD_STATES: Final = frozenset(
    state.value for state in (*DRIVING, State.STOPPING, State.STOPPED, State.RELEASED, State.STANDBY)
)
"""Of a robot at the end of its drive. Its operator may take it whenever he likes: that is a warning."""
EXPLAINED_SHARE: Final = 0.5
"""Of the time of the ticks that were skipped: where ticks that took long fill this much, they are why."""
FEW: Final = 3
"""Where more fails, what all of it may come of is said first."""
_IN_FAULT: Final = f" ended the drive in state {State.FAULT.value}: "


def reasons(
    recording: Recording,
    a: Analysis,
    violations: Mapping[str, Sequence[Violation] | None],
    tracking: Tracking,
) -> list[str]:
    """Sentences that fail the verdict; first those that the operator's side gave. None: it passed.

    Args:
        violations: what each oracle found.
        tracking: who was not at its place at the end.
    """
    data = Completeness(recording, a)
    states = [*_states(recording, data.members), *releases.losses(recording, data.members)]
    # Where no mission was given, nobody was to go anywhere; what is not all there does not tell of the end.
    unsettled = []
    ends = damage.cut_short(recording) is None
    if recording.epoch_ns is not None and ends:
        unsettled = [*_unsettled(recording, a, tracking), *tracking.reasons]
    own = sorted([*data.reasons, *states], key=lambda reason: not of_fault(reason))
    found = [*recording.reasons, *own]
    for name, each in violations.items():
        if name in ("recovery", "formed") and (states or unsettled or not ends):
            continue  # the same, in words about the end; or where that is not known
        found += [violation.message for violation in each or ()]
    found += unsettled
    return [*overload.explains(recording), *found] if len(found) > FEW else found


def of_fault(reason: str) -> bool:
    """Whether one of `reasons` is that robots were in fault, which others may come of."""
    return _IN_FAULT in reason


def warnings(
    recording: Recording, a: Analysis, about_links: Mapping[str, Any], tracking: Tracking
) -> list[str]:
    """Sentences that fail nothing.

    Args:
        about_links: as `deploy.verdict.link_metrics.describe_links` gives it.
    """
    data = Completeness(recording, a)
    found = [f"{warning}." for warning in recording.warnings] + releases.warnings(recording, data.members)
    found += [*data.warnings, *_states(recording, frozenset(recording.ids) - data.members)]
    found += _late_laws(recording) + overload.warnings(recording)
    found += tracking.warnings if damage.cut_short(recording) is None else tracking.behind
    found += link_metrics.clock_warnings(recording, about_links["clock_offsets"])
    if any(len(robot.hand) for robot in recording.robots.values()):  # else links were not looked at
        found += link_metrics.idle_rules(recording, a)
    return found


def _late_laws(recording: Recording) -> list[str]:
    """A sentence if a law of others may be why robots skipped ticks."""
    law, period_us = recording.fleet.control.law, 1e6 / recording.fleet.fleet.rate_hz
    if law is None:
        return []
    late, skipped, longest_us = [], 0, 0.0
    for robot, data in recording.robots.items():
        ticks_us, count = data.status.tick_us, data.status.totals().get("overruns", 0)
        # They may be few: each that takes long keeps many from being.
        long_us = ticks_us[ticks_us > SHARE_MAX * period_us]
        explains = float(long_us.sum()) > EXPLAINED_SHARE * count * period_us
        if count > SKIPPED_SHARE * len(ticks_us) and len(long_us) and explains:
            late.append(robot)
            skipped += count
            longest_us = max(longest_us, float(np.median(long_us)))
    if not late:
        return []
    return [
        f"{robots(late).capitalize()} skipped {skipped} ticks: there one takes {longest_us / 1e3:.3g} ms, of "
        f"{period_us / 1e3:.3g} ms; the law {law} may be too slow."
    ]


def _states(recording: Recording, among: frozenset[int]) -> list[str]:
    """Sentences for those of some robots that did not drive at the end, one for all with the same reason."""
    by_state: dict[str, list[tuple[str, int]]] = {}
    for robot, last in last_states(recording).items():
        if robot in among and last is not None and last[0] not in _GOOD_STATES:
            by_state.setdefault(last[0], []).append((last[1], robot))
    out = []
    for state, said in by_state.items():
        same = grouped(said)
        if len(same) <= NAMES_SHOWN:
            out += [_ended(ids, state, reason) + _own_plant(recording, ids, reason) for reason, ids in same]
        else:  # of a large fleet, all that a page of reasons says is that it did not drive
            reason, ids = same[0]
            first = f"{robots(ids)}: {reason}" if reason else robots(ids)
            others = f"{first}; the others for {len(same) - 1} other reasons"
            out.append(_ended(sorted(robot for _, robot in said), state, others))
    return out


def _own_plant(recording: Recording, ids: Sequence[int], reason: str) -> str:
    """That a plant of others may hang whose body says nothing, with " " before it; "" for any other."""
    if not reason.startswith(PLANT_SILENT):
        return ""
    own = sorted({each.plant for each in map(recording.fleet.robot, ids) if each.kind.is_plugin})
    return f" Its plant, {', '.join(own)}, may hang." if own else ""


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
        told = [(a.ids[index], tracking.causes.of(index)) for index in a.edges[worst].tolist()]
        why = "".join(f" Robot {robot}: {'; '.join(each)}." for robot, each in told if each)
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
