"""Made-up runs in which nothing comes of some processes for a while."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Event, HandState, PlantState, Status, Wrench
from handfast.deploy.recording.recording import Recording
from tests.unit.deploy.judged_run import PAIR, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, messages

FROM_S: Final = 0.8
UNTIL_S: Final = 1.4
BOTH: Final = 1, 2
OF_AGENTS: Final = (Status, HandState, Wrench)
ALL: Final = (PlantState, *OF_AGENTS)
ROUTED: Final = replace(PAIR, network=replace(PAIR.network, topology="routed"))
UNHEARD: Final = {"received": -60}
"""What an agent would have received in that time, and has not."""
STOOD: Final = {"stood_ms": 600, "overruns": 30}
"""What an agent counts more that stood for that time."""


def silent(
    kinds: tuple[type, ...],
    ids: tuple[int, ...] = BOTH,
    *,
    fleet: Fleet = PAIR,
    counted: dict[str, int] | None = None,
    state: str = "running",
    mode: str = "run",
    waits: bool = False,
) -> Recording:
    """A run that lacks messages of these kinds of these robots.

    Args:
        counted: by how much more, or less, their agents have counted afterwards.
        state: of these meanwhile.
        waits: what they would have received comes all at once at its end.
    """
    sent = []
    had: dict[int, int] = {}
    for received_ns, key, message in messages(fleet, in_formation(fleet)):
        t = (message.time_ns - EPOCH_NS) / 1e9
        concerned = getattr(message, "robot", 0) in ids
        if concerned and type(message) in kinds and FROM_S < t < UNTIL_S:
            continue
        if concerned and type(message) is Status and t >= UNTIL_S:
            counters = dict(message.counters)
            for name, more in (counted or {}).items():
                counters[name] = counters.get(name, 0) + more
            message = message._replace(counters=tuple(counters.items()))
        elif concerned and type(message) is Status and t > FROM_S:
            message = message._replace(state=state)
            if waits:
                counters = dict(message.counters) | {"received": had[message.robot]}
                message = message._replace(counters=tuple(counters.items()))
        elif concerned and type(message) is Status:
            had[message.robot] = dict(message.counters)["received"]
        sent.append((received_ns, key, message))
    return recorded(fleet, sent, mode)


def paused(robot: int, role: str) -> tuple[Event, ...]:
    """What a rule did that paused a process for that time."""
    return tuple(
        Event(robot, 0, EPOCH_NS + round(t * 1e9), role, what, "freeze")
        for t, what in ((FROM_S, "stop"), (UNTIL_S, "continue"))
    )
