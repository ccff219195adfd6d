"""Violations, which oracles give, and what the oracles share."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.fleet.fault_rules import Rule
from handfast.agent.formation.points import Floats
from handfast.deploy.faults.rules import Span, live_sets, spans
from handfast.deploy.recording.recording import Recording

REACTION_S: Final = 0.1
"""A process may need so long to act on what it must act on: ticks, and the way of a message."""


class Violation(NamedTuple):
    """An oracle's rule was broken at fleet time `t_s`; `message` is a full sentence.

    `avoidable` is False where nothing commanded the bodies that it is about, or nobody steered them.
    """

    oracle: str
    t_s: float
    message: str
    avoidable: bool = True


def reaction_s(recording: Recording) -> float:
    """`REACTION_S`, but no less than two periods, and more where rules make ticks come late."""
    rules = [
        *recording.fleet.faults.rules,
        *(rule for held in live_sets(recording) for rule in held.rules),
    ]
    late_s = max((rule.tick_jitter.most_s for rule in rules if rule.tick_jitter), default=0.0)
    return max(REACTION_S, 2.0 / recording.fleet.fleet.rate_hz) + late_s


def lasting(bad: NDArray[np.bool_], t: Floats, least_s: float) -> float | None:
    """First time from which on `bad` (k,) held for longer than `least_s` without a break, None without."""
    if not bad.any():
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int8)))
    starts, ends = t[edges[::2]], t[edges[1::2] - 1]
    long = np.flatnonzero(ends - starts > least_s)
    return float(starts[long[0]]) if len(long) else None


def windows(recording: Recording) -> list[Span]:
    """The times of rules within the drive (`deploy.faults.rules.spans`)."""
    return spans(recording, recording.end_s)


def is_constant(rule: Rule) -> bool:
    """Whether a rule of faults holds for the whole run."""
    return rule.at is None and rule.duration is None and rule.every is None
