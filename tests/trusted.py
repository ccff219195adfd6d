"""A fleet's authority and the credentials that it gives, for tests: real keys, in a folder of the test's."""

from __future__ import annotations

from pathlib import Path

from handfast.agent.security.credentials import Credentials, Files, make_request, store
from handfast.agent.security.identity import Identity, Security
from handfast.deploy.inventory.certificate_authority import Authority

NOW_S = 1_790_000_000.0
FLEET = "guarded"
ROBOTS = (1, 2, 3)


def authority(folder: Path, now_s: float = NOW_S, fleet: str = FLEET, *, new: bool = False) -> Authority:
    """The authority in `folder`; the caller closes it."""
    return Authority(folder, fleet, ROBOTS, now_s, new=new)


def credentials(
    by: Authority,
    folder: Path,
    identity: Identity,
    where: tuple[str, ...] = (),
    now_s: float = NOW_S,
) -> Credentials:
    """New credentials of `identity` in `folder`, signed by an authority that may be anybody's."""
    request = make_request(folder, identity)
    return store(folder, identity, by.sign(identity, request, where, now_s), now_s)


def security(folder: Path, identity: Identity) -> Security:
    """What a process of `identity` is given, of the files in `folder`."""
    files = Files(folder, identity)
    return Security(identity, str(files.authority), str(files.certificate), str(files.key), robots=ROBOTS)
