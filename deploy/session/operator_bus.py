"""An operator's place on the bus of a fleet."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from agent.common.wording import printable
from agent.fleet.model import Fleet
from agent.runtime.bus import Bus
from agent.runtime.sealed_bus import bus_for
from agent.security import private_files
from agent.security.certificates import CertificateError, authority_from_pem
from agent.security.credentials import CredentialsError, Files, MissingError
from agent.security.identity import MAIN, IdentityError, of_operator
from agent.security.sealed_order import Opener
from deploy.console.arguments import InputError
from deploy.faults.live import receivers
from deploy.inventory.certificate_authority import keys_folder

OPERATOR: Final = "HANDFAST_OPERATOR"
KEYS: Final = "HANDFAST_KEYS"
"""Variables of the environment: who gives orders here, and the folder of that operator's key."""


def operator_bus(fleet: Fleet) -> Bus:
    """On the bus of `fleet`, connected to every agent and plant, or to one of its routers.

    Raises:
        agent.runtime.bus.BusError: the bus cannot be opened.
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
    folder = _keys(name)
    who = os.environ.get(OPERATOR, MAIN)
    try:
        identity = of_operator(name, who)
    except IdentityError as error:
        raise InputError(f"{OPERATOR}: {error}") from None
    if who not in fleet.network.operators:
        raise InputError(
            f"{OPERATOR}: robots of {name} take no orders of {who}; network.operators are "
            f"{', '.join(fleet.network.operators)}"
        )
    try:
        return bus_for(fleet, identity, folder, _log, listen=[], connect=connect)
    except CredentialsError as error:
        advice = "; `handfast keys` makes one" if isinstance(error, MissingError) else ""
        raise InputError(f"{error}{advice}") from None


def order_opener(fleet: Fleet) -> Opener | None:
    """Opens what a secured fleet's operators have sealed; None where the authority's certificate is not here.

    Raises:
        InputError: it is here, and cannot be read.
    """
    name = fleet.fleet.name
    path = Files(_keys(name), of_operator(name, MAIN)).authority
    try:
        authority = authority_from_pem(private_files.read(path))
    except private_files.KeyFileError as error:
        if not private_files.exists(path):
            return None
        raise InputError(str(error)) from None
    except CertificateError as error:
        raise InputError(f"{path}: {error}") from None
    return Opener(name, fleet.network.operators, authority)


def _keys(fleet: str) -> Path:
    given = os.environ.get(KEYS, "")
    return Path(given).expanduser() if given else keys_folder(fleet)


def _log(text: str) -> None:
    with suppress(OSError, ValueError):  # an output that is gone keeps no order from being given
        print(f"handfast: {printable(text)}", file=sys.stderr)
