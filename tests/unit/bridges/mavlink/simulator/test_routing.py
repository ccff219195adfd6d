"""Routing between an autopilot's ports: to whom a message goes, and whether it is the vehicle's own."""

from __future__ import annotations

import pytest

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.routing import PRIVATE, ROUTES_MAX, Routes

COMMAND = 76
"""COMMAND_LONG: a message as any other."""


@pytest.fixture
def routes() -> Routes:
    """Vehicle 1 with a bridge (1, 191) at port 0, a station (255, 190) at 1 and vehicle 2 at 2."""
    made = Routes(1)
    for port, system, component in ((0, 1, 191), (1, 255, 190), (2, 2, 1)):
        made.learn(port, system, component)
    return made


def test_a_heartbeat_goes_to_every_port_where_its_sender_was_not_heard(routes: Routes) -> None:
    assert routes.of_heartbeat(4, 0, 1, 191) == [1, 2, 3]
    routes.learn(3, 1, 191)
    assert routes.of_heartbeat(4, 0, 1, 191) == [1, 2]


@pytest.mark.parametrize(
    ("port", "system", "component", "to"),
    [
        (0, 1, 1, ([], True)),  # the vehicle itself
        (0, 255, 190, ([1], False)),
        (1, 255, 190, ([], False)),  # not back to where it came from
        (0, 2, 1, ([2], False)),
        (0, 2, 0, ([2], False)),
        (0, 2, 99, ([2], False)),  # some component of a vehicle whose system is there
        (1, 1, 191, ([0], False)),
        (1, 1, 0, ([0], True)),
        (1, 1, 99, ([], True)),  # of this vehicle, and nowhere heard
        (0, 0, 0, ([1, 2], True)),
        (0, 9, 1, ([], False)),
    ],
)
def test_where_a_message_goes(
    routes: Routes, port: int, system: int, component: int, to: tuple[list[int], bool]
) -> None:
    assert routes.of_message(COMMAND, port, system, component) == to


def test_what_is_between_a_radio_and_the_vehicle_stays_there(routes: Routes) -> None:
    for message in PRIVATE:
        assert routes.of_message(message, 0, 0, 0) == ([], True)


def test_neither_itself_nor_nobody_is_a_route() -> None:
    routes = Routes(1)
    routes.learn(0, 1, constants.COMPONENT_AUTOPILOT)
    routes.learn(0, 0, 5)
    assert routes.of_message(COMMAND, 1, 0, 0) == ([], True)


def test_of_many_the_newest_are_kept() -> None:
    routes = Routes(1)
    for system in range(2, 2 + ROUTES_MAX + 1):
        routes.learn(0, system, 1)
        routes.learn(0, system, 1)
    assert routes.of_message(COMMAND, 1, 2, 1) == ([], False)
    assert routes.of_message(COMMAND, 1, 3, 1) == ([0], False)
