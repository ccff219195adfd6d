"""An operator's place on the bus of a fleet."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.security.credentials import CredentialsError, MissingError, NotValidNowError, load
from handfast.agent.security.identity import IdentityError, of_operator
from handfast.agent.transport.bus import Bus
from handfast.agent.transport.sealed_bus import bus_for
from handfast.deploy.console.arguments import InputError
from handfast.deploy.faults.live import receivers
from handfast.deploy.inventory.operator_credentials import OPERATOR, keys_folder, operator_name


def operator_bus(fleet: Fleet, *, whenever: bool = False, is_wanted: Callable[[], bool] | None = None) -> Bus:
    """On the bus of `fleet`, connected to every agent and plant, or to one of its routers.

    Args:
        whenever: tries it with a certificate that is not valid now, too, and says so: this machine's clock
            may be wrong.
        is_wanted: asked again and again until a router answers, which is given up where it is not wanted any
            more. The process has to end as `handfast` does then (`agent.transport.bus.is_opening`).

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened, or is not wanted any more.
        InputError: the fleet is secured, and this operator has no certificate that is valid.
    """
    connect = [
        fleet.agent_endpoint(robot) if role == "agent" else fleet.plant_endpoint(robot)
        for robot, role in (() if fleet.routers else receivers(fleet))
    ]
    opens = partial(bus_for, fleet, listen=[], connect=connect, is_wanted=is_wanted, whenever=whenever)
    if not fleet.is_secured:
        return opens(None, None, _log)
    name, folder, who = fleet.fleet.name, keys_folder(fleet.fleet.name), operator_name()
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
        load(folder, identity, time.time())
    except NotValidNowError as error:
        if not whenever:
            raise InputError(f"{error}{_advice(error)}") from None
        _log(f"{error}{_advice(error)}")
    except CredentialsError as error:
        raise InputError(f"{error}{_advice(error)}") from None
    return opens(identity, folder, _log)


def _advice(error: CredentialsError) -> str:
    if isinstance(error, MissingError):
        return "; `handfast keys` makes one (on another computer than the authority's: --request)"
    if isinstance(error, NotValidNowError):
        return "; `handfast keys` renews it (on another computer than the authority's: --request)"
    return ""


def _log(text: str) -> None:
    with suppress(OSError, ValueError):  # an output that is gone keeps no order from being given
        print(f"handfast: {printable(text)}", file=sys.stderr)
