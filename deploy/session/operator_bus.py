"""An operator's place on the bus of a fleet."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.security.credentials import CredentialsError, MissingError, NotValidNowError
from handfast.agent.security.identity import IdentityError, of_operator
from handfast.agent.security.refusals import ANOTHER_AUTHORITY
from handfast.agent.transport.bus import Bus, BusError
from handfast.agent.transport.sealed_bus import bus_for
from handfast.deploy.console.arguments import InputError
from handfast.deploy.faults.live import receivers
from handfast.deploy.inventory.operator_credentials import (
    OPERATOR,
    earlier_folders,
    keys_folder,
    operator_name,
)
from handfast.deploy.inventory.operator_renewal import usable
from handfast.deploy.session.joined_bus import JoinedBus, OperatorBus

JOINED_RETRY_MS: Final = (500, 1000)
"""Pauses between attempts where some robots must refuse them, having another authority: each refusal costs
the robot a tenth of a second in which it accepts nobody else."""
BOTH: Final = "some robots may have an earlier authority still: linking with both; `handfast up` ends that"


def operator_bus(
    fleet: Fleet, *, whenever: bool = False, is_wanted: Callable[[], bool] | None = None
) -> OperatorBus:
    """On the bus of `fleet`, connected to every agent and plant, or to one of its routers; while an authority
    is being replaced, with the credentials of before as well.

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
    earlier = earlier_folders(folder)
    try:
        usable(fleet, folder, identity)
    except NotValidNowError as error:
        if whenever:
            _log(f"{error}{_advice(error)}")
    except CredentialsError:
        pass  # said below
    try:
        if earlier:
            patient = partial(opens, identity, log=_log_joined, retry_ms=JOINED_RETRY_MS)
            return _joined(patient, folder, earlier)
        return opens(identity, folder, _log)
    except CredentialsError as error:
        raise InputError(f"{error}{_advice(error)}") from None


def _joined(opens: Callable[[Path], Bus], folder: Path, earlier: list[Path]) -> OperatorBus:
    """A bus with the credentials of each folder that can be used; raises as the first where there are none.

    Args:
        opens: a bus with the credentials of a folder.
    """
    found: list[Bus | None] = []
    first: CredentialsError | BusError | None = None
    try:
        for each in (folder, *earlier):
            try:
                found.append(opens(each))
            except (CredentialsError, BusError) as error:
                first = first or error
                found.append(None)
                if each == folder and isinstance(error, CredentialsError):
                    _log(f"{error}{_advice(error)}")
    except BaseException:
        JoinedBus(None, [bus for bus in found if bus is not None]).close()
        raise
    now, *before = found
    usable = [bus for bus in before if bus is not None]
    if now is None and not usable:
        assert first is not None
        raise first
    if now is not None and not usable:
        return now
    _log(BOTH)
    return JoinedBus(now, usable)


def _advice(error: CredentialsError) -> str:
    if isinstance(error, MissingError):
        return "; `handfast keys` makes one (on another computer than the authority's: --request)"
    if isinstance(error, NotValidNowError):
        return "; `handfast keys` renews it (on another computer than the authority's: --request)"
    return ""


def _log_joined(text: str) -> None:
    """As `_log`, without what is so by the nature of things: that each robot refuses one of the two."""
    if not any(why in text for why in ANOTHER_AUTHORITY):
        _log(text)


def _log(text: str) -> None:
    with suppress(OSError, ValueError):  # an output that is gone keeps no order from being given
        print(f"handfast: {printable(text)}", file=sys.stderr)
