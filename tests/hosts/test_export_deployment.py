"""The folder of `handfast export-deployment`, played on two hosts, of which the first has the fleet's router.
Each test goes on from the one before."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from deploy.inventory.operator_credentials import KEYS
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.host import Setup
from tests.hosts.hosts import Hosts
from tests.process.harness import ROOT, measured, wait_for

pytestmark = [
    pytest.mark.timeout(400),
    pytest.mark.skipif(importlib.util.find_spec("ansible") is None, reason="ansible-core is not installed"),
]


MakeHosts = Callable[[int | Sequence[Setup]], Hosts]
WRONG = [
    (Setup(systemd=False), "no systemd answers root there: "),
    (Setup(linger=False), "the processes of root would end with the last login: sudo loginctl enable-linger"),
    (Setup(python="none"), "there is no Python of 3.11 or later on its PATH"),
    (Setup(python="old"), "there is no Python of 3.11 or later on its PATH (python3 is Python 3."),
    (Setup(home_mb=64), "the disk is full: "),
]


class Deployment:
    """A written folder, and `ansible-playbook` in the operator's network."""

    def __init__(self, fleet: FleetOnHosts, folder: Path) -> None:
        self.fleet, self.folder = fleet, folder
        told = fleet.handfast("export-deployment", "--out", str(folder))
        count = len(fleet.hosts)
        assert told.stdout.startswith(f"wrote {folder}: {count} hosts, {count} robots, wheels for Python 3.")

    def play(self, *options: str, status: int = 0) -> str:
        """Runs the playbook; what it says, without line ends."""
        command = {"handfast_command": [sys.executable, "-P", "-m", "deploy.cli"]}
        done = self.fleet.hosts.operator.run(
            [
                sys.executable,
                "-m",
                "ansible",
                "playbook",
                "playbook.yml",
                "-e",
                json.dumps(command),
                *options,
            ],
            env=self.fleet.environment()
            | {
                "LC_ALL": "C.UTF-8",
                "ANSIBLE_NOCOLOR": "1",
                "ANSIBLE_SSH_ARGS": "-C -o ControlMaster=auto -o ControlPersist=5s",
            },
            cwd=self.folder,
            timeout=UP_TIMEOUT_S,
        )
        said = f"{done.stdout}\n{done.stderr}"
        assert done.returncode == status, said
        assert "WARNING" not in said, said
        assert "PRIVATE KEY" not in said
        return " ".join(said.split())


def recap(said: str) -> dict[str, dict[str, int]]:
    """What Ansible counted, by host."""
    rows = re.findall(r"(host\d) : ((?:\w+=\d+ ?)+)", said.partition("PLAY RECAP")[2])
    return {
        host: {key: int(value) for key, value in re.findall(r"(\w+)=(\d+)", counts)} for host, counts in rows
    }


def tables(hosts: Hosts) -> dict[str, Any]:
    return {
        "fleet": {"name": "pair", "rate_hz": 25.0},
        "formation": {"edges": [[1, 2]], "distance_m": 1.0, "safe_distance_m": 0.2},
        "control": {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5},
        "trajectory": {"kind": "hold"},
        "network": {"routers": [hosts[0].name]},
        "host": {host.name: {"address": host.address} for host in hosts},
        "robot": [
            {"id": k + 1, "x_m": 1.0 * k, "y_m": 0.0, "host": host.name, "reserve": k > 1}
            for k, host in enumerate(hosts)
        ],
    }


@pytest.fixture(scope="module")
def hosts(make_hosts: MakeHosts) -> Hosts:
    return make_hosts(2)


@pytest.fixture(scope="module")
def fleet(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> FleetOnHosts:
    fetch_wheels(hosts[0], cache)
    return FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables(hosts), cache)


@pytest.fixture(scope="module")
def deployment(fleet: FleetOnHosts, tmp_path_factory: pytest.TempPathFactory) -> Deployment:
    return Deployment(fleet, tmp_path_factory.mktemp("deployment"))


def test_without_an_authority_it_says_which_command_makes_it(deployment: Deployment) -> None:
    said = deployment.play(status=2)
    assert re.search("pair has no authority in .*: `handfast keys .*/fleet.toml` makes it", said), said
    assert not any((host.home / ".local").exists() for host in deployment.fleet.hosts)


def test_it_only_looks_when_that_is_asked(deployment: Deployment) -> None:
    deployment.fleet.handfast("keys")
    told = recap(deployment.play("--check"))
    assert [row["changed"] for row in told.values()] == [0, 0]
    assert not any((host.home / ".local").exists() for host in deployment.fleet.hosts)


def test_it_brings_up_what_it_can_reach(deployment: Deployment) -> None:
    fleet = deployment.fleet
    fleet.hosts[1].cut()
    said = deployment.play(status=4)
    fleet.hosts[1].restore()
    told = recap(said)
    assert (told["host1"]["failed"], told["host2"]["unreachable"]) == (0, 1)
    assert [row["unit"] for row in fleet.status().values()] == ["active"] * 3 + ["none"] * 3 + ["active"]


