"""Names that stand in certificates, and the addresses."""

from __future__ import annotations

import pytest

from handfast.agent.security.identity import (
    ADDRESSES_MAX,
    COMMON_NAME_MAX,
    Identity,
    IdentityError,
    addresses,
    of_operator,
    of_robot,
    of_router,
    parse,
)
from handfast.deploy.inventory.certificate_builder import is_ip


@pytest.mark.parametrize(
    ("identity", "name"),
    [
        (of_robot("delta", 3), "delta.robot.3"),
        (of_robot("d-2_x", 9999), "d-2_x.robot.9999"),
        (of_operator("delta"), "delta.operator.main"),
        (of_operator("delta", "ann"), "delta.operator.ann"),
        (of_router("delta", "hall-1"), "delta.router.hall-1"),
    ],
)
def test_a_name_and_back(identity: Identity, name: str) -> None:
    assert identity.common_name == name
    assert parse(name) == identity


def test_which_robot() -> None:
    assert of_robot("delta", 12).robot == 12
    assert of_operator("delta", "12").robot is None


@pytest.mark.parametrize(
    "name",
    [
        "", "delta", "delta.robot", "delta.robot.0", "delta.robot.03", "delta.robot.10000", "delta.robot.-1",
        "delta.robot.*", "delta.robot.٣", "delta.robot.3 ", "delta.robot.3\n", "delta.robot.3.4", ".robot.3",
        "*.robot.3", "delta/x.robot.3", "delta.plant.3", "delta.operator.", "delta.operator.a b",
        "delta.operator.*", "delta.operator.a/b", "delta.operator." + "a" * 21, "x" * 41 + ".robot.1",
    ],
)  # fmt: skip
def test_what_is_no_name(name: str) -> None:
    with pytest.raises(IdentityError):
        parse(name)


def test_a_name_that_is_too_long_in_all() -> None:
    fleet = "f" * 40
    longest = COMMON_NAME_MAX - len(fleet) - len(".operator.")
    assert len(of_operator(fleet, "a" * longest).common_name) == COMMON_NAME_MAX
    with pytest.raises(IdentityError, match="2 characters shorter"):
        of_operator(fleet, "a" * (longest + 2))


def test_addresses_as_certificates_have_them() -> None:
    given = ["robot-1.Lan", "10.0.0.2", "[fe80::1]", "::1", "10.0.0.2", "::0:1"]
    assert addresses(given) == ("10.0.0.2", "::1", "fe80::1", "robot-1.lan")
    assert [*map(is_ip, addresses(given))] == [True, True, True, False]


@pytest.mark.parametrize(
    "address",
    ["", "10.0.0", "10.0.0.256", "a b", "*", "*.lan", "a..b", "-a", "a/b", "fe80::1%eth0", "[::1", "ä"],
)
def test_what_is_no_address(address: str) -> None:
    with pytest.raises(IdentityError, match="neither an IP address nor a host name"):
        addresses([address])


def test_too_many_addresses() -> None:
    with pytest.raises(IdentityError, match="at most"):
        addresses(f"10.0.0.{number}" for number in range(ADDRESSES_MAX + 1))
