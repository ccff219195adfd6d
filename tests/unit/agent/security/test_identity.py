"""Names that stand in certificates, and the addresses.

Who may say what: the list that every process checks its links against.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import zenoh

from handfast.agent.messages import key_expressions
from handfast.agent.security.identity import (
    ADDRESSES_MAX,
    COMMON_NAME_MAX,
    Identity,
    IdentityError,
    access_settings,
    addresses,
    of_operator,
    of_robot,
    of_router,
    parse,
)
from handfast.deploy.inventory.certificate_authority import is_ip
from tests.trusted import security


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


FLEET = "delta"


def allowed(settings: dict[str, Any], name: str, message: str, flow: str = "ingress") -> list[str]:
    """Key expressions on which a certificate of this name may send a kind of message."""
    rules = {rule["id"]: rule for rule in settings["rules"]}
    groups = {
        subject["id"] for subject in settings["subjects"] if name in subject.get("cert_common_names", [name])
    }
    found = [
        rules[rule]
        for policy in settings["policies"]
        if groups & set(policy["subjects"])
        for rule in policy["rules"]
    ]
    assert all(rule["permission"] == "allow" for rule in found)
    return [
        where
        for rule in found
        if message in rule["messages"] and flow in rule["flows"]
        for where in rule["key_exprs"]
    ]


def may(settings: dict[str, Any], name: str, message: str, key: str) -> bool:
    return any(
        zenoh.KeyExpr(where).includes(zenoh.KeyExpr(key)) for where in allowed(settings, name, message)
    )


ORDERS = (
    key_expressions.mission,
    key_expressions.stop,
    key_expressions.resume,
    key_expressions.faults,
    key_expressions.heartbeat,
    key_expressions.ask,
    key_expressions.events,
)
OWN = (
    key_expressions.hand,
    key_expressions.status,
    key_expressions.beacon,
    key_expressions.relayed,
    key_expressions.plant_state,
    key_expressions.plant_truth,
    key_expressions.wrench,
    key_expressions.checks,
    key_expressions.links,
    key_expressions.plant_links,
)


def test_all_is_denied_but_what_is_listed() -> None:
    settings = access_settings(FLEET, (1, 2))
    assert (settings["enabled"], settings["default_permission"]) == (True, "deny")
    for message in ("put", "delete", "query", "reply", "declare_queryable", "liveliness_token"):
        assert allowed(settings, f"{FLEET}.robot.3", message) == []
        assert allowed(settings, "other.operator.main", message) == []
    for name in (f"{FLEET}.robot.1", f"{FLEET}.operator.main", f"{FLEET}.router.main"):
        assert allowed(settings, name, "put", "egress") == ["**", *key_expressions.batches(FLEET)]
    for name in ("anybody", "www.example.com", f"{FLEET}.robot.3"):  # other authorities may sign such ones
        assert allowed(settings, name, "put", "egress") == []


def test_a_robot_has_its_own_keys() -> None:
    settings = access_settings(FLEET, (1, 2, 12))
    for robot in (1, 2, 12):
        name = of_robot(FLEET, robot).common_name
        for other in (1, 2, 12):
            for key in OWN:
                assert may(settings, name, "put", key(FLEET, other)) == (robot == other)
            for role in key_expressions.ROLES:
                assert may(settings, name, "put", key_expressions.faults_held(FLEET, other, role)) == (
                    robot == other
                )
                token = key_expressions.alive(FLEET, other, role)
                assert may(settings, name, "liveliness_token", token) == (robot == other)
        for order in ORDERS:
            assert not may(settings, name, "put", order(FLEET))
        of_robot_alone = key_expressions.of_robot(FLEET, robot)
        for other_key in ("*", "**", "hand/more", "anything", "plant/*", "plant/anything", "plant"):
            assert not may(settings, name, "put", of_robot_alone + other_key)
        for wild in (f"{FLEET}/**", f"{FLEET}/robot/*/hand", f"{FLEET}/*", "**"):
            assert not may(settings, name, "put", wild)
        for role in ("*", "other", "agent/other"):
            assert not may(settings, name, "liveliness_token", key_expressions.alive(FLEET, robot, role))
        assert not may(settings, name, "liveliness_token", key_expressions.alive(FLEET, "*", "agent"))
        for message in ("delete", "query", "reply", "declare_queryable"):
            assert not may(settings, name, message, key_expressions.hand(FLEET, robot))


def test_operators_give_orders() -> None:
    settings = access_settings(FLEET, (1,), operators=("ann", "bob"))
    for operator in ("ann", "bob"):
        name = of_operator(FLEET, operator).common_name
        assert all(may(settings, name, "put", order(FLEET)) for order in ORDERS)
        assert not any(may(settings, name, "put", key(FLEET, 1)) for key in OWN)
        assert not may(settings, name, "liveliness_token", key_expressions.alive(FLEET, 1, "agent"))
    assert not may(settings, of_operator(FLEET, "eve").common_name, "put", key_expressions.stop(FLEET))


def test_all_of_the_fleet_may_listen() -> None:
    settings = access_settings(FLEET, (1,))
    for name in ("robot.1", "operator.main", "router.main"):
        for message in ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"):
            for key in (
                key_expressions.everything(FLEET),
                key_expressions.hand(FLEET, "*"),
                key_expressions.alive(FLEET, "*", "*"),
            ):
                assert may(settings, f"{FLEET}.{name}", message, key)
    assert not may(settings, f"{FLEET}.robot.2", "declare_subscriber", key_expressions.everything(FLEET))
    assert not may(settings, f"{FLEET}.robot.1", "declare_subscriber", key_expressions.everything("other"))


def test_a_router_passes_on_what_is_the_fleets() -> None:
    settings = access_settings(FLEET, (1,), routers=("hall",))
    name = f"{FLEET}.router.hall"
    assert may(settings, name, "put", key_expressions.hand(FLEET, 1))
    assert may(settings, name, "put", key_expressions.stop(FLEET))
    assert may(settings, name, "liveliness_token", key_expressions.alive(FLEET, 1, "agent"))
    assert not may(settings, name, "put", key_expressions.hand("other", 1))


def test_batches_are_routers_and_all_of_the_fleet_hear_them() -> None:
    settings = access_settings(FLEET, (1,), routers=("hall",))
    for batches in key_expressions.batches(FLEET):
        assert may(settings, f"{FLEET}.router.hall", "put", batches)
        for name in ("robot.1", "operator.main"):
            assert not may(settings, f"{FLEET}.{name}", "put", batches)
            assert may(settings, f"{FLEET}.{name}", "declare_subscriber", batches)
        assert not may(settings, "other.router.hall", "put", batches)
    for batches in key_expressions.batches("other"):
        assert not may(settings, f"{FLEET}.router.hall", "put", batches)


def test_names_that_no_certificate_can_have() -> None:
    with pytest.raises(IdentityError):
        access_settings(FLEET, (0,))
    with pytest.raises(IdentityError):
        access_settings(FLEET, (1,), operators=("a b",))


def test_nobody_in_a_group() -> None:
    settings = access_settings(FLEET, (), (), ())
    assert (settings["subjects"], settings["policies"]) == ([], [])


def test_what_a_process_is_given(tmp_path: Path) -> None:
    mine = security(tmp_path, of_robot("guarded", 2)).settings()
    tls = mine["transport/link/tls"]
    assert tls["enable_mtls"] is True
    assert tls["verify_name_on_connect"] is True
    assert tls["listen_private_key"] == tls["connect_private_key"] == str(tmp_path / "guarded.robot.2.key")
    assert mine["access_control"] == access_settings("guarded", (1, 2, 3))
