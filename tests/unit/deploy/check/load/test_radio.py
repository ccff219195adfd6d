"""What `check` says of the messages that a radio carries, against the bytes of a simulated drive."""

from __future__ import annotations

from collections import Counter

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.messages import key_expressions
from handfast.deploy.check.description import describe
from handfast.deploy.check.network import beacon_hz, hand_bytes, listeners, neighbours, radio_loads
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Simulation


def test_description_names_the_busiest_radio() -> None:
    (line,) = (line for line in describe(load_fleet(FLEETS / "delta.toml")).splitlines() if "radio:" in line)
    assert line.startswith("  radio: robot ")
    assert "kbit/s" in line


def test_in_a_pair_both_robots_send_what_the_other_receives() -> None:
    fleet = load_fleet(FLEETS / "pair.toml", ["fleet.rate_hz=20"])
    (_, up, down), (_, other_up, other_down) = radio_loads(fleet, resolve(fleet))
    assert (up, down) == pytest.approx((other_down, other_up))
    hand = hand_bytes(fleet, {2}, {2})
    # A hand state with its headers and an acknowledgement each tick, and a beacon now and then.
    assert 8 * 20 * (hand + 64 + 39) < up < 8 * (20 * (hand + 64 + 39) + beacon_hz(fleet) * 150)
    secured = load_fleet(FLEETS / "pair.toml", ["fleet.rate_hz=20", 'network.security="mtls"'])
    assert radio_loads(secured, resolve(secured))[0][1] == pytest.approx(up + 8 * 20 * 22)


def test_a_router_takes_one_copy_where_a_mesh_takes_one_for_each_listener() -> None:
    mesh, routed = (
        load_fleet(FLEETS / "delta.toml", [f'network.topology="{topology}"'])
        for topology in ("mesh", "routed")
    )
    for (_, up, down), (_, routed_up, routed_down) in zip(
        radio_loads(mesh, resolve(mesh)), radio_loads(routed, resolve(routed)), strict=True
    ):
        assert routed_up < 0.7 * up
        assert routed_down < down, "it acknowledges fewer packets"


@pytest.mark.parametrize("name", ["delta", "rovers"])
def test_hand_states_are_as_large_as_those_of_a_drive(name: str) -> None:
    fleet = resolved(load_fleet(FLEETS / f"{name}.toml", ["fleet.duration_s=5"]))
    geometry = resolve(fleet)
    total: Counter[str] = Counter()
    count: Counter[str] = Counter()

    def sink(time_ns: int, key: str, payload: bytes) -> None:
        if time_ns > 3 * NS_PER_S:
            total[key] += len(payload)
            count[key] += 1

    Simulation(fleet, sink).run(lambda _: True)
    joined, near = neighbours(fleet, geometry), listeners(fleet, geometry)
    for robot in fleet.ids:
        key = key_expressions.hand(fleet.fleet.name, robot)
        # Stamps of virtual time begin at 0 and are shorter.
        assert total[key] / count[key] == pytest.approx(
            hand_bytes(fleet, joined[robot], near[robot]), rel=0.2
        )
