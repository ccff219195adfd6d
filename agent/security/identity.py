"""Identities on the bus: a certificate's common name, and the addresses that it holds for (PURE)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final

from handfast.agent.messages.types import ROBOT_MAX

ROLES: Final = ("robot", "operator", "router")
"""What an identity may be."""
MAIN: Final = "main"
"""The operator or router that is meant where no name is given."""
COMMON_NAME_MAX: Final = 64
"""X.509's limit (RFC 5280, ub-common-name)."""
ADDRESSES_MAX: Final = 32
"""Addresses in one certificate."""
_FLEET: Final = re.compile(r"[A-Za-z0-9_-]{1,40}", re.ASCII)
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,20}", re.ASCII)
_NUMBER: Final = re.compile(r"[1-9][0-9]{0,3}", re.ASCII)
_HOST: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,251}[A-Za-z0-9])?", re.ASCII)


class IdentityError(ValueError):
    """A name or an address that cannot stand in a certificate; the text says what would be right."""


@dataclass(frozen=True, slots=True, order=True)
class Identity:
    """A robot, an operator or a router of one fleet. Agent, plant and recorder of a robot share the robot's.

    `name` is a robot's id in decimal digits. Make one by `of_robot`, `of_operator`, `of_router` or `parse`,
    which check.
    """

    fleet: str
    role: str
    name: str

    @property
    def common_name(self) -> str:
        """As its certificate has it: ``delta.robot.3``."""
        return f"{self.fleet}.{self.role}.{self.name}"

    @property
    def robot(self) -> int | None:
        """The robot's id, None for others."""
        return int(self.name) if self.role == "robot" else None

    def __str__(self) -> str:
        return f"{self.role} {self.name}"


def of_robot(fleet: str, robot: int) -> Identity:
    """The identity of a robot. `IdentityError` when there cannot be such a one."""
    return _checked(fleet, "robot", str(robot))


def of_operator(fleet: str, name: str = MAIN) -> Identity:
    """The identity of an operator. `IdentityError` when there cannot be such a one."""
    return _checked(fleet, "operator", name)


def of_router(fleet: str, name: str = MAIN) -> Identity:
    """The identity of a router. `IdentityError` when there cannot be such a one."""
    return _checked(fleet, "router", name)


def parse(common_name: str) -> Identity:
    """The identity of a certificate's common name.

    Raises:
        IdentityError: it is none, not even one of another fleet.
    """
    parts = common_name.split(".")
    if len(parts) != 3 or parts[1] not in ROLES:
        raise IdentityError(f"{_shown(common_name)} is not a name as FLEET.robot.ID or FLEET.operator.NAME")
    return _checked(*parts)


def _checked(fleet: str, role: str, name: str) -> Identity:
    if not _FLEET.fullmatch(fleet):
        raise IdentityError(f"the fleet's name {_shown(fleet)} must be 1 to 40 letters, digits, - or _")
    if role == "robot":
        if not _NUMBER.fullmatch(name) or int(name) > ROBOT_MAX:
            raise IdentityError(f"the robot's id {_shown(name)} must be within 1..{ROBOT_MAX}")
    elif not _NAME.fullmatch(name):
        raise IdentityError(f"the {role}'s name {_shown(name)} must be 1 to 20 letters, digits, - or _")
    identity = Identity(fleet, role, name)
    excess = len(identity.common_name) - COMMON_NAME_MAX
    if excess > 0:
        raise IdentityError(
            f"{identity.common_name} is too long for a certificate: the {role}'s name must be {excess} "
            "characters shorter"
        )
    return identity


def addresses(texts: Iterable[str]) -> tuple[str, ...]:
    """Addresses that others dial, as certificates have them: each once, in order, IPv6 without brackets.

    Raises:
        IdentityError: one is neither an IP address nor a host name, or there are too many.
    """
    found = {_address(text) for text in texts}
    if len(found) > ADDRESSES_MAX:
        raise IdentityError(f"{len(found)} addresses for one certificate, at most {ADDRESSES_MAX}")
    return tuple(sorted(found))


def _address(text: str) -> str:
    bare = text[1:-1] if text.startswith("[") and text.endswith("]") else text
    try:
        found = ip_address(bare)
    except ValueError:
        found = None
    if found is not None and "%" not in bare:
        return str(found)
    # What is all digits and dots, but no address, is a mistake and never a name.
    if found is not None or not _HOST.fullmatch(bare) or re.fullmatch(r"[0-9.]+", bare) or ".." in bare:
        raise IdentityError(f"{_shown(text)} is neither an IP address nor a host name")
    return bare.lower()


def _shown(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
