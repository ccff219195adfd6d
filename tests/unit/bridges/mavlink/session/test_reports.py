"""Participants of a link: who is another bridge, who has gone, how many are kept."""

from __future__ import annotations

import pytest

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.session.reports import HEARD_NS, KEPT, Participant, Participants

OWN = (1, constants.COMPONENT_ONBOARD_COMPUTER)
VEHICLE = 1
CONTROLLER = constants.TYPE_ONBOARD_CONTROLLER


def with_one(system: int, component: int, kind: int, *, vehicle: bool = False) -> Participants:
    participants = Participants()
    participants.heard(Participant(system, component, kind, 0), vehicle=vehicle)
    return participants


@pytest.mark.parametrize(
    ("system", "component", "kind", "said"),
    [
        (1, 191, CONTROLLER, "bridge's own identity"),
        (1, 191, constants.TYPE_GCS, "bridge's own identity"),
        (1, 192, CONTROLLER, "another onboard controller is on this vehicle (system 1, component 192)"),
        (1, 194, CONTROLLER, "another onboard controller"),
        (1, 195, CONTROLLER, "another onboard controller"),
        (1, 240, CONTROLLER, "another onboard controller"),  # MAVROS
        (1, 158, CONTROLLER, ""),  # a peripheral
        (2, 192, CONTROLLER, ""),  # that of another vehicle
        (1, 192, constants.TYPE_GCS, ""),
        (255, 190, constants.TYPE_GCS, ""),
    ],
)
def test_who_is_another_bridge(system: int, component: int, kind: int, said: str) -> None:
    found = with_one(system, component, kind).another_bridge(HEARD_NS, OWN, VEHICLE)
    assert said in found
    assert bool(said) == bool(found)


def test_who_is_silent_is_gone_but_a_stranger_is_remembered() -> None:
    assert with_one(*OWN, CONTROLLER).another_bridge(HEARD_NS + 1, OWN, VEHICLE) == ""
    station = with_one(255, 190, constants.TYPE_GCS)
    assert [p.system for p in station.ground_stations(HEARD_NS)] == [255]
    assert station.ground_stations(HEARD_NS + 1) == []
    other = with_one(7, 1, constants.TYPE_QUADROTOR, vehicle=True)
    assert [p.system for p in other.vehicles(HEARD_NS)] == [7]
    assert other.vehicles(HEARD_NS + 1) == []
    assert other.strangers() == {7: constants.TYPE_QUADROTOR}
    other.clear()
    assert other.strangers() == {}


def test_a_vehicle_is_no_ground_station_and_no_bridge() -> None:
    participants = with_one(*OWN, CONTROLLER, vehicle=True)
    assert participants.another_bridge(0, OWN, VEHICLE) == ""
    assert with_one(9, 1, constants.TYPE_GCS, vehicle=True).ground_stations(0) == []
    assert with_one(255, 190, constants.TYPE_GCS).strangers() == {}


def test_their_number_is_bounded_and_those_that_went_silent_make_room() -> None:
    participants = Participants()
    for system in range(1, KEPT + 2):
        participants.heard(Participant(system, 190, constants.TYPE_GCS, 0), vehicle=False)
    assert [p.system for p in participants.ground_stations(0)] == list(range(1, KEPT + 1))
    participants.heard(Participant(1, 190, constants.TYPE_GCS, 1), vehicle=False)
    assert len(participants.ground_stations(0)) == KEPT
    participants.heard(Participant(200, 190, constants.TYPE_GCS, HEARD_NS + 1), vehicle=False)
    assert [p.system for p in participants.ground_stations(HEARD_NS + 1)] == [1, 200]
