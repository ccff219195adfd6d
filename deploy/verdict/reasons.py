"""What a run's verdict says in words: why it failed, and what else is to be known (pure functions)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Final

import numpy as np

from agent.supervision.state_machine import DRIVING, State
from deploy.analysis.analysis import Analysis
from deploy.analysis.patience import SHARE_MAX
from deploy.analysis.presence import downs
from deploy.analysis.stability import SETTLED
from deploy.console.wording import robots
from deploy.recording.recording import Recording
from deploy.verdict import link_metrics
from deploy.verdict.oracles_drive import RECOVERED_S, last_trouble_s
from deploy.verdict.tracking import Tracking
from deploy.verdict.violations import Violation

SILENCE_S: Final = 2.0
"""An agent says its status five times a second; one that said nothing in the last so many is lost."""
GAP_S: Final = 0.5
"""Poses missing for longer than this make a run's data incomplete."""
SKIPPED_SHARE: Final = 0.05
"""So large a share of the ticks is skipped where the law of others is named."""
_GOOD_STATES: Final = frozenset(
    state.value for state in (*DRIVING, State.STOPPING, State.STOPPED, State.RELEASED, State.STANDBY)
)
"""Of a robot at the end of its drive. Its operator may take it whenever he likes: that is a warning."""
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
    states, unsettled = _states(recording), [*_unsettled(recording, a, tracking), *tracking.reasons]
    own = sorted([*_incomplete(recording), *states], key=lambda reason: not of_fault(reason))
    found = [*recording.reasons, *own]
    for name, each in violations.items():
        if name == "recovery" and (states or unsettled):
            continue  # the same, in words about the end
        found += [violation.message for violation in each or ()]
    return found + unsettled


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
    found = [f"{warning}." for warning in recording.warnings] + _releases(recording)
    for gap in _gaps(recording):
        if gap.rule:
            found.append(
                f"Rule '{gap.rule}' stopped robot {gap.robot}'s plant: from {gap.start_s:.2f} s to "
                f"{gap.end_s:.2f} s its place is not known, and taken from what came before and after."
            )
    found += _late_laws(recording) + tracking.warnings
    found += link_metrics.clock_warnings(recording, about_links["clock_offsets"])
    if any(len(robot.hand) for robot in recording.robots.values()):  # else links were not looked at
        found += link_metrics.idle_rules(recording, a)
    return found + link_metrics.audit_warnings(about_links["links_audit"])


def _late_laws(recording: Recording) -> list[str]:
    """A sentence if a law of others may be why robots skipped ticks."""
    law, period_us = recording.fleet.control.law, 1e6 / recording.fleet.fleet.rate_hz
    if law is None:
        return []
    late, skipped, durations_us = [], 0, [0.0]
    for robot, data in recording.robots.items():
        ticks_us, count = data.status.tick_us, data.status.totals().get("overruns", 0)
        if len(ticks_us) and count > SKIPPED_SHARE * len(ticks_us):
            late.append(robot)
            skipped += count
            durations_us.append(float(np.median(ticks_us)))
    if max(durations_us) < SHARE_MAX * period_us:
        return []
    return [
        f"{robots(late).capitalize()} skipped {skipped} ticks: one takes up to {max(durations_us) / 1e3:.1f} "
        f"ms, of {period_us / 1e3:.3g} ms; the law {law} may be too slow."
    ]


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
    out += _fell_silent(recording)
    if end_s < planned_s - GAP_S and not _stopped_by_order(recording):
        why = ""
        if recording.stopped_s is not None and recording.stopped_s <= end_s + GAP_S:
            why = ": it was stopped"
        elif all(last and last[0] == State.FAULT.value for last in _last(recording).values()):
            why = ": no robot could drive any more"
        elif recording.interrupted:
            why = ": it was interrupted"
        out.append(f"The run ended after {end_s:.1f} s of the {planned_s:.1f} s that were planned{why}.")
    return out


def _fell_silent(recording: Recording) -> list[str]:
    """Sentences for agents that said nothing more to the end, though nobody had stopped them."""
    out = []
    law = recording.fleet.control.law
    hint = "" if law is None else f" Its law, {law}, may hang."
    for robot, data in recording.robots.items():
        last_s = float(data.status.t[-1]) if len(data.status) else inf
        silence_s = recording.end_s - last_s
        ordered = any(
            down.start_s <= last_s + SILENCE_S and down.end_s > last_s + SILENCE_S
            for down in downs(recording, robot, "agent")
        )
        if silence_s > SILENCE_S and not ordered:
            out.append(
                f"The agent of robot {robot} said nothing more from {last_s:.1f} s on, in the last "
                f"{silence_s:.1f} s of the drive.{hint}"
            )
    return out


def _stopped_by_order(recording: Recording) -> bool:
    """Whether it ended with a stop of its fleet file."""
    stopped_s = recording.stopped_s
    return stopped_s is not None and any(
        order.kind == "stop" and abs(order.at - stopped_s) < GAP_S for order in recording.fleet.orders
    )


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


def _last(recording: Recording) -> dict[int, tuple[str, str] | None]:
    """State and reason of each robot when it was to drive no more, though poses may have ended before."""
    stopped_s = recording.stopped_s
    until_s = recording.planned_s if stopped_s is None else stopped_s
    return {robot: data.status.at(until_s) for robot, data in recording.robots.items()}


def _states(recording: Recording) -> list[str]:
    """Sentences for robots that did not drive at the end of the drive, one for all with the same reason."""
    same: dict[tuple[str, str], list[int]] = {}
    for robot, last in _last(recording).items():
        if last is not None and last[0] not in _GOOD_STATES:
            same.setdefault(last, []).append(robot)
    out = []
    for (state, reason), ids in same.items():
        they, its = ("it", "its") if len(ids) == 1 else ("they", "their")
        why = f" ({reason})" if reason else ""
        meaning = {
            State.FAULT.value: f"{they} braked because something of {its} own was wrong",
            State.HOLDING.value: f"{they} braked, and waited until {they} might drive again",
        }.get(state, f"{they} did not drive")
        out.append(f"{robots(ids).capitalize()} ended the drive in state {state}: {meaning}{why}.")
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
    last_s = last_trouble_s(recording, a)
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