def test_it_brings_up_the_rest(deployment: Deployment) -> None:
    fleet = deployment.fleet
    before = fleet.processes()
    begun = time.monotonic()
    told = recap(deployment.play())
    measured("one more host by Ansible, s", time.monotonic() - begun)
    assert (told["host1"]["changed"], told["host2"]["changed"] > 0) == (0, True)
    assert before < fleet.processes()
    wait_for(
        lambda: {fleet.status()[robot, "agent"]["state"] for robot in (1, 2)} == {"ready"},
        "both are ready",
        30.0,
    )
    for host in fleet.hosts:
        keys = host.home / ".local/share/handfast/fleets/pair/keys"
        assert keys.stat().st_mode & 0o777 == 0o700
        secrets = [path.read_text() for path in keys.glob("*.key")]
        assert len(secrets) == 1 + (host is fleet.hosts[0]), "its robot's, and its router's"
        here = [path for path in deployment.folder.rglob("*") if path.is_file()]
        assert not any(secrets[0].strip().encode() in path.read_bytes() for path in here)


def test_again_there_is_nothing_to_do_and_up_agrees(deployment: Deployment) -> None:
    fleet = deployment.fleet
    before = fleet.processes()
    begun = time.monotonic()
    told = recap(deployment.play())
    measured("Ansible with nothing to do, s", time.monotonic() - begun)
    assert [row["changed"] for row in told.values()] == [0, 0]
    assert fleet.handfast("up").stderr.count("up, nothing to do") == 2
    assert fleet.processes() == before


class Second(FleetOnHosts):
    """The same fleet, for an operator on another computer: with other keys."""

    def environment(self) -> dict[str, str]:
        return super().environment() | {KEYS: str(self.folder / "second")}


def test_another_authority_takes_nothing_over_but_where_that_is_said(
    deployment: Deployment, tmp_path: Path
) -> None:
    fleet = deployment.fleet
    second = Deployment(
        Second(fleet.hosts, fleet.folder, tables(fleet.hosts), fleet.cache), tmp_path / "deployment"
    )
    second.fleet.handfast("keys")

    def rules() -> list[bytes]:
        return [
            (host.home / ".local/share/handfast/fleets/pair/keys/ca.crt").read_bytes() for host in fleet.hosts
        ]

    before, running = rules(), fleet.processes()
    said = second.play(status=2)
    for host in fleet.hosts:
        why = "left as it was: its robots have another authority"
        assert re.search(rf"fatal: \[{host.name}\]: FAILED! => [^!]*{why}", said), said
    assert (rules(), fleet.processes()) == (before, running)
    second.play("-e", "take_over=true")
    assert not set(before) & set(rules())
    deployment.play("-e", "take_over=true")
    assert rules() == before


def test_while_they_drive_one_robot_at_a_time_starts_again(deployment: Deployment, tmp_path: Path) -> None:
    fleet = deployment.fleet
    newer = tmp_path / "newer"
    for package in ("agent", "plant", "bridges", "deploy"):
        shutil.copytree(ROOT / package, newer / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "handfast.py", newer)
    with open(newer / "agent" / "core.py", "a") as stream:
        stream.write("# another version\n")
    upgraded = FleetOnHosts(fleet.hosts, fleet.folder, tables(fleet.hosts), fleet.cache, newer)
    deployment = Deployment(upgraded, tmp_path / "deployment")
    before, running = fleet.status(), fleet.processes()
    out = tmp_path / "run"
    child = fleet.start("drive", "--duration", "300s", "--out", str(out), "--no-report")
    wait_for(lambda: drives(fleet, child), "both drive", 60.0)
    second = Second(fleet.hosts, fleet.folder, tables(fleet.hosts), fleet.cache)
    said = Deployment(second, tmp_path / "second").play("-e", "take_over=true", status=2)
    assert "the fleet drives, and would fall apart with robots of two authorities" in said
    said = deployment.play(status=2)
    assert "robot 1 drives and would have to start again: -e rolling=true" in said
    assert fleet.processes() == running
    deployment.play("-e", "rolling=true")
    wait_for(lambda: drives(fleet, child), "both drive on", 10.0)  # the machine also starts again late once
    after = fleet.status()
    assert len({row["version"] for row in after.values()}) == 1
    assert {row["version"] for row in after.values()}.isdisjoint({row["version"] for row in before.values()})
    assert not fleet.processes() & running
    for host in fleet.hosts:
        kept = {
            path.name for path in (host.home / ".local/share/handfast/versions").iterdir() if path.is_dir()
        }
        assert kept == {row["version"] for row in after.values()}, "those of before are removed"
    child.send_signal(signal.SIGINT)
    child.communicate(timeout=60.0)


def drives(fleet: FleetOnHosts, child: subprocess.Popen[str]) -> bool:
    assert child.poll() is None, child.communicate()
    rows = fleet.status()
    return {rows[robot, "agent"]["state"] for robot in (1, 2)} == {"running"}


def test_down_leaves_nothing_of_it(deployment: Deployment) -> None:
    deployment.fleet.handfast("down")
    assert not deployment.fleet.processes()


def test_each_host_that_will_not_do_says_so_and_the_others_run(
    make_hosts: MakeHosts, cache: Path, tmp_path: Path
) -> None:
    hosts = make_hosts([Setup(), Setup(), *(setup for setup, _ in WRONG)])
    fetch_wheels(hosts[0], cache)
    raw = tables(hosts) | {"network": {"security": "off"}}
    raw["host"]["host6"]["python"] = "python3"
    fleet = FleetOnHosts(hosts, tmp_path, raw, cache)
    said = Deployment(fleet, tmp_path / "deployment").play(status=2)
    for number, (_, why) in enumerate(WRONG, 3):
        assert re.search(rf"fatal: \[host{number}\]: FAILED! => [^!]*{re.escape(why)}", said), said
    assert len(fleet.processes()) == 6
    assert all(row["failed"] == 0 for host, row in recap(said).items() if host in ("host1", "host2"))
