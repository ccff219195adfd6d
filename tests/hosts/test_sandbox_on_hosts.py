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

from deploy.console.data_files import FLEETS
from deploy.hosts.sandboxing import TRIED
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.host import Host, Setup
from tests.hosts.hosts import Hosts
from tests.hosts.programs import python_to_lend
from tests.process.harness import measured

pytestmark = pytest.mark.timeout(400)
MakeHosts = Callable[[int | Sequence[Setup]], Hosts]
PROBE: Final = Path(__file__).with_name("sandbox_probe.py")
FOLDER: Final = ".local/share/handfast/fleets/pair"
FILTERED: Final = {"packets", "can bus", "namespace", "trace", "set-user-ID", "realtime"}
"""What filters of system calls refuse."""
SHUT: Final = {
    *("write home", "write a unit", "write the program", "write keys", "read ssh", "systemd", "bus"),
    *("write a control group", "see others"),
}
"""What namespaces keep out of reach."""


def tables(hosts: Hosts) -> dict[str, Any]:
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
    found = FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables(hosts), cache)
    found.handfast("keys")
    told = found.handfast("up", timeout=UP_TIMEOUT_S)
    assert "namespaces" not in told.stdout + told.stderr
    return found


def unit_text(host: Host, robot: int, role: str) -> str:
    return (host.home / f".config/systemd/user/handfast-pair-robot-{robot}-{role}.service").read_text()


def probed(hosts: Hosts, host: Host, text: str) -> dict[str, str]:
    """What a process may do that a unit of this text starts: "" or why not, by what was tried."""
    home = host.environment["HOME"]
    folders = [path.replace("~", home) for path in json.loads(re.findall(r"^# writes: (.*)$", text, re.M)[0])]
    words = ["/usr/bin/python3", "-I", f"{home}/probe.py", *folders]
    text = re.sub(r"^ExecStart=.*$", f"ExecStart={shlex.join(words)}", text, flags=re.M)
    text = text.replace("Restart=always", f"Restart=no\nStandardOutput=truncate:{home}/probe.json")
    (host.home / "probe.py").write_bytes(PROBE.read_bytes())
    (host.home / ".config/systemd/user/probe.service").write_text(text)
    (host.home / ".ssh").mkdir(exist_ok=True)
    host.run(f"chown -R {host.uid}:{host.uid} .ssh probe.py; rm -f /tmp/others; touch /run/serial", check=True)
    done = hosts.operator.ssh(host, "systemctl --user daemon-reload && systemctl --user start probe")
    assert done.returncode == 0, done.stderr + host.run("journalctl -q -n 20").stdout
    times = host.run("systemctl --user show probe -P ExecMainStartTimestampMonotonic -P ActiveEnterTimestampMonotonic")
    begun, ready = (int(line) for line in times.stdout.split())
    found: dict[str, str] = json.loads((host.home / "probe.json").read_text())
    found["ready, ms"] = str((ready - begun) // 1000)
    assert all(not found[f"write {folder}"] for folder in folders) and folders, found
    return found


def refused(found: dict[str, str]) -> set[str]:
    return {name for name, why in found.items() if why and name != "ready, ms"}


@pytest.mark.parametrize("robot", [1, 2])
@pytest.mark.parametrize("role", ["agent", "plant", "recorder"])
def test_a_process_can_do_what_it_needs_and_no_more(fleet: FleetOnHosts, robot: int, role: str) -> None:
    host = fleet.host_of(robot)
    found = probed(fleet.hosts, host, unit_text(host, robot, role))
    print(robot, role, found)
