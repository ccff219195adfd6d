"""The firewall's text; that nft takes it, and what it does, is in tests/hosts."""

from __future__ import annotations

import pytest

from deploy.hosts.artifacts.nftables import ruleset
from tests.unit.agent.fleet.test_hosts import HOSTS, ROUTERS, fleet


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


def test_it_can_close_the_ports_to_all_devices_but_some():
    lines = ruleset(fleet(), [], ["wg0", "wg1"]).splitlines()
    closed = lines.index('    tcp dport 7600-7603 iifname != { "lo", "wg0", "wg1" } drop')
    assert closed < next(k for k, line in enumerate(lines) if "jump opening" in line)
    assert "iifname" not in ruleset(fleet(), [])


def test_the_port_of_routers_on_hosts_is_one_of_them():
    assert "    tcp dport 7600-7604 tcp flags" in ruleset(fleet(HOSTS + ROUTERS % "left"), [])
    assert "    tcp dport 7600-7603 tcp flags" in ruleset(fleet(HOSTS + ROUTERS % "a:7447"), [])


def test_a_name_is_no_address():
    with pytest.raises(ValueError, match="robot-1"):
        ruleset(fleet(), ["robot-1"])
