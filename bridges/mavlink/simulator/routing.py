"""Routes messages between the ports of an autopilot, as ArduPilot does (PURE).

A heartbeat goes to every other port that its sender was not heard on. What is addressed to somebody goes to
the ports on which that somebody was heard, what is addressed to nobody to all on which anybody was. So two
bridges, or a bridge and a ground station, see each other through the vehicle.
"""

from __future__ import annotations

from typing import Final

from handfast.bridges.mavlink.ardupilot import constants

ROUTES_MAX: Final = 20
PRIVATE: Final = frozenset({109, 166, 246})
"""RADIO_STATUS, RADIO, ADSB_VEHICLE: never passed on."""


class Routes:
    """Who was heard where, of the vehicle with this system id."""

    def __init__(self, system: int) -> None:
        self._own = (system, constants.COMPONENT_AUTOPILOT)
        self._heard: list[tuple[int, int, int]] = []  # port, system, component

    def learn(self, port: int, system: int, component: int) -> None:
        """A message of that sender came in at a port."""
        route = (port, system, component)
        if system and (system, component) != self._own and route not in self._heard:
            self._heard.append(route)
            del self._heard[:-ROUTES_MAX]

    def of_heartbeat(self, ports: int, port: int, system: int, component: int) -> list[int]:
        """Ports, of 0 to `ports` - 1, to which a heartbeat that came in at `port` goes."""
        known = {p for p, s, c in self._heard if (s, c) == (system, component)}
        return [p for p in range(ports) if p != port and p not in known]

    def of_message(self, message: int, port: int, system: int, component: int) -> tuple[list[int], bool]:
        """Ports to which a message that came in at `port` goes, and whether it is for the vehicle itself.

        Args:
            message: its id.
            system, component: to whom it is addressed; 0 is everybody, as for a message without address.
        """
        if message in PRIVATE:
            return [], True
        own_system = system in (0, self._own[0])
        ours = own_system and component in (0, self._own[1])
        if ours and system and component:
            return [], True
        ports = []
        for p, s, c in self._heard:
            fits = system == 0 or (s == system and (component in (0, c) or not own_system))
            if fits and p != port and p not in ports:
                ports.append(p)
        return ports, ours or (own_system and not ports)
