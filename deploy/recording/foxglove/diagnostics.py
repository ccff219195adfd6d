"""What Foxglove's Diagnostics panels show: the state of every robot, and why (PURE)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from handfast.agent.messages.types import PlantState, Status
from handfast.agent.supervision.state_machine import State
from handfast.deploy.recording.foxglove.json_text import STAMP, dumps

OK, WARN, ERROR, STALE = range(4)
"""Levels of a DiagnosticStatus."""
LEVELS: Final[Mapping[str, int]] = {
    State.RUNNING.value: OK,
    State.DEGRADED.value: WARN,
    State.HOLDING.value: WARN,
    State.RELEASED.value: WARN,
    State.FAULT.value: ERROR,
    State.STOPPING.value: OK,
    State.STOPPED.value: OK,
    State.WAITING.value: OK,
    State.READY.value: OK,
    State.STANDBY.value: OK,
}
"""Of each state, as the page and the film have it (`deploy.playback.looks`): what troubles a robot that is to
drive is a warning, a fault an error, rest and waiting are fine."""


def level_of(state: str) -> int:
    """The level of a state; of one that is not known here, `WARN`."""
    return LEVELS.get(state, WARN)


def in_short(status: Status) -> str:
    """A robot's state, and why it is in it."""
    return f"{status.state}: {status.reason}" if status.reason else status.state


def diagnostics(
    statuses: Mapping[int, Status], plants: Mapping[int, PlantState], silent: Collection[int]
) -> str:
    """The content of the topic, with `STAMP` for its time.

    Args:
        statuses, plants: the last of every robot that has said one.
        silent: robots whose agents are not heard.
    """
    rows = []
    for robot, status in sorted(statuses.items()):
        plant = plants.get(robot)
        body = "not heard" if plant is None else plant.note or ("drives" if plant.driving else "brakes")
        values = {
            "body": body,
            "mission": str(status.mission_version),
            "missed ticks": str(dict(status.counters).get("overruns", 0)),
        }
        rows.append(
            {
                "level": STALE if robot in silent else level_of(status.state),
                "name": "agent",
                "message": f"not heard, was {in_short(status)}" if robot in silent else in_short(status),
                "hardware_id": f"robot {robot}",
                "values": [{"key": key, "value": value} for key, value in values.items()],
            }
        )
    return '{"header":{"stamp":' + STAMP + ',"frame_id":""},"status":' + dumps(rows) + "}"
