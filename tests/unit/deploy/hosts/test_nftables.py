"""The firewall's text; that nft takes it, and what it does, is in tests/hosts."""

from __future__ import annotations

import pytest

from deploy.hosts.nftables import ruleset
from tests.unit.agent.fleet.test_hosts import fleet


def test_it_knows_who_is_named_and_this_computer_itself():
    lines = ruleset(fleet(), ["10.0.0.9", "10.0.0.10", "2001:db8::1", "fe80::1%eth0"]).splitlines()
    assert "  set known4 { type ipv4_addr; elements = { 10.0.0.9, 10.0.0.10, 127.0.0.1 }; }" in lines
    assert "  set known6 { type ipv6_addr; elements = { ::1, 2001:db8::1, fe80::1 }; }" in lines


def test_it_is_about_the_fleets_ports_alone_and_takes_its_own_place():
    lines = ruleset(fleet(), []).splitlines()
    assert lines[:3] == [
        "table inet handfast_two",
        "delete table inet handfast_two",
        "table inet handfast_two {",
    ]
    assert "    tcp dport 7600-7603 tcp flags & (syn | ack) == syn jump opening" in lines
    assert sum("drop" in line for line in lines) == 3


def test_a_name_is_no_address():
    with pytest.raises(ValueError, match="robot-1"):
        ruleset(fleet(), ["robot-1"])
