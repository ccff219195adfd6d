"""Certificates as they are made: what they hold for, and how long."""

from __future__ import annotations

from handfast.agent.security.certificates import DAY_S, issued_from_pem, new_key
from handfast.agent.security.identity import of_robot
from handfast.deploy.inventory.certificate_authority import (
    AUTHORITY_DAYS,
    BACK_S,
    CERTIFICATE_DAYS,
    self_signed,
    signed,
)
from tests.trusted import FLEET, NOW_S


def test_a_certificate_holds_for_addresses_and_a_year() -> None:
    by, own = new_key(), new_key()
    authority = self_signed(by, f"{FLEET}.authority.1", NOW_S)
    assert authority.not_valid_after_utc.timestamp() == NOW_S + AUTHORITY_DAYS * DAY_S
    where = ("10.0.0.3", "rover3.lan", "fe80::3")
    made = signed(by, authority, of_robot(FLEET, 3), own.public_key(), where, NOW_S)
    found = issued_from_pem(made, authority)
    assert found.identity == of_robot(FLEET, 3)
    assert set(found.addresses) == set(where)
    assert (found.not_before_s, found.not_after_s) == (NOW_S - BACK_S, NOW_S + CERTIFICATE_DAYS * DAY_S)


def test_it_does_not_outlive_its_authority() -> None:
    by, own = new_key(), new_key()
    authority = self_signed(by, f"{FLEET}.authority.1", NOW_S)
    late_s = NOW_S + (AUTHORITY_DAYS - 10) * DAY_S
    found = issued_from_pem(
        signed(by, authority, of_robot(FLEET, 3), own.public_key(), ("a",), late_s), authority
    )
    assert found.days_left(late_s) == 10
