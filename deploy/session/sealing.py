"""An operator's orders as robots take them from a file, where no bus seals them."""

from __future__ import annotations

import time
from base64 import b64decode
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Resume, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.security import private_files
from handfast.agent.security.certificates import CertificateError, authority_from_pem
from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE, CredentialsError, load
from handfast.agent.security.identity import IdentityError, of_operator
from handfast.agent.security.sealed_order import Forged, Opener, Sealer
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.operator_credentials import keys_folder, operator_name


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
