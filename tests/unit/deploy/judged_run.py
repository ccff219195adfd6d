"""Made-up runs and what they are judged to be."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Status
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    Sent,
    in_formation,
    make_fleet,
    messages,
)
from tests.unit.deploy.synthetic_run import Path as Way

PAIR = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)])
NAME = PAIR.fleet.name


def recorded(fleet: Fleet, sent: Iterable[Sent], mode: str = "run", **known: Any) -> Recording:
    data = RunData(fleet, mode=mode, seed=3)
    for each in sent:
        data.feed(*each)
    return data.recording(**known)


def judged(
    fleet: Fleet, sent: Iterable[Sent], *, mode: str = "run", reasons: Sequence[str] = ()
) -> dict[str, Any]:
    return RunResult(recorded(fleet, sent, mode, reasons=reasons)).metrics


def driven(fleet: Fleet, *hands: Way, **options: Any) -> dict[str, Any]:
    """Metrics of a run whose hand points are on these paths (headings are zero)."""
    bodies = [body(hand, robot.hand_offset_m) for hand, robot in zip(hands, fleet.robots, strict=True)]
    return judged(fleet, messages(fleet, bodies), **options)


def body(hand: Way, offset: float) -> Way:
    return lambda t: (hand(t)[0] - offset, hand(t)[1], 0.0)


def with_statuses(*statuses: Status) -> list[Sent]:
    """A run of PAIR in formation, with these statuses instead of its own."""
    sent = [each for each in messages(PAIR, in_formation(PAIR)) if type(each[2]) is not Status]
    return sent + [
        (status.time_ns, key_expressions.status(NAME, status.robot), status) for status in statuses
    ]


def status(robot: int, t: float, **fields: Any) -> Status:
    base = Status(robot, 0, EPOCH_NS + round(t * 1e9), "running", "epoch", "", 1, 0, (), (), (), ())
    return base._replace(**fields)
