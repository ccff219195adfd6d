"""How long certificates hold, and what is said of those that end soon."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.identity import of_operator, of_robot
from handfast.deploy.inventory.certificate_authority import AUTHORITY_DAYS, CERTIFICATE_DAYS
from handfast.deploy.inventory.expiry import WARN_DAYS, Expiry, operators, robots_by_index, summary, warnings
from handfast.deploy.inventory.operator_credentials import KEYS, OPERATOR
from tests.trusted import NOW_S, authority, credentials
from tests.unit.deploy.orders.order_fleets import square

MINE, ROBOTS = (
    Expiry("operator main", NOW_S + 300 * DAY_S, "`keys`"),
    [
        Expiry(f"robot {robot}", NOW_S + days * DAY_S, "`up`")
        for robot, days in ((1, 200), (2, 29.5), (3, -1))
    ],
)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Fleet:
    """A secured one, with certificates of the operator and of robot 2, twice."""
    monkeypatch.setenv(KEYS, str(tmp_path))
    monkeypatch.delenv(OPERATOR, raising=False)
    plain = square()
    name = plain.fleet.name
    with authority(tmp_path, NOW_S, name) as by:
        credentials(by, tmp_path, of_operator(name))
        credentials(by, tmp_path / "r", of_robot(name, 2))
        credentials(by, tmp_path / "r", of_robot(name, 2), now_s=NOW_S + 10 * DAY_S)
    return replace(plain, network=replace(plain.network, security="mtls"))


def test_what_ends_soon_is_warned_of_with_what_renews_it() -> None:
    assert warnings([MINE, *ROBOTS], NOW_S) == [
        "the certificate of robot 2 expires in 29 days: `up` renews it",
        "the certificate of robot 3 has expired: `up` renews it",
    ]
    assert MINE.warning(NOW_S + (300 - WARN_DAYS) * DAY_S) != ""
    assert MINE.warning(NOW_S + (300 - WARN_DAYS - 0.1) * DAY_S) == ""


def test_a_line_says_how_long_all_hold() -> None:
    assert summary([], NOW_S) == []
    said = summary([MINE, *ROBOTS], NOW_S)
    assert said[0] == "certificates hold for: operator main 300 days, robots 0 days or more (robot 3)"
    assert said[1:] == warnings(ROBOTS, NOW_S)


def test_the_operators_and_the_authoritys(fleet: Fleet) -> None:
    found = operators(fleet, "f.toml")
    assert [(each.who, each.days(NOW_S)) for each in found] == [
        ("operator main", CERTIFICATE_DAYS),
        ("the authority", AUTHORITY_DAYS),
    ]
    assert found[0].renewed_by == "`handfast keys f.toml`"
    late_s = NOW_S + CERTIFICATE_DAYS * DAY_S
    assert warnings(operators(fleet, "f.toml"), late_s) == [
        "the certificate of operator main has expired: `handfast keys f.toml` renews it"
    ]


def test_robots_as_the_authority_remembers_them(fleet: Fleet, tmp_path: Path) -> None:
    assert [(each.who, each.days(NOW_S)) for each in robots_by_index(fleet, "f.toml")] == [
        ("robot 2", CERTIFICATE_DAYS + 10)
    ]
    (tmp_path / "index.json").write_text("half")
    assert robots_by_index(fleet, "f.toml") == []


def test_without_certificates_nothing_is_said(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEYS, "/nowhere")
    assert operators(fleet, "f.toml") == robots_by_index(fleet, "f.toml") == []
    plain = square()
    assert operators(plain, "f.toml") == robots_by_index(plain, "f.toml") == []
