"""Where the routers of a fleet are."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.hosts import RouterPlace
from handfast.agent.fleet.model import Fleet
from handfast.deploy.processes.placement import place
from tests.unit.agent.fleet.test_hosts import HOSTS, LEFT, ROUTERS, fleet, large

SPARE = '[host.spare]\naddress = "10.0.0.9"\n'
LARGE = [f'robot.{k}.host="{("left", "right", "spare")[k % 3]}"' for k in range(1, 26)]


def hosted(*sets: str) -> Fleet:
    """25 robots on three hosts, the first of them on right."""
    where = {"left": "10.0.0.1", "right": "10.0.0.2", "spare": "10.0.0.9"}
    return large(*LARGE, *(f'host.{name}.address="{each}"' for name, each in where.items()), *sets)


def test_routers_are_on_the_hosts_that_the_file_names_and_elsewhere() -> None:
    found = fleet(HOSTS + SPARE + ROUTERS % 'a:7447", "spare", "right').routers
    assert found == (
        RouterPlace(1, "a:7447", "a:7447", None),
        RouterPlace(2, "10.0.0.9:7604", "10.0.0.9:7604", "spare"),
        RouterPlace(3, "10.0.0.2:7604", "0.0.0.0:7604", "right"),
    )
    assert [router.identity_name for router in found] == ["main", "2", "3"]


def test_two_hosts_of_robots_have_routers_where_the_file_names_none() -> None:
    assert [router.host for router in hosted().routers] == ["right", "spare"]
    assert [router.where for router in hosted().routers] == ["10.0.0.2:7650", "10.0.0.9:7650"]
    assert hosted('network.topology="mesh"').routers == ()
    assert [router.host for router in fleet(HOSTS + '[network]\ntopology = "routed"').routers] == [
        "left",
        "right",
    ]
    assert fleet().routers == (), "a small fleet has none"


def test_a_fleet_whose_robots_share_a_host_has_one() -> None:
    one = fleet(HOSTS + '[network]\ntopology = "routed"', LEFT, LEFT)
    assert [router.host for router in one.routers] == ["left"]


def test_a_fleet_without_hosts_has_those_that_whoever_runs_it_starts() -> None:
    assert large().is_routed
    assert large().routers == ()


@pytest.mark.parametrize(("made", "count"), [(hosted(), 2), (large(), 1)])
def test_on_one_machine_it_has_as_many(made: Fleet, count: int) -> None:
    placed = place(made)
    try:
        assert [router.host for router in placed.fleet.routers] == [None] * count
    finally:
        placed.ports.close()


def test_endpoints_say_whether_links_are_secured() -> None:
    secured = fleet(HOSTS + ROUTERS % "left")
    assert secured.router_endpoints == ("tls/10.0.0.1:7604",)
    assert fleet(HOSTS + ROUTERS % "left" + '\nsecurity = "off"').router_endpoints == ("tcp/10.0.0.1:7604",)
    assert secured.router_on("left") is not None
    assert secured.router_on("right") is None
