"""An operator's orders as robots take them from a file, where no bus seals them."""

from __future__ import annotations

import os
import time
from pathlib import Path

from agent.fleet.model import Fleet
from agent.security.credentials import CredentialsError, load
from agent.security.identity import MAIN, IdentityError, of_operator
from agent.security.sealed_order import Sealer
from deploy.console.arguments import InputError
from deploy.inventory.certificate_authority import keys_folder
from deploy.session.operator_bus import KEYS, OPERATOR


def sealed(fleet: Fleet, order: bytes) -> tuple[bytes, ...]:
    """The encoded order, sealed by this operator where `fleet` is secured.

    Raises:
        InputError: this operator has no certificate that is valid.
    """
    if not fleet.is_secured:
        return (order,)
    name, now_ns = fleet.fleet.name, time.time_ns()
    given = os.environ.get(KEYS, "")
    try:
        identity = of_operator(name, os.environ.get(OPERATOR, MAIN))
        found = load(Path(given) if given else keys_folder(name), identity, now_ns / 1e9)
    except (CredentialsError, IdentityError) as error:
        raise InputError(str(error)) from None
    return (Sealer(found).seal(order, now_ns),)
