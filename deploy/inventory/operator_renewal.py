"""An operator's certificate that has expired is renewed on the spot where the authority is: who wants to
stop a fleet must not be told to look after keys first."""

from __future__ import annotations

import time
from pathlib import Path

from handfast.agent.fleet.model import Fleet
from handfast.agent.security.credentials import (
    Credentials,
    CredentialsError,
    NotValidNowError,
    load,
    make_request,
    store,
)
from handfast.agent.security.identity import Identity
from handfast.agent.security.private_files import KeyFileError, exists
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE


def usable(fleet: Fleet, folder: Path, identity: Identity, ahead_s: float = 0.0) -> Credentials:
    """The operator's credentials in `folder`, renewed if they are not valid now and the authority is there.

    Args:
        ahead_s: how far the clock by which they are to be valid is ahead of this machine's.

    Raises:
        handfast.agent.security.credentials.CredentialsError: there are none, or they cannot be renewed here.
    """
    now_s = time.time() + ahead_s
    try:
        return load(folder, identity, now_s)
    except NotValidNowError as error:
        from handfast.deploy.inventory.certificate_authority import Authority, AuthorityError

        try:
            if not exists(folder / AUTHORITY_FILE):
                raise
            with Authority(folder, fleet.fleet.name, fleet.ids, now_s) as authority:
                request = make_request(folder, identity)
                return store(folder, identity, authority.sign(identity, request, (), now_s), now_s)
        except (AuthorityError, KeyFileError, CredentialsError):
            raise error from None
