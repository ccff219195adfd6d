"""handfast.agent.fleet.model: robots that are real vehicles, `[datum]` and `[robot.mavlink]`."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tomli_w

from handfast.agent.fleet.loading import digest, parse_fleet, to_dict
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.fleet.sections import DatumSection
from tests.unit.agent.fleet.fleet_texts import DATUM, MIXED, ROVERS, problems, small


def test_a_fleet_of_simulated_and_real_robots() -> None:
    fleet = small(text=MIXED)
    assert [robot.plant for robot in fleet.robots] == ["mavlink", "unicycle", "unicycle"]
    assert fleet.robot(3).section(MavlinkSection) == MavlinkSection(connection="udpin:0.0.0.0:14550")
    assert fleet.robot(7).section(MavlinkSection) is None
    assert fleet.datum == DatumSection(-35.363261, 149.165230, 0.0)
    assert small().datum is None


def test_a_vehicle_takes_from_the_defaults_what_it_does_not_say_itself() -> None:
    text = ROVERS + '[robot.mavlink]\nconnection = "/dev/serial/by-id/usb-ArduPilot_1"\nbaud = 57600\n'
    text = text.replace(DATUM, "") + DATUM  # the table is of the last [[robot]]
    fleet = small("robot_defaults.mavlink.state_rate_hz=20", text=text)
    shared = MavlinkSection(connection="simulator", arm=True, state_rate_hz=20.0)
    assert [robot.section(MavlinkSection) for robot in fleet.robots] == [
        shared,
        shared,
        replace(shared, connection="/dev/serial/by-id/usb-ArduPilot_1", baud=57600),
    ]


def test_any_number_of_vehicles_may_be_simulated() -> None:
    sections = [robot.section(MavlinkSection) for robot in small(text=ROVERS).robots]
    assert [section.connection for section in sections if section] == ["simulator"] * 3


@pytest.mark.parametrize(
    ("text", "overrides", "found"),
    [
        (
            MIXED.replace(DATUM, ""),
            [],
            [
                'datum: table [datum] is missing: robots with plant = "mavlink" need it, for example '
                "latitude_deg = -35.363261 and longitude_deg = 149.165230"
            ],
        ),
        (
            MIXED.replace("latitude_deg = -35.363261\n", ""),
            [],
            ["datum.latitude_deg: is missing: write for example latitude_deg = -35.363261"],
        ),
        (
            MIXED,
            ["datum.latitude_deg=91"],
            ["--set datum.latitude_deg: must be between -85 and 85 deg, got 91"],
        ),
        (
            MIXED,
            ["robot.7.plant=mavlink"],
            [
                'robot[2].mavlink.connection: is missing: plant = "mavlink" needs it, for example '
                'connection = "udpin:0.0.0.0:14550" (the robot with id 7)'
            ],
        ),
        (
            MIXED,
            ["robot.7.plant=mavlink", "robot.7.mavlink.arm=true"],
            [
                'robot[2].mavlink.connection: is missing: plant = "mavlink" needs it, for example '
                'connection = "udpin:0.0.0.0:14550" (the robot with id 7)'
            ],
        ),
        (
            MIXED,
            ["robot.7.plant=mavlink", "robot.7.mavlink.connection=udpin:0.0.0.0:14550"],
            [
                '--set robot.7.mavlink.connection: robot[1] has "udpin:0.0.0.0:14550" already: '
                "each robot needs a link of its own"
            ],
        ),
        (
            ROVERS,
            ["robot_defaults.mavlink.connection=/dev/ttyUSB0"],
            [
                'robot[2].mavlink.connection: robot[1] has "/dev/ttyUSB0" already: '
                "each robot needs a link of its own (the robot with id 7)",
                'robot[3].mavlink.connection: robot[1] has "/dev/ttyUSB0" already: '
                "each robot needs a link of its own (the robot with id 5)",
            ],
        ),
        # What is wrong in the defaults is told there alone, and no robot is blamed for it.
        (
            ROVERS.replace('"simulator"', "5"),
            [],
            ['robot_defaults.mavlink.connection: must be a string, such as "udpin:0.0.0.0:14550", got 5'],
        ),
        (
            ROVERS,
            ["robot_defaults.mavlink=5"],
            [
                "--set robot_defaults.mavlink: must be a table: write [robot_defaults.mavlink] and its "
                "fields below it, got 5"
            ],
        ),
        (
            ROVERS,
            ["robot_defaults.plant=mavlnk"],
            [
                '--set robot_defaults.plant: must be one of "unicycle", "mavlink", or a plugin, got "mavlnk"'
                '; did you mean "mavlink"?'
            ],
        ),
        (
            MIXED,
            ["robot.3.mavlink.conection=x"],
            ["--set robot.3.mavlink.conection: unknown field; did you mean connection?"],
        ),
        (
            MIXED,
            ["robot.3.connection=x"],
            [
                "--set robot.3.connection: unknown field; connection belongs in [robot_defaults.mavlink] or "
                "[robot.mavlink]"
            ],
        ),
        (
            MIXED,
            ["mavlink.arm=true"],
            ["--set mavlink.arm: unknown table; mavlink belongs in [robot_defaults] or [robot]"],
        ),
        (
            MIXED,
            ["robot.3.mavlink.system=255"],
            ["--set robot.3.mavlink.system: must be between 1 and 254, got 255"],
        ),
        (
            MIXED,
            ["robot.3.mavlink.state_rate_hz=100"],
            ["--set robot.3.mavlink.state_rate_hz: must be between 5 and 50 Hz, got 100"],
        ),
    ],
)
def test_vehicles_that_are_refused(text: str, overrides: list[str], found: list[str]) -> None:
    assert problems(*overrides, text=text) == found


SHARED = [
    "robot_defaults.mavlink.connection=tcp:10.0.0.1:5760",
    "robot.3.mavlink.system=1",
    "robot.7.mavlink.system=2",
]


def test_a_routers_link_carries_several_vehicles_that_say_which_they_are() -> None:
    fleet = small(*SHARED, "robot.5.mavlink.system=3", text=ROVERS)
    assert [link.system for robot in fleet.robots if (link := robot.section(MavlinkSection))] == [1, 2, 3]
    for other, number in (("robot.5.mavlink.baud=9600", 1), ("robot.5.mavlink.system=2", 2)):
        assert problems(*SHARED, other, text=ROVERS) == [
            f'robot[3].mavlink.connection: robot[{number}] has "tcp:10.0.0.1:5760" already: each robot '
            "needs a link, or a system on it, of its own (the robot with id 5)"
        ]
    assert len(problems(*SHARED, "robot.5.mavlink.system=0", text=ROVERS)) == 1
    own_port = [
        "robot_defaults.mavlink.connection=udpin:0.0.0.0:14550",
        *SHARED[1:],
        "robot.5.mavlink.system=3",
    ]
    assert len(problems(*own_port, text=ROVERS)) == 2


def test_a_simulated_robot_needs_nothing_of_what_a_vehicle_needs() -> None:
    """`[robot_defaults.mavlink]` may stand there for the vehicles among them, also without a connection."""
    fleet = small("robot_defaults.mavlink.arm=true")
    assert fleet.datum is None
    assert {robot.plant for robot in fleet.robots} == {"unicycle"}
    same = "udpin:0.0.0.0:14550"
    small(f"robot_defaults.mavlink.connection={same}", f"robot.7.mavlink.connection={same}")


@pytest.mark.parametrize(
    "connection",
    [
        "simulator", "udpin:0.0.0.0:14550", "udpout:192.168.1.7:14550", "udp:127.0.0.1:1",
        "tcp:rover-1.lan:65535", "tcp:[fd00::7]:5760", "tcp:rover_1:5760",
        "/dev/serial/by-id/usb-ArduPilot_Pixhawk1_36-if00", "/dev/ttyACM0",
    ],
)  # fmt: skip
def test_connections(connection: str) -> None:
    fleet = small(f"robot.3.mavlink.connection={connection}", text=MIXED)
    assert fleet.robot(3).section(MavlinkSection) == MavlinkSection(connection=connection)


@pytest.mark.parametrize(
    "connection",
    [
        "", "simulated", "udpin", "udpin:", "udpin:14550", "udpin:0.0.0.0", "udpin:0.0.0.0:",
        "udpin:0.0.0.0:0", "udpin:0.0.0.0:65536", "udpin:0.0.0.0:99999", "udpin:0.0.0.0:014550",
        "udpin:0.0.0.0:14550 ", "udpin::14550", "udpin:::1:14550", "udpin:a b:14550", "UDPIN:0.0.0.0:14550",
        "tcp://10.0.0.1:5760", "/dev/", "/dev/tty ACM0", "/dev/ttyACM0,57600", "ttyACM0", "COM3",
        "serial:/dev/ttyACM0",
    ],
)  # fmt: skip
def test_connections_that_are_none(connection: str) -> None:
    (found,) = problems(f'robot.3.mavlink.connection="{connection}"', text=MIXED)
    assert found == (
        '--set robot.3.mavlink.connection: must be "simulator", "udpin:HOST:PORT", "udpout:HOST:PORT", '
        '"tcp:HOST:PORT" or a serial port such as "/dev/serial/by-id/usb-ArduPilot...", '
        f'got "{connection}"'
    )


@pytest.mark.parametrize("text", [MIXED, ROVERS])
def test_round_trip_of_vehicles(text: str) -> None:
    fleet = small(
        "robot.3.mavlink.signing_key=~/key", "robot.3.mavlink.system=7", "datum.altitude_m=584", text=text
    )
    table = to_dict(fleet)
    assert parse_fleet(tomli_w.dumps(table), source="again") == fleet
    assert table["datum"] == {"latitude_deg": -35.363261, "longitude_deg": 149.16523, "altitude_m": 584.0}
    assert table["robot"][0]["mavlink"]["system"] == 7
    assert "datum" not in to_dict(small())


def test_the_digest_that_is_remembered_is_that_of_the_same_fleet() -> None:
    one, other = small(), small("fleet.rate_hz=12")
    first = digest(one)
    assert digest(other) != first
    assert [digest(one), digest(small()), digest(one)] == [first] * 3


def test_how_its_own_computer_reaches_a_vehicle_is_no_affair_of_the_others() -> None:
    base = digest(small(text=MIXED))
    for override in ("connection=/dev/ttyACM0", "connection=simulator", "baud=57600", "signing_key=~/key"):
        assert digest(small(f"robot.3.mavlink.{override}", text=MIXED)) == base, override
    for override in (
        "robot.3.mavlink.max_speed_mps=2",
        "robot.3.mavlink.system=7",
        "datum.altitude_m=1",
        "robot.3.plant=unicycle",
    ):
        assert digest(small(override, text=MIXED)) != base, override


@pytest.mark.parametrize(
    ("connection", "shared"),
    [
        ("/dev/serial0", False),
        ("udpin:0.0.0.0:14550", False),
        ("udpout:127.0.0.1:14550", False),
        ("tcp:localhost:5760", False),
        ("tcp:10.0.0.1:5760", True),
        ("udpout:10.0.0.1:14550", True),
    ],
)
def test_what_is_on_a_computer_is_its_own(connection: str, shared: bool) -> None:
    """Two robots on one host may not have one link; on two hosts they may, unless it leads to one place."""
    hosts = [f"[host.{name}]\naddress = '10.0.1.{number}'\n" for number, name in enumerate("abc", 1)]
    text = ROVERS + "".join(hosts)
    linked = [f"robot_defaults.mavlink.connection={connection}"]
    apart = [f"robot.{robot}.host={host}" for robot, host in zip((3, 7, 5), "abc", strict=True)]
    together = [f"robot.{robot}.host={host}" for robot, host in zip((3, 7, 5), "aba", strict=True)]
    if shared:
        assert len(problems(*linked, *apart, text=text)) == 2
        return
    small(*linked, *apart, text=text)
    (found,) = problems(*linked, *together, text=text)
    assert found.startswith(f'robot[3].mavlink.connection: robot[1] has "{connection}" already')
