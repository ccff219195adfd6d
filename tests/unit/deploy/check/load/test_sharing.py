"""Which simulated bodies share a process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.analysis.shapes import lattice as grid
from handfast.deploy.check.network import sharing


def lattice(n: int, rate_hz: float, *overrides: str) -> Fleet:
    fleet = parse_fleet(grid(f"grid{n}", n, rate_hz=rate_hz), source="here", overrides=overrides)
    network = replace(fleet.network, routers=("127.0.0.1:9000",))  # which placement gives it
    return replace(fleet, network=network)


RULE = "faults.rule=[{%s}]"


@pytest.mark.parametrize(
    ("fleet", "shared"),
    [
        (lattice(24, 10.0), []),
        (lattice(25, 10.0), [range(1, 26)]),
        (lattice(100, 10.0), [range(1, 51), range(51, 101)]),
        (lattice(110, 10.0), [range(1, 38), range(38, 75), range(75, 111)]),
        (lattice(100, 4.0), [range(1, 101)]),
        (lattice(30, 10.0, RULE % "name='a',robot=7,kill='plant',at=1"), [[*range(1, 7), *range(8, 31)]]),
        (lattice(30, 10.0, RULE % "name='a',robot=7,kill='agent',at=1"), [range(1, 31)]),
        (lattice(30, 10.0, RULE % "name='a',robot=7,clock_skew=0.1"), [[*range(1, 7), *range(8, 31)]]),
        (lattice(30, 10.0, RULE % "name='a',clock_skew='0s 1000ppm'"), []),
        (lattice(30, 10.0, "robot.3.plant=handfast.plant.backend:Plant"), [[1, 2, *range(4, 31)]]),
    ],
)
def test_bodies_share_a_process_in_a_large_fleet_where_nothing_is_done_to_it(
    fleet: Fleet, shared: list[Sequence[int]]
) -> None:
    assert sharing(fleet) == [tuple(part) for part in shared]


def test_in_a_large_fleet_without_a_router_none_do() -> None:
    fleet = lattice(30, 10.0)
    assert sharing(fleet)
    assert sharing(replace(fleet, network=replace(fleet.network, topology="mesh"))) == []
