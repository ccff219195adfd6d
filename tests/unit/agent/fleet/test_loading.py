"""handfast.agent.fleet.loading: the fleet file, its checks across fields, and its way back to a table."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w

from handfast.agent.fleet.loading import FILE_BYTES_MAX, digest, law_name, load_fleet, parse_fleet, to_dict
from handfast.agent.fleet.model import FleetError
from handfast.agent.fleet.sections import LAWS, REPLACED, ControlSection
from handfast.deploy.check import fleet_reference
from handfast.deploy.console.data_files import FLEETS, TEMPLATE
from tests.unit.agent.fleet.fleet_texts import MIXED, SMALL, problems, small

BUNDLED = sorted((FLEETS).glob("*.toml"))


def test_the_small_fleet() -> None:
    fleet = small()
    assert fleet.ids == (3, 7, 5)
    assert fleet.formation.edges == ((3, 7), (7, 5))
    assert [robot.mass_kg for robot in fleet.robots] == [8.0, 9.0, 8.0]
    assert fleet.control == ControlSection()
    assert fleet.trajectory.kind == "hold"


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        (
            "robot.7.id=3",  # and nothing of edges: a robot 7 is meant
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
            "--set formation.offsets: must have one pair per [[robot]] (not in reserve), got 1 for 3 robots",
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


def test_one_id_twice_does_not_account_for_two_absent_robots() -> None:
    found = problems("formation.edges=[[3, 5], [3, 7], [5, 9]]", "robot.7.id=3")
    assert [line.split(": ")[0] for line in found] == [
        "--set robot.7.id", "--set formation.edges[2]", "--set formation.edges[3]",
    ]  # fmt: skip


def test_another_kind_drops_what_the_file_gave_for_its_own() -> None:
    text = SMALL + '[trajectory]\nkind = "line"\nvelocity_mps = [1, 0]\nstart_m = [2, 3]\n'
    fleet = small("trajectory.kind=hold", text=text)
    assert fleet.trajectory.velocity_mps is None
    assert fleet.trajectory.start_m == (2.0, 3.0), "which both kinds use"
    assert len(problems("trajectory.kind=hold", "trajectory.velocity_mps=[1, 0]", text=text)) == 1
    assert len(problems(text=text.replace("line", "hold"))) == 1, "a file that contradicts itself is refused"


@pytest.mark.parametrize("name", LAWS)
def test_laws(name: str) -> None:
    fleet = small(law=name, text=SMALL + '[control]\ncoupling = "penalty"\nkp = 7\nc1 = 2\n')
    for table, preset in LAWS[name].items():
        assert {key: getattr(getattr(fleet, table), key) for key in preset} == preset
    assert fleet.avoidance.enabled is (name != "paper"), "the paper's law avoids nothing"
    assert fleet.control.c1 == 2.0, "a law leaves the rest to the file"
    assert law_name(fleet.control) == name


def test_overrides_win_over_the_law_and_the_law_over_the_file() -> None:
    text = SMALL + '[control]\ncoupling = "penalty"\nkp = 7\n'
    assert law_name(small(text=text).control) == "custom"
    assert small("control.kp=3", law="paper", text=text).control == ControlSection(coupling="edge", kp=3.0)


def test_robot_defaults_do_not_win_over_a_robot() -> None:
    assert [robot.mass_kg for robot in small("robot_defaults.mass_kg=1kg").robots] == [1.0, 9.0, 1.0]
    assert [robot.mass_kg for robot in small("robot.3.mass_kg=500g").robots] == [0.5, 9.0, 8.0]


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


@pytest.mark.slow
def test_a_file_of_rubbish_is_cut_short() -> None:
    with pytest.raises(FleetError) as caught:
        parse_fleet("\n".join(f"flet{k} = 1" for k in range(20_000)), source="a")
    lines = str(caught.value).splitlines()
    assert len(lines) == 102
    suggestions = sum("did you mean" in problem.message for problem in caught.value.problems)
    assert suggestions == 100, "nearest names take long to find"
    assert lines[-1] == f"  ... and {len(caught.value.problems) - 100} more"


@pytest.mark.parametrize("path", BUNDLED, ids=lambda path: path.stem)
def test_bundled_fleets(path: Path) -> None:
    fleet = load_fleet(path)
    assert fleet.fleet.name == path.stem
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
    delta = load_fleet(FLEETS / "delta.toml")
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
    text = TEMPLATE.read_text()
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


def test_the_reference_page_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert fleet_reference.main(["--check"]) == 0, capsys.readouterr().err


def test_the_reference_page_says_everything() -> None:
    page = fleet_reference.render()
    named = set(re.findall(r"^- `(\w+)", page, re.MULTILINE))
    vehicle = ("signing_key=~/key", "system=1")
    overrides = (
        "robot.3.max_force_n=1",
        "robot.3.max_torque_nm=1",
        *(f"robot.3.mavlink.{each}" for each in vehicle),
    )
    for section, table in to_dict(small(*overrides, text=MIXED)).items():
        for key, value in (table if isinstance(table, dict) else table[0]).items() if table else ():
            if key == "mavlink":
                assert "## `[robot_defaults.mavlink]`" in page
                assert set(value) <= named, value
            else:
                assert key in named or f"## `[[{section}.{key}]]`" in page, (section, key)
    assert fleet_reference.main(["--what"]) == 2


def test_a_stale_page_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "fleet-file.md"
    monkeypatch.setattr(fleet_reference, "PAGE", page)
    assert fleet_reference.main(["--check"]) == 1
    page.write_text(fleet_reference.render() + " ")
    assert fleet_reference.main(["--check"]) == 1


def test_it_starts_without_numpy() -> None:
    code = (
        "import sys, handfast.agent.fleet.model; print(sorted({'numpy', 'zenoh', 'difflib', 'asyncio'} & "
        "set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "[]\n", "every process of a fleet imports this first"


@pytest.mark.parametrize("control", ["\x1b[2J", "\x07", "\x9b31m", "\u202e", "\x00"])
def test_control_characters_are_refused_wherever_a_text_is_free(control: str) -> None:
    texts = {
        "fleet.description": {"fleet": {"description": f"Six{control}"}},
        "faults.rule[1].name": {"faults": {"rule": [{"name": f"cut{control}", "loss": "50 %"}]}},
        "robot[1].mavlink.connection": {"robot": [{"mavlink": {"connection": f"/dev/x{control}"}}]},
    }
    for place, tables in texts.items():
        raw = tomllib.loads(SMALL)
        for name, table in tables.items():
            if name == "robot":
                raw["robot"][0] |= {"plant": "mavlink"} | table[0]
            else:
                raw[name] = table if isinstance(table, list) else raw.get(name, {}) | table
        with pytest.raises(FleetError) as caught:
            parse_fleet(tomli_w.dumps(raw), source="here")
        (found,) = [problem for problem in caught.value.problems if problem.place == place]
        assert found.message.isprintable()
        assert "control characters" in found.message or "must be" in found.message


@pytest.mark.parametrize("name", REPLACED)
def test_removed_field_says_what_replaced_it(name: str) -> None:
    table, _, field = name.rpartition(".")
    forms = {
        "": f"[{name}]", "faults.rule": "[[faults.rule]]", "host": "[host.here]",
        "order": '[[order]]\nkind = "stop"\nat = 1',
        "geofence": "[geofence]\npoints_m = [[-9, -9], [9, -9], [9, 9], [-9, 9]]",
    }  # fmt: skip
    header = forms.get(table) or f"[{table.replace('robot', 'robot_defaults')}]"
    text = SMALL.replace("[robot_defaults]\n", "").replace("mass_kg = 8", "")
    if table == "fleet":
        text = text.replace("[fleet]", f"[fleet]\n{field} = 1")
    else:
        text = f"{text}\n{header}\n{field if table else 'x'} = 1\n"
    why = f"is no field any more: {REPLACED[name]}"
    with pytest.raises(FleetError) as caught:
        parse_fleet(text, source="small")
    assert why in [problem.message for problem in caught.value.problems]
    assert parse_fleet(text, source="small", recorded=True).ids == (3, 7, 5)
    if table in ("faults.rule", "geofence", "host", "order"):
        return
    with pytest.raises(FleetError) as caught:
        small(f"{name}=1".replace("robot.", "robot.3.", 1))
    assert [problem.message for problem in caught.value.problems] == [why]
