"""What a radio carries: by hand for small fleets, and the sizes of messages against a simulated drive."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from statistics import mean

import pytest

from agent.common.time import NS_PER_S
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve, resolved
from agent.links.wire_size import acknowledged_bytes, carried_bytes, joined_bytes, keep_alive_bytes
from agent.messages import key_expressions
from deploy.check.load import radio_load
from deploy.check.load.radio_load import RadioLoad, kbit, listeners, neighbours, radio_loads, worst_load
from deploy.console.data_files import FLEETS
from deploy.simulate.simulation import Simulation

HAND, BEACON = 200.0, 100


def fleet(name: str = "delta", *sets: str) -> Fleet:
    return resolved(load_fleet(FLEETS / f"{name}.toml", ["fleet.rate_hz=20", *sets]))


def loads(there: Fleet, **more: bool) -> dict[int, RadioLoad]:
    return {load.robot: load for load in radio_loads(there, resolve(there), **more)}


@pytest.fixture
def known_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(radio_load, "_hand_bytes", lambda *_: HAND)
    monkeypatch.setattr(radio_load, "_beacon_bytes", lambda *_: BEACON)


@pytest.mark.usefixtures("known_sizes")
def test_in_a_mesh_each_listener_has_a_copy_of_its_own() -> None:
    there = fleet("pair", "avoidance.beacon_hz=4")
    hand, beacon = 20 * carried_bytes(HAND, False), 4 * joined_bytes(BEACON)
    way = 8.0 * (hand + beacon + 20 * acknowledged_bytes(HAND, False))
    for load in loads(there).values():
        assert (load.up, load.down) == pytest.approx((way, way))
    secured = loads(fleet("pair", "avoidance.beacon_hz=4", 'network.security="mtls"'))
    assert secured[1].up == pytest.approx(way + 8.0 * 20 * 22)


@pytest.mark.usefixtures("known_sizes")
def test_to_a_router_one_copy_goes_and_it_passes_on_one_from_each() -> None:
    there = fleet("delta", 'network.topology="routed"', "avoidance.beacon_hz=4")
    near = listeners(there, resolve(there))
    for robot, load in loads(there).items():
        n = len(near[robot])
        up = 20 * carried_bytes(HAND, False) + 4 * joined_bytes(BEACON)
        down = n * (20 * carried_bytes(HAND, False) + 4 * joined_bytes(BEACON))
        down += (5 - n) * 4 * carried_bytes(BEACON, False)
        assert load.up == pytest.approx(
            8.0
            * (
                up
                + n * 20 * acknowledged_bytes(HAND, False)
                + (5 - n) * 4 * acknowledged_bytes(BEACON, False)
            )
        )
        assert load.down == pytest.approx(8.0 * (down + 20 * acknowledged_bytes(HAND, False)))


@pytest.mark.usefixtures("known_sizes")
def test_an_idle_link_of_a_mesh_carries_signs_of_life() -> None:
    often, seldom = (loads(fleet("delta", f"avoidance.beacon_hz={hz}"))[1] for hz in (4, 1))
    there = fleet()
    far = 5 - len(listeners(there, resolve(there))[1])
    assert far > 0
    signs = 2 * far * (keep_alive_bytes(False) + acknowledged_bytes(0.0, False))
    beacons = 3 * ((5 - far) * joined_bytes(BEACON))
    beacons += 3 * far * (carried_bytes(BEACON, False) + acknowledged_bytes(BEACON, False))
    assert often.up - seldom.up == pytest.approx(8.0 * (beacons - signs))


def test_robots_listen_to_their_neighbours_and_to_who_is_near() -> None:
    there = fleet()
    geometry = resolve(there)
    assert listeners(there, geometry) == neighbours(there, geometry), "in the delta nobody else is"
    assert neighbours(there, geometry)[1] == {2, 3}
    far_sighted = fleet("delta", "avoidance.sensing_m=100")
    assert all(len(near) == 5 for near in listeners(far_sighted, geometry).values())
    blind = fleet("delta", "avoidance.sensing_m=100", "avoidance.enabled=false")
    assert listeners(blind, geometry) == neighbours(there, geometry)


@pytest.mark.parametrize("topology", ["mesh", "routed"])
def test_an_operator_who_listens_to_all_costs_more_where_bodies_measure_with_noise(topology: str) -> None:
    sets = (f'network.topology="{topology}"', "robot.1.position_noise_m=0.01")
    alone, watched = loads(fleet("delta", *sets)), loads(fleet("delta", *sets), operator=True)
    more = {robot: watched[robot].up - alone[robot].up for robot in alone}
    assert more[1] > 1.1 * more[4], "it says where its body really is as well"
    assert all(watched[robot].down > alone[robot].down for robot in alone), "what is acknowledged"


def test_beacons_grow_while_robots_are_silent() -> None:
    there = fleet("lattice45")
    assert (
        worst_load(there, resolve(there), silences=True).most > 3.0 * worst_load(there, resolve(there)).most
    )
    alone = fleet("pair")
    assert worst_load(alone, resolve(alone), silences=True) == worst_load(alone, resolve(alone))


def test_a_robot_alone_says_nothing_to_anybody() -> None:
    there = fleet("pair")
    alone = replace(
        there,
        robots=there.robots[:1],
        formation=replace(there.formation, edges=(), offsets=((0.0, 0.0),), distance_m=()),
    )
    assert loads(alone)[1] == (1, 0.0, 0.0, False)
    assert loads(alone, operator=True)[1].up > 0.0


@pytest.mark.parametrize("name", ["delta", "obstacles", "rovers"])
def test_messages_are_as_large_as_those_of_a_drive(name: str) -> None:
    there = fleet(name, "fleet.duration_s=12")
    sizes: dict[str, list[int]] = defaultdict(list)
    geometry = resolve(there)

    def sink(time_ns: int, key: str, payload: bytes) -> None:
        if time_ns > 9 * NS_PER_S:
            sizes[key].append(len(payload))

    Simulation(there, sink).run(lambda _: True)
    joined, near = neighbours(there, geometry), listeners(there, geometry)
    assert there.ids
    for robot in there.ids[:8]:
        said = {
            key_expressions.hand: radio_load._hand_bytes(there, robot, joined[robot], near[robot]),
            key_expressions.beacon: radio_load._beacon_bytes(there, 0),
            key_expressions.plant_state: radio_load._size(radio_load._plant_state(there, robot)),
            key_expressions.status: radio_load._status_bytes(there, robot, joined[robot]),
        }
        for key, size in said.items():
            real = mean(sizes[key(there.fleet.name, robot)])
            # Virtual time begins at 0: stamps of a real drive are some bytes longer, statuses tell of ticks.
            assert real < 1.08 * size, (key.__name__, robot, size, real)
            assert size < (1.45 if key is key_expressions.status else 1.25) * real, (
                key.__name__,
                robot,
                size,
                real,
            )


def test_rates_are_said_in_three_digits() -> None:
    assert [kbit(each) for each in (999.0, 250e3, 999_400.0, 1e6, 2.6218e6)] == [
        "0.999 kbit/s", "250 kbit/s", "999 kbit/s", "1 Mbit/s", "2.622 Mbit/s",
    ]  # fmt: skip
    assert str(RadioLoad(3, 1e5, 2e5)) == "robot 3 sends 100 kbit/s and receives 200 kbit/s"
    assert RadioLoad(3, 1e5, 2e5).most == 2e5


def test_at_the_start_others_may_be_near() -> None:
    there = fleet()
    geometry = resolve(there)
    at_start, in_place = (listeners(there, geometry, at_start=each) for each in (True, False))
    assert all(at_start[robot] >= in_place[robot] for robot in there.ids)
    assert sum(map(len, at_start.values())) > sum(map(len, in_place.values()))
    worst = worst_load(there, geometry)
    assert worst.at_start
    assert worst.most == max(load.most for load in radio_loads(there, geometry, at_start=True))
    assert worst.most > max(load.most for load in radio_loads(there, geometry))
    assert str(worst).endswith(" at the start")
