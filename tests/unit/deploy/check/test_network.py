"""What a network carries, in each topology."""

from __future__ import annotations

import pytest

from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from deploy.check.network import check_network, describe_links, load_of
from deploy.console.data_files import FLEETS


def delta(*sets: str) -> Fleet:
    return load_fleet(FLEETS / "delta.toml", sets)


def test_a_mesh_links_each_to_each() -> None:
    load = load_of(delta())
    assert load.links == 15 + 6
    assert (load.hands, load.beacons, load.own) == pytest.approx((150.0, 25.0, 50.0))
    assert load.heard == pytest.approx(225.0)
    assert load.routed == 0.0
    assert describe_links(delta()) == (
        "a mesh (at most 24 robots): 21 links; a robot hears 150 hand states, 25 beacons, 50 states of its "
        "plant a second"
    )


def test_routers_pass_on_what_robots_and_an_operator_hear() -> None:
    load = load_of(delta('network.topology="routed"'))
    assert load.links == 18
    assert load.routed == pytest.approx(6 * (150 + 25) + 6 * (3 * 50 + 5 + 5))
    assert "routed (network.topology) by a router that `handfast run` starts: 18 links" in describe_links(
        delta('network.topology="routed"')
    )
    assert "routed (network.routers) by a:7447: 18" in describe_links(delta('network.routers=["a:7447"]'))


def test_it_is_said_where_routers_run_and_why() -> None:
    hosts = [f'robot.{k}.host="{name}"' for k, name in enumerate("abcabc", 1)]
    hosts += [f'host.{name}.address="10.0.0.{k}"' for k, name in enumerate("abc", 1)]
    assert describe_links(delta(*hosts, 'network.topology="routed"')).startswith(
        "routed (network.topology) by one on a or one on b, which `handfast up` starts: 18 links"
    )
    assert describe_links(load_fleet(FLEETS / "lattice45.toml", [])).startswith(
        "routed (more than 24 robots) by a router that `handfast run` starts: 135 links"
    )


@pytest.mark.parametrize(
    ("sets", "advice"),
    [
        ((), ""),
        (('network.topology="mesh"',), "leave out network.topology"),
    ],
)
def test_a_large_mesh_is_warned_of(sets: tuple[str, ...], advice: str) -> None:
    found = list(check_network(load_fleet(FLEETS / "lattice45.toml", sets)))
    assert [each.level for each in found] == ["warning"] * bool(advice)
    if advice:
        assert found[0].message.endswith(advice)
        assert "by 990 links" in found[0].message
