"""The command ``handfast keys``: certificates for those who take part in a fleet, keys for its vehicles."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from handfast.agent.common.errors import PASSED
from handfast.agent.fleet.model import Fleet
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.credentials import (
    RENEW_DAYS,
    Credentials,
    CredentialsError,
    authority_of,
    load,
    load_whenever,
    make_request,
    store,
    wanting,
)
from handfast.agent.security.identity import (
    MAIN,
    Identity,
    IdentityError,
    addresses,
    of_operator,
    of_robot,
    of_router,
)
from handfast.agent.security.private_files import KeyFileError, exists
from handfast.deploy.commands.hosts.key_exchange import existing, install, request, sign
from handfast.deploy.commands.hosts.signing import IN_CLEAR, give_signing_keys
from handfast.deploy.console.arguments import (
    InputError,
    describe,
    fleet_arguments,
    load_unresolved,
    place_for,
)
from handfast.deploy.console.wording import aligned
from handfast.deploy.inventory.certificate_authority import Authority, AuthorityError, Issued
from handfast.deploy.inventory.operator_credentials import (
    AUTHORITY_FILE,
    KEYS,
    OPERATOR,
    RequestError,
    keys_folder,
    operator_name,
    short,
)

KEEP: Final = (
    "keep a copy of that folder in a safe place; if the fleet has an authority on another computer, remove "
    "the folder, and --request"
)
REVOKED: Final = (
    "All previous certificates are revoked. `handfast up` gives new ones to robots on hosts; make the others "
    "again with `handfast keys` (--list shows them)."
)
LAST_DAYS: Final = 365
"""An authority that is about to end is warned of for so long: no certificate outlives it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast keys`` takes."""
    describe(
        parser,
        ": the fleet's authority and this operator's certificate, if "
        "they are missing or expire soon. Robots with a host get theirs from `handfast up`; their private "
        "keys never leave them. A second operator, on another computer, asks the authority's for a "
        "certificate: --request there, --sign here, --install there. With --signing, gives vehicles their "
        f"MAVLink 2 keys instead. {IN_CLEAR} Exit status: 0; 1 some vehicles do not sign; 2 bad input; 130 "
        "after Ctrl-C.",
    )
    fleet_arguments(parser)
    parser.add_argument(
        "--keys", metavar="DIR", help=f"where the keys are (${KEYS}, or ~/.config/handfast/keys/FLEET)"
    )
    parser.add_argument("--operator", metavar="NAME", help=f"who gives orders here (${OPERATOR}, or {MAIN})")
    parser.add_argument(
        "--router", action="store_const", const=MAIN, help="make the certificate of the fleet's routers, too"
    )
    parser.add_argument(
        "--robot",
        dest="robots",
        type=int,
        action="append",
        default=[],
        metavar="N",
        help="make key and certificate of a robot without ssh, into --out; or, repeatedly, with --signing: "
        "only this vehicle",
    )
    parser.add_argument(
        "--address",
        dest="addresses",
        action="append",
        default=[],
        metavar="A",
        help="address that others reach the router or the robot at, repeatedly",
    )
    parser.add_argument(
        "--out",
        type=place_for,
        metavar="PATH",
        help="folder, or file, for what is to be carried to another computer",
    )
    parser.add_argument(
        "--renew", action="store_true", help="new certificates also where they are still good"
    )
    parser.add_argument(
        "--new-authority",
        action="store_true",
        help="replace the authority, which revokes every certificate; `handfast down` first",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="with --new-authority: though the fleet is up, as where a robot is lost or stolen",
    )
    alone = parser.add_argument_group("instead of that")
    alone.add_argument("--list", action="store_true", help="only show what there is")
    alone.add_argument(
        "--request",
        action="store_true",
        help="make a key for this operator, and a request for its certificate (--out FILE)",
    )
    alone.add_argument(
        "--sign",
        metavar="FILE",
        help="sign the request of another operator (--out FILE)",
    )
    alone.add_argument("--install", metavar="FILE", help="take what --sign wrote, for the key of --request")
    alone.add_argument(
        "--signing",
        action="store_true",
        help="give each robot with mavlink.signing_key its key, while it is disarmed",
    )
    alone.add_argument(
        "--make-keys",
        action="store_true",
        help="with --signing: make the key files that are missing; never replaces one",
    )
    parser.set_defaults(command=_keys)


def _keys(options: argparse.Namespace) -> int:
    _check_signing(options)
    if options.signing:
        return give_signing_keys(options)
    options.robot = options.robots[0] if options.robots else None
    fleet = load_unresolved(options)
    name = fleet.fleet.name
    folder = Path(options.keys).expanduser() if options.keys is not None else keys_folder(name)
    options.operator = operator_name() if options.operator is None else options.operator
    try:
        _check(options, fleet)
        alone = next((action for option, action in ALONE.items() if _given(options, option)), None)
        (alone or _provide_all)(options, fleet, folder, time.time())
        return PASSED
    except (AuthorityError, CredentialsError, IdentityError, KeyFileError, RequestError) as error:
        raise InputError(str(error)) from None


def _given(options: argparse.Namespace, option: str) -> bool:
    return getattr(options, option) not in (None, False)


def _check(options: argparse.Namespace, fleet: Fleet) -> None:
    """Raises `InputError` where options do not go together, or name what the fleet does not have."""
    _check_together(options)
    if options.robot is not None and options.robot not in fleet.ids:
        raise InputError(f"there is no robot {options.robot} in {fleet.fleet.name}")
    of_operator(fleet.fleet.name, options.operator)
    if options.operator not in fleet.network.operators:
        raise InputError(
            f"robots of {fleet.fleet.name} take no orders of {options.operator}: network.operators are "
            f"{', '.join(fleet.network.operators)}"
        )
    addresses(options.addresses)
    if options.router is not None and not (options.addresses or _elsewhere(fleet)):
        raise InputError(
            "--router needs --address, at which robots reach it, or HOST:PORT in network.routers (those on "
            "hosts get theirs from `handfast up`)"
        )


def _check_signing(options: argparse.Namespace) -> None:
    """Raise `InputError` if --signing is combined with options of certificates, or they with its own."""
    others = ("keys", "operator", "router", "addresses", "out", "renew", "new_authority", "force", *ALONE)
    if options.signing and (given := [each for each in others if getattr(options, each)]):
        rest = ", ".join(f"--{each.replace('addresses', 'address').replace('_', '-')}" for each in given)
        raise InputError(f"--signing takes --robot and --make-keys only: leave out {rest}")
    if not options.signing and (options.make_keys or len(options.robots) > 1):
        raise InputError("--make-keys and several --robot belong to --signing")


def _check_together(options: argparse.Namespace) -> None:
    alone, *others = [each for each in (*ALONE, *OTHERS) if _given(options, each)] or ("",)
    if alone in ALONE and others:
        rest = ", ".join(f"--{each.replace('_', '-')}" for each in others)
        raise InputError(f"--{alone} goes alone: leave out {rest}")
    to_carry, has_robot = options.out is not None, options.robot is not None
    has_router = options.router is not None
    for is_wrong, why in (
        (options.force and not options.new_authority, "--force belongs to --new-authority"),
        (has_robot and has_router, "--robot or --router, not both"),
        (
            options.request and not to_carry,
            "--request needs --out FILE, which is carried to where the authority is",
        ),
        (
            has_robot != to_carry and not has_router and alone not in ("request", "sign"),
            "--robot and --out DIR belong together: key and certificate are made in DIR",
        ),
        (
            options.addresses and not (has_robot or has_router),
            "--address is that of a robot or a router: give --robot or --router, too",
        ),
    ):
        if is_wrong:
            raise InputError(why)


# ---------------------------------------------------------------------- what goes alone


def _list(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    if authority_of(folder) and not exists(folder / AUTHORITY_FILE):
        _show_own(load_whenever(folder, of_operator(fleet.fleet.name, options.operator)), now_s)
        return
    with existing(options, fleet, folder, now_s) as authority:
        _show(authority, now_s)


OTHERS: Final = ("renew", "new_authority", "router", "robot")
Alone = Callable[[argparse.Namespace, Fleet, Path, float], None]
ALONE: Final[Mapping[str, Alone]] = {"list": _list, "request": request, "sign": sign, "install": install}
"""What is done instead of providing certificates, by the option that says so."""


# ---------------------------------------------------------------------- certificates of this computer's


def _provide_all(options: argparse.Namespace, fleet: Fleet, folder: Path, now_s: float) -> None:
    if options.new_authority and not options.force:
        _refuse_while_up(fleet)
    with Authority(folder, fleet.fleet.name, fleet.ids, now_s, new=options.new_authority) as authority:
        _make(options, fleet, authority, now_s)
        _show(authority, now_s)


def _refuse_while_up(fleet: Fleet) -> None:
    """Raises `InputError` where this operator has brought the fleet up: no order would reach its robots."""
    from handfast.deploy.inventory.registry import fleets_up

    for each in fleets_up()[0]:
        if each.name == fleet.fleet.name:
            raise InputError(
                f"{each}: its robots would take no order under another authority. `handfast down` first (or "
                "--force, where a host is lost)"
            )


def _make(options: argparse.Namespace, fleet: Fleet, authority: Authority, now_s: float) -> None:
    name = fleet.fleet.name
    if authority.created:
        print(f"made authority {authority.generation} of {name} in {authority.folder}: {KEEP}")
    if options.new_authority:
        print(REVOKED)
    _provide(authority, authority.folder, of_operator(name, options.operator), [], options.renew, now_s)
    if options.robot is not None:
        where = options.addresses or [address_of(fleet, options.robot)]
        out = Path(options.out).expanduser()
        _provide(authority, out, of_robot(name, options.robot), where, options.renew, now_s)
    elif options.router is not None:
        out = Path(options.out).expanduser() if options.out is not None else authority.folder
        where = options.addresses or _elsewhere(fleet)
        _provide(authority, out, of_router(name, options.router), where, options.renew, now_s)


def _elsewhere(fleet: Fleet) -> list[str]:
    """Addresses of the routers that are on none of the fleet's hosts."""
    return [router.where.rpartition(":")[0] for router in fleet.routers if router.host is None]


