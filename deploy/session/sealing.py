"""An operator's orders as robots take them from a file, where no bus seals them."""

from __future__ import annotations

import time

from agent.fleet.model import Fleet
from agent.runtime.order_store import ORDERS_MAX
from agent.security import private_files
from agent.security.certificates import CertificateError, authority_from_pem
from agent.security.credentials import AUTHORITY_CERTIFICATE, CredentialsError, load
from agent.security.identity import IdentityError, of_operator
from agent.security.sealed_order import Opener, Sealer
from deploy.console.arguments import InputError
from deploy.inventory.operator_credentials import earlier_folders, keys_folder, operator_name


def sealed(fleet: Fleet, order: bytes) -> tuple[bytes, ...]:
    """The encoded order, sealed by this operator where `fleet` is secured; while an authority is being
    replaced once with the credentials of each.

    Raises:
        InputError: this operator has no certificate that is valid.
    """
    if not fleet.is_secured:
        return (order,)
    name, now_ns = fleet.fleet.name, time.time_ns()
    folder = keys_folder(name)
    found: list[bytes] = []
    first: CredentialsError | IdentityError | None = None
    for each in (folder, *earlier_folders(folder)):
        try:
            sealer = Sealer(load(each, of_operator(name, operator_name()), now_ns / 1e9))
        except (CredentialsError, IdentityError) as error:
            first = first or error
        else:
            found.append(sealer.seal(order, now_ns))
    if first is not None and not found:
        raise InputError(str(first)) from None
    return tuple(found[:ORDERS_MAX])


def order_opener(fleet: Fleet) -> Opener | None:
    """Opens what a secured fleet's operators have sealed; None where the authority's certificate is not here.

    Raises:
        InputError: it is here, and cannot be read.
    """
    name = fleet.fleet.name
    path = keys_folder(name) / AUTHORITY_CERTIFICATE
    try:
        authority = authority_from_pem(private_files.read(path))
    except private_files.KeyFileError as error:
        if not private_files.exists(path):
            return None
        raise InputError(str(error)) from None
    except CertificateError as error:
        raise InputError(f"{path}: {error}") from None
    return Opener(name, fleet.network.operators, authority)
