"""agent.fleet: the fleet file, its checks across fields, and what a robot asks of it."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w

from agent.fleet import FILE_BYTES_MAX, Fleet, FleetError, digest, law_name, load_fleet, parse_fleet, to_dict
from agent.fleet_sections import LAWS, ControlSection, DatumSection, MavlinkSection
from deploy import fleet_reference

DEPLOY = Path(__file__).parents[2] / "deploy"
BUNDLED = sorted((DEPLOY / "fleets").glob("*.toml"))

SMALL = """
[fleet]
name = "small"

[formation]
edges = [[3, 7], [7, 5]]
distance_m = 1.0
safe_distance_m = 0.2
offsets = [[0, 0], [1, 0], [2, 0]]

[robot_defaults]
mass_kg = 8

[[robot]]
id = 3
x_m = 0
y_m = 0

[[robot]]
id = 7
x_m = 1
y_m = 0
mass_kg = 9

[[robot]]
id = 5
x_m = 2
y_m = 0
"""


def small(*overrides: str, law: str | None = None, text: str = SMALL) -> Fleet:
    return parse_fleet(text, source="small.toml", overrides=overrides, law=law)


def problems(*overrides: str, law: str | None = None, text: str = SMALL) -> list[str]:
    with pytest.raises(FleetError) as caught:
        small(*overrides, law=law, text=text)
    return [str(problem) for problem in caught.value.problems]


def test_the_small_fleet() -> None:
    fleet = small()
    assert fleet.ids == (3, 7, 5)
    assert fleet.formation.edges == ((3, 7), (7, 5))
    assert [robot.mass_kg for robot in fleet.robots] == [8.0, 9.0, 8.0]
    assert fleet.control == ControlSection()
    assert fleet.trajectory.kind == "hold"


def test_what_a_robot_asks() -> None:
    fleet = small("network.base_port=9000", "network.address=robots.example", "fleet.rate_hz=30")
    assert fleet.period_ns == 33_333_333
    assert fleet.robot(7).mass_kg == 9.0
    assert fleet.index(5) == 2
    assert fleet.neighbours(7) == (3, 5), "ascending, whichever end of the edge it is"
    assert fleet.neighbours(5) == (7,)
    assert [fleet.degree(robot) for robot in fleet.ids] == [1, 2, 1]
    assert fleet.agent_endpoint(3) == "tcp/robots.example:9000"
    assert fleet.plant_endpoint(5) == "tcp/robots.example:9005"
    endpoints = {f(robot) for robot in fleet.ids for f in (fleet.agent_endpoint, fleet.plant_endpoint)}
    assert len(endpoints) == 6


@pytest.mark.parametrize(
    "method", ["robot", "index", "neighbours", "degree", "agent_endpoint", "plant_endpoint"]
)
def test_an_unknown_robot_is_a_clear_message(method: str) -> None:
    with pytest.raises(FleetError) as caught:
        getattr(small(), method)(4)
    assert str(caught.value) == "fleet small: there is no robot 4; ids are 3, 7, 5"


def test_an_error_lists_all_its_problems() -> None:
    text = SMALL.replace("safe_distance_m = 0.2", "safe_distance_m = 1.5").replace(
        "mass_kg = 9", "mas_kg = 9"
    )
    with pytest.raises(FleetError) as caught:
        parse_fleet(text, source="small.toml", overrides=["control.c1=-1"], law="best")
    assert str(caught.value) == (
        "small.toml: 4 problems\n"
        '  --law: must be one of paper, edge, joint, penalty, got "best"\n'
        "  --set control.c1: must be more than 0 and at most 10000 1/s2, got -1\n"
        "  robot[2].mas_kg: unknown field; did you mean mass_kg? (the robot with id 7)\n"
        "  formation.distance_m: 1.0 is too small: r_s must be below every distance, "
        "and safe_distance_m is 1.5"
    )
    assert caught.value.source == "small.toml"
    assert len(caught.value.problems) == 4


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        (
            "robot.7.id=3",
            "--set robot.7.id: robot[1] has the id 3 already: ids must differ",
        ),
        (
            "formation.edges=[[3, 4]]",
            "--set formation.edges[1]: [3, 4]: there is no robot 4; ids are 3, 5, 7",
        ),
        (
            "formation.edges=[[8, 4]]",
            "--set formation.edges[1]: [8, 4]: there is no robot 8 and no robot 4; ids are 3, 5, 7",
        ),
        (
            "formation.edges=[[3, 5], [7, 7]]",
            "--set formation.edges[2]: [7, 7] joins robot 7 to itself: an edge joins two robots",
        ),
        (
            "formation.edges=[[3, 5], [3, 7], [5, 3]]",
            "--set formation.edges[3]: [5, 3] is formation.edges[1] again: give each edge once",
        ),
        (
            "formation.offsets=[[0, 0]]",
            "--set formation.offsets: must have one pair per [[robot]], got 1 for 3 robots",
        ),
        (
            "formation.offsets=[[0, 0], [0, 0], [1, 0]]",
            "formation.edges[1]: [3, 7] joins two robots with the same offset, [0.0, 0.0]",
        ),
        (
            "formation.distance_m=[1, 2, 3]",
            "--set formation.distance_m: must be one number or one per edge, got 3 for 2 edges",
        ),
        (
            "formation.distance_m=[1, 0.2]",
            "--set formation.distance_m[2]: 0.2 is too small: r_s must be below every distance, "
            "and safe_distance_m is 0.2",
        ),
        (
            "formation.safe_distance_m=1",
            "formation.distance_m: 1.0 is too small: r_s must be below every distance, "
            "and safe_distance_m is 1.0",
        ),
        ("trajectory.kind=line", None),
        (
            "trajectory.radius_m=1",
            '--set trajectory.radius_m: is used by kind = "circle" only, '
            'but here kind = "hold": leave it out',
        ),
        (
            "trajectory.speed_mps=1",
            '--set trajectory.speed_mps: is used by kind = "circle" and kind = "waypoints" only, '
            'but here kind = "hold": leave it out',
        ),
        (
            'trajectory={kind = "waypoints", speed_mps = 1, waypoints_m = [[0, 0]]}',
            "--set trajectory.waypoints_m: must have at least 2 points, got 1",
        ),
        (
            'trajectory={kind = "waypoints", speed_mps = 1, waypoints_m = [[0, 0], [1, 0], [1, 0]]}',
            "--set trajectory.waypoints_m[3]: [1.0, 0.0] is the point before it again",
        ),
        (
            'fleet.name="a/b"',
            '--set fleet.name: must be 1 to 40 letters, digits, - or _, got "a/b"',
        ),
        ("fleet.name=**", '--set fleet.name: must be 1 to 40 letters, digits, - or _, got "**"'),
        ("fleet.name=", '--set fleet.name: must be 1 to 40 letters, digits, - or _, got ""'),
        (f"fleet.name={'a' * 41}", None),
        ("robot.7.id=0", None),
        ("robot.7.id=10000", None),
        ("fleet.rate_hz=0.5", "--set fleet.rate_hz: must be between 1 and 1000 Hz, got 0.5"),
        ("fleet.rate_hz=1001", "--set fleet.rate_hz: must be between 1 and 1000 Hz, got 1001"),
        ("network.base_port=1023", "--set network.base_port: must be between 1024 and 32766, got 1023"),
        (
            "network.base_port=32763",
            "--set network.base_port: 3 robots take ports 32763 to 32768, which must not pass 32767 "
            "(the system uses those above): must be at most 32762",
        ),
        ("network.address=a b", None),
        ("network.address=::1", None),
        (
            "control.plant_timeout_s=39ms",
            "--set control.plant_timeout_s: must be at least two periods, 0.04 s at fleet.rate_hz = 50.0, "
            "got 0.039",
        ),
        (
            "control.wrench_timeout_s=39ms",
            "--set control.wrench_timeout_s: must be at least two periods, 0.04 s at fleet.rate_hz = 50.0, "
            "got 0.039",
        ),
        ("robot=[]", "--set robot: there must be at least one [[robot]]"),
        ("robot.7.x_m=nan", "--set robot.7.x_m: must be a finite number, got nan"),
        ("robot.7.mass=5", "--set robot.7.mass: unknown field; did you mean mass_kg?"),
        ("robot.4.mass_kg=5", "--set robot.4.mass_kg: there is no robot with id 4; ids are 3, 7, 5"),
        ("obstacle.x=5", None),
    ],
)
def test_what_is_refused(override: str, problem: str | None) -> None:
    found = problems(override)
    if problem is None:
        assert found
        assert found[0].startswith(("--set " + override.split("=")[0], "trajectory."))
    else:
        assert problem in found


@pytest.mark.parametrize(
    "override",
    [
        "network.base_port=32762",
        "network.address=[::1]",
        "network.address=10.0.0.1",
        "control.plant_timeout_s=40ms",
        "fleet.rate_hz=1000",
        "formation.distance_m=[1, 0.21]",
        "robot.5.heading_rad=360deg",
        f"fleet.name={'a' * 40}",
    ],
)
def test_what_is_just_allowed(override: str) -> None:
    small(override)


@pytest.mark.parametrize(
    ("kind", "missing"),
    [
        ("line", ["velocity_mps"]),
        ("circle", ["centre_m", "radius_m", "speed_mps"]),
        ("waypoints", ["waypoints_m", "speed_mps"]),
    ],
)
def test_a_kind_needs_its_fields(kind: str, missing: list[str]) -> None:
    found = problems(f"trajectory.kind={kind}")
    assert [problem.split(":")[0] for problem in found] == [f"trajectory.{key}" for key in missing]
    assert all(f'kind = "{kind}" needs it' in problem for problem in found)


def test_offsets_alone_give_distances_to_check() -> None:
    text = SMALL.replace("distance_m = 1.0\n", "", 1)
    assert small(text=text).formation.distance_m is None
    assert problems("formation.offsets=[[0, 0], [1, 0], [1, 0.2]]", text=text) == [
        "formation.edges[2]: [7, 5]: the offsets are 0.2 m apart, too close: "
        "r_s must be below every distance, and safe_distance_m is 0.2"
    ]


def test_neither_offsets_nor_distances() -> None:
    text = SMALL.replace("distance_m = 1.0\n", "", 1).replace("offsets", "# offsets")
    assert problems(text=text) == [
        "formation: gives neither offsets nor distance_m: write for example distance_m = 1.0"
    ]


def test_a_bad_element_does_not_hide_the_others() -> None:
    found = problems("formation.edges=[[3], [7, 7], [3, 9]]", "robot.5.id=true")
    assert [problem.split(":")[0] for problem in found] == [
        "--set formation.edges[1]",
        "--set robot.5.id",
        "--set formation.edges[2]",
    ], "and edge [3, 9] is not blamed: the robot without a readable id may be robot 9"


def test_another_kind_drops_what_the_file_gave_for_its_own() -> None:
    text = SMALL + '[trajectory]\nkind = "line"\nvelocity_mps = [1, 0]\nstart_m = [2, 3]\n'
    fleet = small("trajectory.kind=hold", text=text)
    assert fleet.trajectory.velocity_mps is None
    assert fleet.trajectory.start_m == (2.0, 3.0), "which both kinds use"
    assert len(problems("trajectory.kind=hold", "trajectory.velocity_mps=[1, 0]", text=text)) == 1
    assert len(problems(text=text.replace("line", "hold"))) == 1, "a file that contradicts itself is refused"


# --- real vehicles ----------------------------------------------------------------------------

DATUM = "[datum]\nlatitude_deg = -35.363261\nlongitude_deg = 149.165230\n"
# Robot 3 is a vehicle, the others are simulated.
MIXED = (
    SMALL.replace("id = 3\n", 'id = 3\nplant = "mavlink"\nmavlink = { connection = "udpin:0.0.0.0:14550" }\n')
    + DATUM
)
ROVERS = (
    SMALL.replace(
        "mass_kg = 8", 'mass_kg = 8\nplant = "mavlink"\nmavlink = { connection = "simulator", arm = true }'
    )
    + DATUM
)


def test_a_fleet_of_simulated_and_real_robots() -> None:
    fleet = small(text=MIXED)
    assert [robot.plant for robot in fleet.robots] == ["mavlink", "unicycle", "unicycle"]
    assert fleet.robot(3).mavlink == MavlinkSection(connection="udpin:0.0.0.0:14550")
    assert fleet.robot(7).mavlink is None
    assert fleet.datum == DatumSection(-35.363261, 149.165230, 0.0)
    assert small().datum is None


def test_a_vehicle_takes_from_the_defaults_what_it_does_not_say_itself() -> None:
    text = ROVERS + '[robot.mavlink]\nconnection = "/dev/serial/by-id/usb-ArduPilot_1"\nbaud = 57600\n'
    text = text.replace(DATUM, "") + DATUM  # the table is of the last [[robot]]
    fleet = small("robot_defaults.mavlink.state_rate_hz=20", text=text)
    shared = MavlinkSection(connection="simulator", arm=True, state_rate_hz=20.0)
    assert [robot.mavlink for robot in fleet.robots] == [
        shared,
        shared,
        replace(shared, connection="/dev/serial/by-id/usb-ArduPilot_1", baud=57600),
    ]


def test_any_number_of_vehicles_may_be_simulated() -> None:
    assert [robot.mavlink.connection for robot in small(text=ROVERS).robots if robot.mavlink] == [
        "simulator"
    ] * 3


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
                '--set robot_defaults.plant: must be one of "unicycle", "mavlink", got "mavlnk"; '
                'did you mean "mavlink"?'
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
            ["robot.3.mavlink.own_system=255"],
            ["--set robot.3.mavlink.own_system: must be between 1 and 254, got 255"],
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
    assert [robot.mavlink and robot.mavlink.system for robot in fleet.robots] == [1, 2, 3]
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
    assert fleet.robot(3).mavlink == MavlinkSection(connection=connection)


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
    assert "own_system" not in table["robot"][0]["mavlink"]
    assert "datum" not in to_dict(small())


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


# --- laws and overrides -----------------------------------------------------------------------


@pytest.mark.parametrize("name", LAWS)
def test_laws(name: str) -> None:
    fleet = small(law=name, text=SMALL + '[control]\ncoupling = "penalty"\nkp = 7\nc1 = 2\n')
    assert {key: getattr(fleet.control, key) for key in LAWS[name]} == LAWS[name]
    assert fleet.control.c1 == 2.0, "a law leaves the rest to the file"
    assert law_name(fleet.control) == name


def test_overrides_win_over_the_law_and_the_law_over_the_file() -> None:
    text = SMALL + '[control]\ncoupling = "penalty"\nkp = 7\n'
    assert law_name(small(text=text).control) == "custom"
    assert small("control.kp=3", law="paper", text=text).control == ControlSection(
        coupling="edge", kp=3.0, relaxation=0.001
    )


def test_robot_defaults_do_not_win_over_a_robot() -> None:
    assert [robot.mass_kg for robot in small("robot_defaults.mass_kg=1kg").robots] == [1.0, 9.0, 1.0]
    assert [robot.mass_kg for robot in small("robot.3.mass_kg=500g").robots] == [0.5, 9.0, 8.0]


# --- files ------------------------------------------------------------------------------------


def refusal(path: Path) -> str:
    with pytest.raises(FleetError) as caught:
        load_fleet(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    assert refusal(path) == "cannot read the fleet file: no such file or directory"
    assert refusal(tmp_path) == "cannot read the fleet file: is a directory"
    path.write_bytes(b"[fleet]\nname = '\xff'\n")
    assert refusal(path) == "a fleet file must be text in UTF-8: byte 0xff on line 2 is not"
    path.write_bytes(b"#" * (FILE_BYTES_MAX + 1))
    assert refusal(path) == "larger than 1024 KiB: this is not a fleet file"
    assert refusal(Path("/dev/zero")) == "larger than 1024 KiB: this is not a fleet file"


def test_an_impossible_path() -> None:
    with pytest.raises(FleetError, match=r"^a\\x00b: cannot read the fleet file: not a possible file name$"):
        load_fleet("a\0b")


def test_a_byte_order_mark_and_windows_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbf" + SMALL.replace("\n", "\r\n").encode())
    assert load_fleet(path) == small()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[fleet]\nname = \n", "a: 1 problem\n  line 2, column 8: not valid TOML: Invalid value"),
        ("[fleet]\nname = 'x", None),
        ("[fleet]\n[fleet]\n", None),
        ("a = " + "[" * 100_000, "a: not valid TOML: arrays or tables nested too deeply"),
        ("a = " + "9" * 5000, None),
        ("a = 2020-13-01", None),
        ("\x00", None),
        ("", None),
    ],
)
def test_texts_that_are_not_a_fleet(text: str, message: str | None) -> None:
    with pytest.raises(FleetError) as caught:
        parse_fleet(text, source="a")
    assert message is None or str(caught.value) == message


def test_a_file_of_rubbish_is_cut_short() -> None:
    with pytest.raises(FleetError) as caught:
        parse_fleet("\n".join(f"flet{k} = 1" for k in range(20_000)), source="a")
    lines = str(caught.value).splitlines()
    assert len(lines) == 102
    suggestions = sum("did you mean" in problem.message for problem in caught.value.problems)
    assert suggestions == 100, "nearest names take long to find"
    assert lines[-1] == f"  ... and {len(caught.value.problems) - 100} more"


# --- and back ---------------------------------------------------------------------------------


@pytest.mark.parametrize("path", BUNDLED, ids=lambda path: path.stem)
def test_bundled_fleets(path: Path) -> None:
    fleet = load_fleet(path)
    assert fleet.fleet.name == path.stem
    assert fleet.fleet.description
    assert law_name(fleet.control) == "joint"
    assert parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again") == fleet
    offsets, distance = fleet.formation.offsets, fleet.formation.distance_m
    assert offsets is not None
    assert isinstance(distance, float)
    for i, j in fleet.formation.edges:
        apart = math.dist(offsets[fleet.index(i)], offsets[fleet.index(j)])
        assert apart == pytest.approx(distance, abs=1e-3), (i, j)
    assert [sum(axis) for axis in zip(*offsets, strict=True)] == pytest.approx([0, 0], abs=1e-3)
    starts = [(robot.x_m, robot.y_m) for robot in fleet.robots]
    closest = min(math.dist(a, b) for k, a in enumerate(starts) for b in starts[:k])
    assert closest > fleet.formation.safe_distance_m


def test_delta_is_the_papers() -> None:
    delta = load_fleet(DEPLOY / "fleets" / "delta.toml")
    assert delta.neighbours(2) == (1, 3, 4, 5), "section 3.2"
    assert len(delta.formation.edges) == 9
    assert [(robot.x_m, robot.y_m) for robot in delta.robots] == [
        (-1.0, 1.4),
        (-0.7, -0.9),
        (-0.2, 0.3),
        (1.0, 2.0),
        (0.1, 1.0),
        (-0.18, 0.0),
    ]
    control = delta.control
    assert (control.c1, control.c2, control.kd, control.k2) == (0.4, 0.6, 1.8, 5.0)
    assert {(r.mass_kg, r.inertia_kgm2, r.hand_offset_m, r.heading_rad) for r in delta.robots} == {
        (10, 0.13, 0.1, 0)
    }
    assert delta.formation.offsets is not None
    assert min(delta.formation.offsets, key=lambda offset: offset[1]) == delta.formation.offsets[0]


def test_the_template_is_a_fleet() -> None:
    text = (DEPLOY / "template.toml").read_text()
    fleet = parse_fleet(text.replace("@NAME@", "mine"), source="mine")
    assert fleet.fleet.name == "mine"
    assert len(fleet.robots) == 3
    with pytest.raises(FleetError, match=r"fleet\.name"):
        parse_fleet(text, source="template")


KINDS = [
    'trajectory={kind = "hold", start_m = [1, 2]}',
    'trajectory={kind = "line", velocity_mps = [1, 2]}',
    'trajectory={kind = "circle", centre_m = [1, 2], radius_m = 3, speed_mps = 1, clockwise = true}',
    'trajectory={kind = "waypoints", waypoints_m = [[1, 2], [3, 4]], speed_mps = 1}',
]


@pytest.mark.parametrize("trajectory", KINDS)
def test_round_trip_of_every_kind(trajectory: str) -> None:
    fleet = small(trajectory, "formation.distance_m=[1, 2]", "robot.3.max_force_n=50", "fleet.rate_hz=0.1kHz")
    table = to_dict(fleet)
    assert parse_fleet(tomli_w.dumps(table), source="again") == fleet
    assert "robot_defaults" not in table


def test_digest_is_over_what_robots_must_agree_on() -> None:
    base = digest(small())
    assert len(base) == 16
    assert int(base, 16) >= 0
    assert base == digest(
        small("network.base_port=9000", "network.address=robots", "fleet.description=other")
    )
    assert base == digest(small(text=SMALL.replace("x_m = 1", "x_m = 1.0"))), "however it is written"
    different = [
        "fleet.seed=1",
        "fleet.rate_hz=49",
        "formation.assign=true",
        "formation.edges=[[7, 3], [7, 5]]",
        "formation.safe_distance_m=0.1",
        "control.kp=2",
        "control.wrench_timeout_s=1",
        "trajectory.start_m=[1, 0]",
        "robot.3.mass_kg=10",
        "robot.3.x_m=0.1",
        *KINDS,
    ]
    digests = {digest(small(override)) for override in different}
    assert len(digests) == len(different)
    assert base not in digests


def test_digest_of_a_replaced_fleet() -> None:
    fleet = small()
    assert digest(replace(fleet, control=replace(fleet.control, kp=2.0))) == digest(small("control.kp=2"))


# --- the page, and the module itself ----------------------------------------------------------


def test_the_reference_page_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert fleet_reference.main(["--check"]) == 0, capsys.readouterr().err


def test_the_reference_page_says_everything() -> None:
    page = fleet_reference.render()
    vehicle = ("signing_key=~/key", "system=1", "own_system=1")
    overrides = (
        "robot.3.max_force_n=1",
        "robot.3.max_torque_nm=1",
        *(f"robot.3.mavlink.{each}" for each in vehicle),
    )
    for section, table in to_dict(small(*overrides, text=MIXED)).items():
        for key, value in (table if isinstance(table, dict) else table[0]).items():
            if key == "mavlink":
                assert "## `[robot_defaults.mavlink]`" in page
                assert all(f"| `{inside}` |" in page for inside in value), value
            else:
                assert f"| `{key}` |" in page or f"## `[[{section}.{key}]]`" in page, (section, key)
    assert fleet_reference.main(["--what"]) == 2


def test_a_stale_page_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "fleet-file.md"
    monkeypatch.setattr(fleet_reference, "PAGE", page)
    assert fleet_reference.main(["--check"]) == 1
    page.write_text(fleet_reference.render() + " ")
    assert fleet_reference.main(["--check"]) == 1


def test_it_starts_without_numpy() -> None:
    code = (
        "import sys, agent.fleet; print(sorted({'numpy', 'zenoh', 'difflib', 'asyncio'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "[]\n", "every process of a fleet imports this first"
