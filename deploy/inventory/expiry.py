"""How long certificates still hold, and what is said of those that end soon."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from handfast.agent.fleet.model import Fleet
from handfast.agent.security import private_files
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.credentials import RENEW_DAYS, CredentialsError, load_whenever
from handfast.agent.security.identity import IdentityError, of_operator, of_robot
from handfast.agent.security.private_files import KeyFileError
from handfast.deploy.inventory.certificate_authority import INDEX_BYTES_MAX, INDEX_FILE
from handfast.deploy.inventory.operator_credentials import keys_folder, operator_name

WARN_DAYS: Final = RENEW_DAYS
"""From so many days before its end a certificate is warned of: the same from which it is renewed."""


class Expiry(NamedTuple):
    """Until when somebody's certificate holds (s since the Unix epoch), and what renews it."""

    who: str
    not_after_s: float
    renewed_by: str

    def days(self, now_s: float) -> float:
        return (self.not_after_s - now_s) / DAY_S

    def warning(self, now_s: float) -> str:
        """That it ends soon, or has ended; "" when it does not."""
        days = self.days(now_s)
        if days > WARN_DAYS:
            return ""
        when = f"expires in {int(days)} days" if days > 0 else "has expired"
        return f"the certificate of {self.who} {when}: {self.renewed_by} renews it"


def warnings(found: Iterable[Expiry], now_s: float) -> list[str]:
    """What is to be said of those that end soon."""
    return [text for each in found if (text := each.warning(now_s))]


def summary(found: Sequence[Expiry], now_s: float) -> list[str]:
    """How long they hold, in a line; and one for each that ends soon."""
    if not found:
        return []
    robots = [each for each in found if each.who.startswith("robot ")]
    others = [each for each in found if each not in robots]
    parts = [f"{each.who} {_days(each, now_s)}" for each in others]
    if robots:
        first = min(robots, key=lambda each: each.not_after_s)
        parts.append(f"robots {_days(first, now_s)} or more ({first.who})")
    return [f"certificates hold for: {', '.join(parts)}", *warnings(found, now_s)]


def _days(each: Expiry, now_s: float) -> str:
    return f"{max(0, int(each.days(now_s)))} days"


def operators(fleet: Fleet, file: str) -> list[Expiry]:
    """Of the operator who gives orders here, and of the authority as he knows it; none where the fleet is not
    secured, or he has no certificate.

    Args:
        file: the fleet's, as it is named in commands.
    """
    if not fleet.is_secured:
        return []
    name = fleet.fleet.name
    try:
        identity = of_operator(name, operator_name())
        found = load_whenever(keys_folder(name), identity)
    except (IdentityError, CredentialsError):
        return []  # whoever opens the bus says it
    ends_s = found.authority.not_valid_after_utc.timestamp()
    return [
        Expiry(str(identity), found.certificate.not_after_s, f"`handfast keys {file}`"),
        Expiry("the authority", ends_s, f"`handfast keys {file} --new-authority`"),
    ]


def robots_by_index(fleet: Fleet, file: str) -> list[Expiry]:
    """Of robots, as the authority remembers what it has signed last; none where it is not on this machine."""
    if not fleet.is_secured:
        return []
    index = keys_folder(fleet.fleet.name) / INDEX_FILE
    latest = _latest(index)
    found = []
    for robot in fleet.ids:
        ends_s = latest.get(of_robot(fleet.fleet.name, robot).common_name)
        if ends_s is not None:
            found.append(Expiry(f"robot {robot}", ends_s, f"`handfast up {file}`"))
    return found


def _latest(index: Path) -> dict[str, float]:
    try:
        if not private_files.exists(index):
            return {}
        table = json.loads(private_files.read(index, most=INDEX_BYTES_MAX))
        return {str(row["identity"]): float(row["not_after_s"]) for row in table["issued"]}
    except (KeyFileError, ValueError, TypeError, KeyError):
        return {}  # `handfast keys` says what is wrong with it
