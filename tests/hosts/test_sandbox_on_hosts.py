"""What robots' processes are kept from by their units, tried from within, and that fleets drive so."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.hosts.remote_program import LEFT_OUT
from handfast.deploy.hosts.systemd_units import TRIED
from handfast.deploy.processes.placement import vehicle
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.host import Host, Setup
from tests.hosts.hosts import Hosts
from tests.hosts.programs import python_to_lend
from tests.process.harness import measured, wait_for

pytestmark = pytest.mark.timeout(400)
MakeHosts = Callable[[int | Sequence[Setup]], Hosts]
CABLE: Final = Path(__file__).parents[1] / "rover_serial.py"
PROBE: Final = Path(__file__).with_name("sandbox_probe.py")
READY: Final = "ready, ms"
FOLDER: Final = ".local/share/handfast/fleets/pair"
FILTERED: Final = {"packets", "kernel's log", "namespace", "set-user-ID", "realtime"}
"""What filters of system calls refuse."""
SHUT: Final = {
    *("write home", "write a unit", "write the program", "write keys", "read ssh", "systemd", "bus"),
    *("write a control group", "look into others"),
}
"""What namespaces keep out of reach."""
SANDBOX: Final = re.compile(r"^NoNewPrivileges=.*^# sandbox: until here$", re.MULTILINE | re.DOTALL)
NAME: Final = "pair"


def tables(hosts: Sequence[Host]) -> dict[str, Any]:
    """A robot on each host."""
    raw = tomllib.loads((FLEETS / "pair.toml").read_text(encoding="utf-8"))
    raw["host"] = {host.name: {"address": host.address} for host in hosts}
    raw["fleet"] |= {"rate_hz": 25.0, "duration_s": 15.0}
    for robot, host in zip(raw["robot"], hosts, strict=True):
        robot["host"] = host.name
    raw["control"] = raw.get("control", {}) | {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5}
    return raw


@pytest.fixture(scope="module")
def fleet(make_hosts: MakeHosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> FleetOnHosts:
    """Up: the first robot's processes are root's, those of the second an ordinary user's."""
    if python_to_lend() is not None:
        pytest.skip("an ordinary user of a host needs a Python of 3.11 or later in /usr")
    hosts = make_hosts([Setup(), Setup(ordinary=True)])
    fetch_wheels(hosts[0], cache)
    found = FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables(list(hosts)), cache)
    found.handfast("keys")
    told = found.handfast("up", timeout=UP_TIMEOUT_S)
    assert "namespaces" not in told.stdout + told.stderr
    return found


def with_rover(fleet: FleetOnHosts, device: str) -> dict[str, Any]:
    """A simulated body on the first host, a rover behind a serial port on the second."""
    raw = tomllib.loads((FLEETS / "rovers.toml").read_text(encoding="utf-8"))
    raw["host"] = {host.name: {"address": host.address} for host in fleet.hosts}
    raw["fleet"] |= {"duration_s": 15.0, "name": "mixed"}
    raw["formation"] |= {"edges": [[1, 2]], "offsets": [[0.0, -1.5], [0.0, 1.5]]}
    raw["trajectory"]["start_m"] = [0.0, 0.0]
    raw["robot"] = raw["robot"][:2]
    for robot, host, y in zip(raw["robot"], fleet.hosts, (-1.6, 1.5), strict=True):
        robot |= {"host": host.name, "x_m": -0.5, "y_m": y}
    raw["robot"][0]["plant"] = "unicycle"
    raw["robot"][1]["mavlink"] = {"connection": device}
    return raw


def unit_text(host: Host, robot: int, role: str, fleet: str = NAME) -> str:
    return (host.home / f".config/systemd/user/handfast-{fleet}-robot-{robot}-{role}.service").read_text()


