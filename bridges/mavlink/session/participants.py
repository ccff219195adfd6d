"""The other participants of a vehicle's link: ground stations, other bridges, other vehicles (PURE)."""

from __future__ import annotations

from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants

HEARD_NS: Final = 5 * NS_PER_S
"""Who has sent no heartbeat for this long is gone."""
KEPT: Final = 32
BRIDGE_COMPONENTS: Final = range(191, 195)
"""MAV_COMP_ID_ONBOARD_COMPUTER and its three successors."""


class Participant(NamedTuple):
    """A sender of heartbeats that is not the vehicle: its identity, MAV_TYPE and when it was last heard."""

    system: int
    component: int
    type: int
    heard_ns: int


class Participants:
    """Those that were heard, `KEPT` at most; of more the first."""

    def __init__(self) -> None:
        self._heard: dict[tuple[int, int, bool], Participant] = {}

    def clear(self) -> None:
        """Nobody is here."""
        self._heard.clear()

    def heard(self, sender: Participant, *, vehicle: bool) -> None:
        """Takes a heartbeat; `vehicle`: of an autopilot."""
        key = sender.system, sender.component, vehicle
        if key not in self._heard and len(self._heard) >= KEPT:
            self._heard = {k: p for k, p in self._heard.items() if sender.heard_ns - p.heard_ns <= HEARD_NS}
            if len(self._heard) >= KEPT:
                return
        self._heard[key] = sender

    def _now(self, now_ns: int, *, vehicle: bool) -> list[Participant]:
        return [
            participant
            for (_, _, is_vehicle), participant in self._heard.items()
            if is_vehicle is vehicle and now_ns - participant.heard_ns <= HEARD_NS
        ]

    def ground_stations(self, now_ns: int) -> list[Participant]:
        """Those of MAV_TYPE_GCS."""
        return [p for p in self._now(now_ns, vehicle=False) if p.type == constants.TYPE_GCS]

    def vehicles(self, now_ns: int) -> list[Participant]:
        """Autopilots that are not the one of this link."""
        return self._now(now_ns, vehicle=True)

    def strangers(self) -> dict[int, int]:
        """MAV_TYPE by system id of such autopilots, also of those that have gone silent."""
        return {p.system: p.type for (_, _, vehicle), p in self._heard.items() if vehicle}

    def another_bridge(self, now_ns: int, own: tuple[int, int], vehicle: int) -> str:
        """Who else may steer the vehicle, "" nobody. A ground station is the operator's: it may be there."""
        for other in self._now(now_ns, vehicle=False):
            name = f"system {other.system}, component {other.component}"
            if (other.system, other.component) == own:
                return f"another program speaks as {name}, which is this bridge's own identity"
            if (
                other.type == constants.TYPE_ONBOARD_CONTROLLER
                and other.system == vehicle
                and other.component in BRIDGE_COMPONENTS
            ):
                return f"another onboard controller is on this vehicle ({name})"
        return ""