def _latest(authority: Authority) -> dict[str, Issued]:
    """The last certificate of each, by their common names."""
    return {entry.identity: entry for entry in authority.issued()}


def address_of(fleet: Fleet, robot: int) -> str:
    """Where others reach a robot, without a port."""
    return fleet.agent_endpoint(robot).partition("/")[2].rpartition(":")[0]


def _provide(
    authority: Authority, folder: Path, identity: Identity, where: Sequence[str], renew: bool, now_s: float
) -> None:
    """Sees that there is a valid certificate for a key in `folder`."""
    wanted = addresses(where)
    why = wanting(folder, identity, wanted, authority.certificate_pem, now_s)
    if not why and not renew:
        return
    request = make_request(folder, identity)
    store(folder, identity, authority.sign(identity, request, wanted, now_s), now_s)
    files = load(folder, identity, now_s).files
    print(f"{identity}: made {files.certificate}" + (f" ({why})" if why else ""))


def _show(authority: Authority, now_s: float) -> None:
    days = authority.days_left(now_s)
    rows: list[tuple[str, ...]] = [
        (
            "authority",
            f"{authority.generation} {short(authority.fingerprint)}",
            _date(now_s, days),
            _ending(days),
        )
    ]
    for name, entry in sorted(_latest(authority).items(), key=lambda item: _order(item[0])):
        rows.append(
            (*name.split(".")[1:], _date(now_s, entry.days_left(now_s)), state(entry, authority, now_s))
        )
    print(*aligned(rows), sep="\n")


