"""An operator's place on the bus of a fleet."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Final

from agent.bus import Bus
from agent.credentials import CredentialsError
from agent.fleet import Fleet
from agent.identity import MAIN, IdentityError, of_operator
from agent.sealed_bus import bus_for
from deploy.arguments import InputError
from deploy.authority import keys_folder
from deploy.live_faults import receivers

OPERATOR: Final = "HANDFAST_OPERATOR"
KEYS: Final = "HANDFAST_KEYS"
"""Variables of the environment: who gives orders here, and the folder of that operator's key."""


def operator_bus(fleet: Fleet) -> Bus:
    """On the bus of `fleet`, connected to every agent and plant, or to one of its routers.

    Raises:
        agent.bus.BusError: the bus cannot be opened.
        InputError: the fleet is secured, and this operator has no certificate that is valid.
    """
    routers = fleet.network.routers
    connect = [
        fleet.agent_endpoint(robot) if role == "agent" else fleet.plant_endpoint(robot)
        for robot, role in (receivers(fleet) if not routers else ())
    ]
    if not fleet.is_secured:
        return bus_for(fleet, None, None, _log, listen=[], connect=connect)
    name = fleet.fleet.name
    folder = os.environ.get(KEYS, "")
    who = os.environ.get(OPERATOR, MAIN)
    try:
        identity = of_operator(name, who)
        if who not in fleet.network.operators:
            raise InputError(
                f"{OPERATOR}: robots of {name} take no orders of {who}; network.operators are "
                f"{', '.join(fleet.network.operators)}"
            )
        return bus_for(
            fleet,
            identity,
            Path(folder).expanduser() if folder else keys_folder(name),
            _log,
            listen=[],
            connect=connect,
        )
    except IdentityError as error:
        raise InputError(f"{OPERATOR}: {error}") from None
    except CredentialsError as error:
        raise InputError(f"{error}; `handfast keys` makes one") from None


def _log(text: str) -> None:
    print(f"handfast: {text}", file=sys.stderr)
