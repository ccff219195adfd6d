"""What `handfast check` finds wrong with real vehicles, and how it describes them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.deploy.check.check import check
from handfast.deploy.check.description import describe
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.vehicles import check_vehicles
from handfast.deploy.console.data_files import FLEETS


def rovers(*overrides: str) -> Fleet:
    return load_fleet(FLEETS / "rovers.toml", overrides)


def of_vehicles(fleet: Fleet) -> list[Finding]:
    return check_vehicles(fleet, resolve(fleet))


def found(*overrides: str) -> dict[str, Finding]:
    findings = [each for each in of_vehicles(rovers(*overrides)) if each.level != "info"]
    assert len({finding.place for finding in findings}) == len(findings)
    return {finding.place: finding for finding in findings}


def test_the_bundled_fleet_is_sound() -> None:
    rolls = ("info", "control.max_speed_mps")
    assert [(each.level, each.place) for each in of_vehicles(rovers())] == [rolls]
    # Far from their places robots ask for more than they have, and all of it is used.
    asks = ("info", "control.max_acceleration")
    assert {(each.level, each.place) for each in check(rovers())} == {rolls, asks}
    assert of_vehicles(load_fleet(FLEETS / "delta.toml")) == []
    # What a robot has of the table for all, and is none.
    mixed = of_vehicles(rovers("robot.6.plant=unicycle", "robot.6.mavlink.arm=true"))
    assert [(each.level, each.place) for each in mixed] == [rolls]


def test_how_far_one_rolls_that_nothing_commands_is_said_where_others_are_nearer() -> None:
    (rolls,) = of_vehicles(rovers())
    assert "goes on for 3 s by itself, up to 3.3 m at 0.9 m/s" in rolls.message
    said = "nearer than 5.3 m, and drives at it as fast, may not get out of it in time, and edges are 3 m"
    assert said in rolls.message
    assert found("control.max_speed_mps=0.5", "formation.safe_distance_m=1.0") == {}
    fleet = rovers()
    by_offsets = replace(fleet, formation=replace(fleet.formation, distance_m=None))
    assert of_vehicles(by_offsets) == [rolls], "though the file leaves the lengths to the places"


@pytest.mark.parametrize(
    ("override", "place", "words"),
    [
        ("robot.3.mavlink.connection=/dev/ttyACM0", "robot[3].mavlink.connection", "/dev/serial/by-id/"),
        ("robot.3.mavlink.connection=udpin:0.0.0.0:14550", "robot[3].mavlink.signing_key", "robot 3"),
        ("robot.2.mavlink.arm=true", "robot[2].mavlink.arm", "robot 2"),
        ("fleet.rate_hz=60", "fleet.rate_hz", "60 Hz"),
        ("control.plant_timeout_s=0.2", "control.plant_timeout_s", "0.2 s"),
        ("control.wrench_timeout_s=0.4", "control.wrench_timeout_s", "0.4 s"),
        ("control.max_acceleration=0.9", "control.max_acceleration", "0.9 m/s2"),
        ("robot.4.mavlink.max_acceleration=0.5", "control.max_acceleration", "robot 4, 0.5 m/s2"),
        ("robot_defaults.mavlink.max_speed_mps=0.4", "robot[1].mavlink.max_speed_mps", "0.32 m/s"),
        ("formation.safe_distance_m=0.7", "formation.safe_distance_m", "0.8 m"),
        ("robot.5.hand_offset_m=0.1", "robot[5].hand_offset_m", "robot 5"),
        ("robot.6.inertia_kgm2=0.01", "robot[6].inertia_kgm2", "robot 6"),
        ("robot_defaults.inertia_kgm2=200", "robot[1].inertia_kgm2", "robots 1, 2, 3, 4, 5 and 6"),
        ("robot.1.heading_noise_rad=0.1", "robot[1].position_noise_m", "on purpose"),
    ],
)
def test_each_thing_that_is_unwise_is_a_warning(override: str, place: str, words: str) -> None:
    findings = found(override)
    assert findings[place].level == "warning"
    assert words in findings[place].message
    # A connection to the outside also asks whether the datum is meant.
    assert set(findings) - {"datum"} == {place}


@pytest.mark.parametrize(
    "override",
    [
        "robot.3.mavlink.connection=/dev/serial/by-id/usb-ArduPilot-if00",
        "robot.3.mavlink.connection=tcp:127.0.0.1:5760",
        "fleet.rate_hz=50",
        "control.plant_timeout_s=0.3",
        "control.wrench_timeout_s=0.25",
        "control.max_acceleration=0.8",
        "robot_defaults.mavlink.max_speed_mps=0.45",
        "formation.safe_distance_m=0.8",
        "robot.5.hand_offset_m=0.2",
    ],
)
def test_what_is_just_wise_enough_is_not(override: str) -> None:
    assert set(found(override)) - {"datum"} == set()


def test_signed_links_are_fine() -> None:
    key = "robot.3.mavlink.signing_key=/tmp/key"
    assert set(found("robot.3.mavlink.connection=udpin:0.0.0.0:14550", key)) == {"datum"}


def test_a_simulated_rover_cannot_have_a_key() -> None:
    assert found("robot.3.mavlink.signing_key=/tmp/key")["robot[3].mavlink.signing_key"].level == "error"


def test_the_simulators_datum_with_vehicles_outside_is_asked_about() -> None:
    serial = "robot.3.mavlink.connection=/dev/serial/by-id/x"
    assert found(serial)["datum"].level == "warning"
    assert "datum" not in found(serial, "datum.latitude_deg=48.1")
    assert "datum" not in found("robot.3.mavlink.connection=tcp:127.0.0.1:5760")


def test_a_trajectory_faster_than_a_vehicle_is_an_error() -> None:
    findings = found("robot.2.mavlink.max_speed_mps=0.3")
    assert findings["robot[2].mavlink.max_speed_mps"].level == "error"


def test_two_vehicles_that_are_waited_for_on_one_port_are_an_error() -> None:
    fleet = rovers(
        "robot.3.mavlink.connection=udpin:0.0.0.0:14550", "robot.5.mavlink.connection=udpin:10.0.0.1:14550"
    )
    (finding,) = [finding for finding in of_vehicles(fleet) if finding.level == "error"]
    assert (finding.place, "robot 3" in finding.message) == ("robot[5].mavlink.connection", True)


def test_two_vehicles_of_one_system_id_are_a_warning() -> None:
    second, third = (f"robot.{k}.mavlink.connection=tcp:10.0.0.{k}:5760" for k in (2, 3))
    place = "robot[3].mavlink.system"
    same = found(second, third, "robot.2.mavlink.system=7", "robot.3.mavlink.system=7")
    assert same[place].level == "warning"
    assert same[place].message.startswith("is 7, as that of robot 2: ")
    assert place not in found(second, third, "robot.2.mavlink.system=7", "robot.3.mavlink.system=8")
    assert place not in found(second, third)


def test_vehicles_and_datum_are_described() -> None:
    text = describe(rovers())
    assert "datum: x = 0, y = 0 is at -35.3632610, 149.1652300, 584 m above the sea" in text
    assert "vehicles: robots 1, 2, 3, 4, 5 and 6, ArduPilot Rovers that are simulated on this machine" in text
    assert "arming" not in text, "whoever starts simulated rovers has them handed over"
    text = describe(rovers(*(f"robot.{k}.mavlink.connection=udpin:0.0.0.0:1455{k}" for k in (1, 2))))
    assert "arming of robots 1 and 2: their operators put them into GUIDED and arm them" in text
    text = describe(
        rovers(
            "robot.3.mavlink.connection=/dev/serial/by-id/x",
            "robot.3.mavlink.arm=true",
            "robot.3.mavlink.signing_key=/tmp/key",
        )
    )
    assert "vehicle: robot 3, an ArduPilot Rover on /dev/serial/by-id/x at 115200 baud, signed" in text
    assert "arming of robot 3: its bridge puts it into GUIDED and arms it, by itself" in text
    assert "datum" not in describe(load_fleet(FLEETS / "pair.toml"))