def _show_own(own: Credentials, now_s: float) -> None:
    """What an operator has whose authority is on another computer."""
    ends_s = own.authority.not_valid_after_utc.timestamp()
    days, of_authority = ((until_s - now_s) / DAY_S for until_s in (own.certificate.not_after_s, ends_s))
    if days <= 0:
        ends = "expired: --request, --sign where the authority is, --install"
    elif days > RENEW_DAYS:
        ends = "valid"
    else:
        ends = f"expires in {int(days)} days: --request, --sign where the authority is, --install"
    rows = [
        ("authority", short(own.authority_fingerprint), _date(now_s, of_authority), "on another computer"),
        (own.identity.role, own.identity.name, _date(now_s, days), ends),
    ]
    print(*aligned(rows), sep="\n")


def _ending(days: float) -> str:
    if days >= LAST_DAYS:
        return ""
    when = f"ends in {int(days)} days, and all certificates with it" if days > 0 else "expired"
    return f"{when}: --new-authority, after `handfast down`"


def state(entry: Issued, authority: Authority, now_s: float) -> str:
    """The state of somebody's last certificate, in a few words."""
    days = entry.days_left(now_s)
    if entry.generation != authority.generation:
        return "void: of an authority that was replaced"
    if days <= 0:
        return "expired"
    if days > RENEW_DAYS:
        return "valid"
    if entry.not_after_s >= authority.not_after_s:
        return f"ends in {int(days)} days, with its authority"
    return f"expires in {int(days)} days: renewed when there is an opportunity"


def _date(now_s: float, days: float) -> str:
    return f"until {datetime.fromtimestamp(now_s + days * DAY_S, UTC):%Y-%m-%d}"


def _order(name: str) -> tuple[str, int, str]:
    _, role, last = name.split(".")
    return role, int(last) if role == "robot" else 0, last
