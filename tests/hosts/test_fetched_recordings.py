"""What robots on three hosts recorded, fetched: drives before are not laid into the last one, and what one
host makes up is no matter of the others."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, parse_fleet, to_dict
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Mission, Stop
from handfast.agent.recorder.folder import RecordingFolder, recording_files
from handfast.agent.recorder.recorder import RobotRecorder, order_keys
from handfast.deploy.merging.robot_files import scan
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.hosts import Hosts

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
PLACES = ((0.0, 0.0), (1.0, 0.0), (0.5, 0.87))
LIAR = 2


def tables(hosts: Hosts) -> dict[str, Any]:
    return {
        "fleet": {"name": "three", "rate_hz": 25.0},
        "formation": {"edges": [[1, 2], [1, 3], [2, 3]], "distance_m": 1.0, "safe_distance_m": 0.2},
        "control": {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5},
        "trajectory": {"kind": "hold"},
        "host": {host.name: {"address": host.address} for host in hosts},
        "robot": [
            {"id": number, "x_m": x, "y_m": y, "host": host.name}
            for number, ((x, y), host) in enumerate(zip(PLACES, hosts, strict=True), 1)
        ],
    }


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    return make_hosts(3)


@pytest.fixture(scope="module")
def fleet(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> FleetOnHosts:
    """Up, with keys."""
    fetch_wheels(hosts[0], cache)
    found = FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables(hosts), cache)
    found.handfast("keys")
    found.handfast("up", timeout=UP_TIMEOUT_S)
    return found


def drive(fleet: FleetOnHosts, out: Path) -> None:
    """Drives, also where robots remember a stop from before they came up."""
    words = ("drive", "--duration", "6s", "--out", str(out), "--no-report")
    if fleet.handfast(*words, status=None).returncode == 2:
        fleet.handfast(*words, "--resume")


def fetched(fleet: FleetOnHosts, out: Path) -> tuple[Recording, str]:
    told = fleet.handfast("fetch", "--out", str(out), "--no-report", status=None)
    return read_run(out), f"{told.stdout}\n{told.stderr}"


def test_a_stop_from_before_down_is_none_of_the_drive_after_it(fleet: FleetOnHosts, tmp_path: Path) -> None:
    drive(fleet, tmp_path / "first")
    fleet.handfast("stop", "--reason", "lunch")
    fleet.handfast("down")
    fleet.handfast("up", timeout=UP_TIMEOUT_S)
    drive(fleet, tmp_path / "second")
    recording, told = fetched(fleet, tmp_path / "fetched")
    assert recording.epoch_ns == read_run(tmp_path / "second").epoch_ns
    assert "after the stop" not in told
    assert "PASSED" in told, told
    for robot in recording.ids:
        assert all(end_s <= 0.0 or start_s > 5.0 for start_s, end_s in recording.halts(robot))


def test_what_one_host_makes_up_changes_nothing_for_the_others(fleet: FleetOnHosts, tmp_path: Path) -> None:
    fleet.handfast("down")
    before, _ = fetched(fleet, tmp_path / "before")
    host = fleet.host_of(LIAR)
    folder = host.home / f".local/share/handfast/fleets/three/recordings/robot-{LIAR}"
    about = scan(recording_files(folder)[-1]).about
    assert about is not None
    other = tomllib.loads(about.fleet_toml) | {"trajectory": {"kind": "line", "velocity_mps": [1.0, 0.0]}}
    their = resolved(parse_fleet(tomli_w.dumps(other), source="made up"))
    epoch_ns = before.epoch_ns or 0
    told = key_expressions.relayed("three", LIAR)
    mission = Mission(10**9, epoch_ns + 1, epoch_ns + NS_PER_S, 60 * NS_PER_S, digest(their))
    lies = [
        (epoch_ns + 2, told, encode(mission)),
        (epoch_ns + 3, told, encode(Stop(10**9, epoch_ns + 3, "made up"))),
    ]
    other_file = about._replace(digest=digest(their), fleet_toml=tomli_w.dumps(to_dict(their)))
    broken = about._replace(fleet_toml="[fleet")
    with RecordingFolder(folder, 1_000_000_000, 0) as files:
        for lie in (about, other_file, broken):
            with RobotRecorder(files, lie, order_keys("three", LIAR), (), print) as recorder:
                for each in lies:
                    recorder.add(*each)
                recorder.end_file(epoch_ns)
    after, said = fetched(fleet, tmp_path / "after")
    assert f"what robot {LIAR} recorded (host2) is left out: it ran another fleet file" in said
    assert (
        f"of what robot {LIAR} recorded (host2) 2 orders are left out, which no operator has sealed" in said
    )
    assert (after.missions, after.stops, after.epoch_ns) == (before.missions, before.stops, before.epoch_ns)
    assert after.fleet == before.fleet
    for robot in set(after.ids) - {LIAR}:
        assert (after.robots[robot].plant.values == before.robots[robot].plant.values).all()
        assert after.robots[robot].status.states == before.robots[robot].status.states
