"""A fleet on this machine: ports, and where simulated rovers stand."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
import tomli_w

from handfast.agent.fleet.loading import load_fleet, parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, geodetic_to_world
from handfast.bridges.mavlink.simulator.settings import parse_home
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.processes import placement
from handfast.deploy.processes.placement import held_orders, orders_folder, place, vehicle


@pytest.fixture
def rovers() -> Fleet:
    return load_fleet(FLEETS / "rovers.toml", ["robot.2.mavlink.connection=tcp:10.0.0.5:5760"])


def options(fleet: Fleet, robot: int) -> dict[str, str]:
    told = vehicle(fleet, robot, 7777).arguments
    return dict(each.removeprefix("--").partition("=")[::2] for each in told)


def test_bridges_and_rovers_meet_on_ports_behind_those_of_the_fleet(rovers: Fleet) -> None:
    placed, taken, vehicles = place(rovers)
    taken.close()
    base = placed.network.base_port
    sections = [robot.section(MavlinkSection) for robot in placed.robots]
    links = [section.connection for section in sections if section is not None]
    first = base + 2 * 6
    assert links == [
        f"udpin:127.0.0.1:{first}",
        "tcp:10.0.0.5:5760",
        *(f"udpin:127.0.0.1:{first + k}" for k in range(1, 5)),
    ]
    assert [each.robot for each in vehicles] == [1, 3, 4, 5, 6], "none for a real vehicle"
    for each, link in zip(vehicles, [links[0], *links[2:]], strict=True):
        assert f"--connect={str(link).replace('udpin', 'udp')}" in each.arguments
        assert each.ground_station == str(link).replace("udpin", "tcp")
        assert f"--listen={each.ground_station}" in each.arguments
    assert str(vehicles[1]) == (
        f"robot 3's simulated rover: ground stations connect to tcp:127.0.0.1:{first + 1}"
    )


@pytest.mark.parametrize(
    ("sets", "routers"),
    [
        ((), 0),
        (('network.topology="routed"',), 1),
        (('network.routers=["10.0.0.1:7447", "10.0.0.2:7447"]',), 2),
    ],
)
def test_a_routed_fleet_has_as_many_routers_here_as_its_file_names(sets: list[str], routers: int) -> None:
    placed, taken, _ = place(load_fleet(FLEETS / "pair.toml", sets))
    taken.close()
    first = placed.network.base_port + 4
    assert placed.network.routers == tuple(f"127.0.0.1:{first + k}" for k in range(routers))
    assert placed.is_routed == (routers > 0)
    assert parse_fleet(tomli_w.dumps(to_dict(placed)), source="placed").is_routed == (routers > 0)


@pytest.mark.parametrize("heading_deg", ["0", "90", "-135", "30"])
def test_a_rover_starts_where_its_robot_does(heading_deg: str) -> None:
    fleet = load_fleet(FLEETS / "rovers.toml", [f"robot.4.heading_rad={heading_deg}deg"])
    home, yaw = parse_home(options(fleet, 4)["home"])
    assert fleet.datum is not None
    datum = Geodetic(fleet.datum.latitude_deg, fleet.datum.longitude_deg, fleet.datum.altitude_m)
    assert geodetic_to_world(datum, home) == pytest.approx((3.0, 6.0), abs=1e-3)
    assert home.altitude_m == 584.0
    # A compass counts clockwise from north.
    compass = (90.0 - float(heading_deg)) % 360.0
    assert yaw * 57.29577951308232 % 360.0 == pytest.approx(compass, abs=1e-4)


def test_a_port_that_only_udp_uses_is_not_free() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        number = other.getsockname()[1]
        assert not placement._free("127.0.0.1", number)
    assert placement._free("127.0.0.1", number)


def test_orders_of_a_run_that_was_killed_are_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(placement, "private_folder", lambda: tmp_path)
    pair, delta = (load_fleet(FLEETS / f"{name}.toml") for name in ("pair", "delta"))
    left = tmp_path / "orders-0123456789abcdef"
    left.mkdir()
    (left / "stop.json").write_text("{}")
    with held_orders(pair):
        assert not left.exists()
        (orders_folder(pair) / "stop.json").write_text("{}")
        with held_orders(delta):
            assert sorted(tmp_path.iterdir()) == sorted((orders_folder(pair), orders_folder(delta)))
        assert list(orders_folder(pair).iterdir()), "it lives"
    assert list(tmp_path.iterdir()) == []
