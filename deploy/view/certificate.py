"""With what a page's server proves to browsers on other machines who it is: a certificate of the fleet's
authority, for one address and as long as the server lives."""

from __future__ import annotations

import ssl
import tempfile
import time
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.security.certificates import CertificateError, new_key, new_request, pem_of_key
from handfast.agent.security.identity import IdentityError, addresses, of_operator
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.certificate_authority import Authority, AuthorityError
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, keys_folder, operator_name

OPTION: Final = "--listen"


def address_of(text: str) -> str:
    """An address of this machine by which browsers reach it, as certificates have it.

    Raises:
        InputError: it is none, or stands for all of them.
    """
    try:
        (address,) = addresses((text,))
    except IdentityError as error:
        raise InputError(f"{OPTION} {error}") from None
    try:
        is_any = ip_address(address).is_unspecified
    except ValueError:
        is_any = False
    if is_any:
        raise InputError(f"{OPTION} {text}: give the one address by which browsers reach this machine")
    return address


def tls_of(fleet: Fleet, address: str, port: int) -> ssl.SSLContext:
    """TLS for a server at `address`, with a key that no file keeps.

    Raises:
        InputError: the fleet is not secured, or its authority is not on this machine.
    """
    name = fleet.fleet.name
    tunnel = f"ssh -L {port or 8080}:127.0.0.1:{port or 8080} to this machine shows the page there as well"
    if not fleet.is_secured:
        raise InputError(
            f"{OPTION} {address}: {name} is not secured: anybody who sees the page's address on the network "
            f"could drive it. Secure it (docs/security.md), or leave {OPTION} out: {tunnel}"
        )
    folder = keys_folder(name)
    if not (folder / AUTHORITY_FILE).exists():
        raise InputError(
            f"{OPTION} {address}: the authority of {name} is not on this machine, which has to sign the "
            f"page's certificate. Serve the page where it is, or leave {OPTION} out: {tunnel}"
        )
    try:
        identity, key, now_s = of_operator(name, operator_name()), new_key(), time.time()
        with Authority(folder, name, fleet.ids, now_s) as authority:
            chain = authority.sign(identity, new_request(key, identity), (address,), now_s)
    except (IdentityError, AuthorityError, CertificateError) as error:
        raise InputError(f"{OPTION} {address}: {error}") from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    with tempfile.TemporaryDirectory() as private:  # its mode is 0700, and it is gone in a moment
        path = Path(private) / "page.pem"
        path.write_bytes(pem_of_key(key) + chain)
        context.load_cert_chain(path)
    return context