def probed(hosts: Hosts, host: Host, text: str) -> dict[str, str]:
    """What a process may do that a unit of this text starts: "" or why not, by what was tried."""
    home = host.environment["HOME"]
    folders = [path.replace("~", home) for path in json.loads(re.findall(r"^# writes: (.*)$", text, re.M)[0])]
    words = ["/usr/bin/python3", "-I", f"{home}/probe.py", *folders]
    text = re.sub(r"^ExecStart=.*$", f"ExecStart={shlex.join(words)}", text, flags=re.M)
    text = text.replace(
        "Restart=always", f"Restart=no\nRemainAfterExit=yes\nStandardOutput=truncate:{home}/probe.json"
    )
    (host.home / "probe.py").write_bytes(PROBE.read_bytes())
    (host.home / ".config/systemd/user/probe.service").write_text(text)
    (host.home / ".ssh").mkdir(exist_ok=True)
    host.run(f"chown -R {host.uid}:{host.uid} .ssh probe.py; rm -f /tmp/others", check=True)
    done = hosts.operator.ssh(host, "systemctl --user daemon-reload; systemctl --user restart probe")
    assert done.returncode == 0, done.stderr + host.run("journalctl -q -n 20").stdout
    times = ("InactiveExitTimestampMonotonic", "ActiveEnterTimestampMonotonic")
    shown = hosts.operator.ssh(host, f"systemctl --user show probe --value -p {','.join(times)}").stdout
    begun, ready = map(int, shown.split())
    found: dict[str, str] = json.loads((host.home / "probe.json").read_text())
    found[READY] = str((ready - begun) // 1000)
    assert folders
    assert not any(found[f"write {folder}"] for folder in folders), found
    return found


def refused(found: dict[str, str]) -> set[str]:
    return {name for name, why in found.items() if why and name != READY}


@pytest.mark.parametrize("robot", [1, 2])
@pytest.mark.parametrize("role", ["agent", "plant", "recorder"])
def test_a_process_can_do_what_it_needs_and_no_more(fleet: FleetOnHosts, robot: int, role: str) -> None:
    host = fleet.host_of(robot)
    found = probed(fleet.hosts, host, unit_text(host, robot, role))
    assert refused(found) == FILTERED | SHUT | {"executable memory", "devices"}, found
    assert not Path(f"/proc/{host.space.pid}/root/tmp/others").exists(), "its /tmp is its own"


def test_nothing_but_its_unit_keeps_it_from_that(fleet: FleetOnHosts) -> None:
    host = fleet.host_of(1)
    text = unit_text(host, 1, "agent")
    closed, (open_text, count) = probed(fleet.hosts, host, text), SANDBOX.subn("", text)
    found = probed(fleet.hosts, host, open_text)
    assert count == 1
    assert refused(found) == set(), found
    measured("a unit to ready, ms: closed", float(closed[READY]))
    measured("a unit to ready, ms: open", float(found[READY]))


@pytest.mark.long
def test_it_drives_and_what_processes_keep_is_there(fleet: FleetOnHosts) -> None:
    assert "formation within 5 %" in fleet.handfast("drive", "--out", "drive", "--no-report").stdout
    for robot in (1, 2):
        there = fleet.host_of(robot).home / FOLDER
        assert {path.name for path in (there / "orders").iterdir()} >= {
            f"robot-{robot}-agent.json", f"robot-{robot}-plant.json"
        }  # fmt: skip
        assert (there / f"state/robot-{robot}.pose").exists()
        assert list((there / f"recordings/robot-{robot}").glob("*.mcap"))
    fleet.handfast("fetch", "--out", "fetched", "--no-report")
    fleet.handfast("down")


def test_a_bridge_drives_its_vehicle_on_a_serial_port(fleet: FleetOnHosts) -> None:
    host = fleet.host_of(2)
    versions = host.home / ".local/share/handfast/versions"
    (version,) = [path.name for path in versions.iterdir()]
    python = f"{host.environment['HOME']}/.local/share/handfast/versions/{version}/bin/python"
    raw = with_rover(fleet, "simulator")
    (fleet.folder / "rover").mkdir()
    rover = FleetOnHosts(fleet.hosts, fleet.folder / "rover", raw, fleet.cache)
    words = vehicle(resolved(parse_fleet(rover.file.read_text(), source="here")), 2, 5599).arguments[1:]
    (host.home / CABLE.name).write_bytes(CABLE.read_bytes())
    simulator = [
        python,
        "-P",
        "-m",
        "handfast.bridges.mavlink.simulator",
        "--listen=tcp:127.0.0.1:5760",
        *words,
    ]
    for begin in (simulator, [python, CABLE.name, "/run/serial", "5760"]):
        host.run(f"setsid {shlex.join(begin)} </dev/null >>/run/rover.log 2>&1 &", check=True)
    device = wait_for(lambda: host.run(["readlink", "/run/serial"]).stdout.strip(), "the rover's serial port")
    host.run(["chgrp", "dialout", device], check=True)
    host.run(["chmod", "660", device], check=True)
    assert host.run(["stat", "-c", "%U %G %a", device]).stdout == "root dialout 660\n"
    rover = FleetOnHosts(fleet.hosts, fleet.folder / "rover", with_rover(fleet, device), fleet.cache)
    rover.handfast("keys")
    told = rover.handfast("up", timeout=UP_TIMEOUT_S)
    assert f"robot 2: {device}: " not in told.stderr, "the user is in the port's group, and so is his systemd"
    assert "formation within 5 %" in rover.handfast("drive", "--out", "drive", "--no-report").stdout
    found = probed(fleet.hosts, host, unit_text(host, 2, "plant", rover.name))
    assert refused(found) == FILTERED | SHUT | {"executable memory"}, found
    lock = Path(f"/proc/{host.space.pid}/root/tmp/handfast-{host.uid}")
    assert list(lock.glob("*.lock")), "others find it there"
    rover.handfast("down")


@pytest.mark.long
def test_where_a_user_has_no_namespaces_up_says_so_and_filters_stay(
    fleet: FleetOnHosts, make_hosts: MakeHosts, tmp_path: Path
) -> None:
    (host,) = hosts = make_hosts([Setup(ordinary=True, namespaces=False)])
    found = FleetOnHosts(hosts, tmp_path, tables([host, host]), fleet.cache)
    found.handfast("keys")
    told = found.handfast("up", timeout=UP_TIMEOUT_S)
    assert told.stderr.count("as users have no namespaces there") == 1, told
    assert "nothing to do" in found.handfast("up").stderr
    text = unit_text(host, 1, "agent")
    assert LEFT_OUT in text
    assert TRIED not in text
    did = refused(probed(hosts, host, text))
    assert FILTERED | {"executable memory"} <= did
    assert did.isdisjoint({"write home", "read ssh", "systemd", "bus"})
    assert "formation within 5 %" in found.handfast("drive", "--out", "drive", "--no-report").stdout
