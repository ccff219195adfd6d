"""What a network carries, in each topology."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.check.network import check_network, describe_links, describe_topology, load_of
from handfast.deploy.console.data_files import FLEETS


def delta(*sets: str) -> Fleet:
    return load_fleet(FLEETS / "delta.toml", sets)


def test_a_mesh_links_each_to_each() -> None:
    load = load_of(delta())
    assert load.links == 15 + 6
    assert (load.hands, load.beacons, load.own) == pytest.approx((150.0, 25.0, 50.0))
    assert load.alone == pytest.approx(225.0)
    assert load.recorded == pytest.approx(6 * (3 * 50 + 5 + 5))
    assert load.routed == 0.0
    assert describe_links(delta()) == (
        "a mesh: 21 links; a robot hears 150 hand states, 25 beacons, 50 states of its plant a second"
    )


def test_of_hand_states_that_are_sent_when_they_are_news_it_says_when_there_are_so_many() -> None:
    text = describe_links(delta('control.send="event"'))
    assert "a robot hears 150 hand states while it settles, few then, 25 beacons" in text


def test_routers_pass_on_what_robots_and_an_operator_hear() -> None:
    load = load_of(delta('network.topology="routed"'))
    assert load.links == 18
    assert load.routed == pytest.approx(6 * (150 + 25) + 6 * (3 * 50 + 5 + 5))
    assert "routed by a router that `handfast run` starts: 18 links" in describe_links(
        delta('network.topology="routed"')
    )
    assert "routed by a:7447: 18" in describe_links(delta('network.routers=["a:7447"]'))


def test_of_many_robots_that_are_routed_what_all_hear_comes_in_batches() -> None:
    large = ('network.topology="routed"', "avoidance.beacon_interval_max_s=1")
    load = load_of(delta(*large))
    assert (load.hands, load.beacons) == pytest.approx((150.0, 5.0))
    assert (load.batches, load.batched) == pytest.approx((6.0, 5.0)), "a batch a second for each robot"
    assert load.alone == pytest.approx(200.0)
    assert load.routed == pytest.approx(6 * (150 + 6) + 6 + load.recorded)
    assert "5 beacons, 50 states of its plant a second (beacons in 6 batches), routers" in describe_links(
        delta(*large)
    )
    lattice = load_fleet(FLEETS / "lattice45.toml")
    crowd = load_of(lattice)
    assert crowd.batches == pytest.approx(2 * lattice.fleet.rate_hz), "two a round"
    assert crowd.alone == pytest.approx(crowd.own)
    assert " (both in 40 batches)" in describe_links(lattice)
    twice = load_of(lattice, 90)
    assert twice.batches == crowd.batches
    assert twice.beacons == pytest.approx(crowd.beacons * 89 / 44)


HOSTS = [f'robot.{k}.host="{name}"' for k, name in enumerate("abcabc", 1)]
HOSTS += [f'host.{name}.address="10.0.0.{k}"' for k, name in enumerate("abc", 1)]


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ([], "a mesh, for at most 24 robots"),
        (HOSTS, "a mesh, for at most 24 robots"),
        (['network.topology="mesh"'], "a mesh, as network.topology says"),
        (['network.topology="routed"'], "routed, as network.topology says"),
        (['network.routers=["a:7447"]'], "routed, as network.routers names some"),
        (
            [*HOSTS, 'network.topology="routed"'],
            "routed, as network.topology says; `handfast up` starts routers on a and b",
        ),
        (
            [*HOSTS, 'network.routers=["c", "d:7447"]'],
            "routed, as network.routers names some; `handfast up` starts routers on c",
        ),
    ],
)
def test_it_is_said_which_topology_it_is_and_why(sets: list[str], said: str) -> None:
    assert describe_topology(delta(*sets)) == said


def test_large_fleets_are_routed() -> None:
    assert describe_topology(load_fleet(FLEETS / "lattice45.toml", [])) == "routed, for more than 24 robots"
    assert "routed by a or b: 18 links" in describe_links(delta(*HOSTS, 'network.topology="routed"'))


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
        assert "linked each to each" in found[0].message
