"""How a state looks: what of it a picture shows at a glance, for the page and the film alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from handfast.agent.supervision.state_machine import State

DRIVES: Final = "drives"
TROUBLED: Final = "troubled"
FAILED: Final = "failed"
RESTS: Final = "rests"
UNREADY: Final = "unready"
SILENT: Final = "silent"
"""Instead of its state, where a robot is not heard any more."""

LOOKS: Final[Mapping[str, str]] = {
    State.RUNNING.value: DRIVES,
    State.DEGRADED.value: TROUBLED,
    State.HOLDING.value: TROUBLED,
    State.RELEASED.value: TROUBLED,
    State.FAULT.value: FAILED,
    State.STOPPING.value: RESTS,
    State.STOPPED.value: RESTS,
    State.WAITING.value: UNREADY,
    State.READY.value: UNREADY,
    State.STANDBY.value: UNREADY,
    SILENT: TROUBLED,
    "": UNREADY,
}
"""By the state's name, "" where a robot has said none."""
