"""An operator's place on the bus of a fleet, and the seals of its orders where no bus seals them."""

from __future__ import annotations

import sys
import time
from base64 import b64decode
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from typing import Any

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Resume, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.security import private_files
from handfast.agent.security.certificates import CertificateError, authority_from_pem
from handfast.agent.security.credentials import (
    AUTHORITY_CERTIFICATE,
    CredentialsError,
    MissingError,
    NotValidNowError,
    load,
)
from handfast.agent.security.identity import IdentityError, of_operator
from handfast.agent.security.sealed_order import Forged, Opener, Sealer
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


def sealed(fleet: Fleet, order: bytes, ahead_ns: int = 0) -> bytes:
    """Return the encoded order, sealed by this operator where `fleet` is secured.

    Args:
        ahead_ns: how far the clock of the robot that opens it is ahead of this machine's.

    Raises:
        InputError: this operator has no certificate that is valid.
    """
    if not fleet.is_secured:
        return order
    name, now_ns = fleet.fleet.name, time.time_ns() + ahead_ns
    try:
        own = load(keys_folder(name), of_operator(name, operator_name()), now_ns / NS_PER_S)
    except (CredentialsError, IdentityError) as error:
        raise InputError(str(error)) from None
    return Sealer(own).seal(order, now_ns)


def order_opener(fleet: Fleet) -> Opener | None:
    """Return what opens the orders of a secured fleet's operators; None without the authority's certificate.

    Raises:
        InputError: the certificate is here, and cannot be read.
    """
    name = fleet.fleet.name
    path = keys_folder(name) / AUTHORITY_CERTIFICATE
    try:
        if not private_files.exists(path):
            return None
        return Opener(name, fleet.network.operators, authority_from_pem(private_files.read(path)))
    except private_files.KeyFileError as error:
        raise InputError(str(error)) from None
    except CertificateError as error:
        raise InputError(f"{path}: {error}") from None


def unsealed(fleet: Fleet, texts: Iterable[Any]) -> list[Stop | Resume]:
    """The stops and resumes among orders that robots of `fleet` have kept (base64), as their computers tell
    them: what no operator has sealed is left out. None where this operator cannot tell that.

    Raises:
        InputError: the certificate of the authority cannot be read.
    """
    opener = order_opener(fleet) if fleet.is_secured else None
    found: list[Stop | Resume] = []
    if fleet.is_secured and opener is None:
        return found
    for text in texts:
        with suppress(ValueError, TypeError, Forged, Malformed):
            data = b64decode(text, validate=True)
            order = decode(data if opener is None else opener.open_recorded(data).payload)
            if isinstance(order, Stop | Resume):
                found.append(order)
    return found
