"""Units of a robot: what they run, and how systemd reads that."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.security.credentials import Files
from handfast.agent.security.identity import of_robot
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.hosts import systemd_units
from handfast.deploy.hosts.systemd_units import Places, arguments, roles, router_units, unit, unit_name
from tests.unit.agent.fleet.test_hosts import FLEET, HOSTS, LEFT, RIGHT, ROUTERS

PLACES = Places(
    "/r/versions/1",
    "/r/fleets/two/fleet.toml",
    None,
    "/r/fleets/two/recordings",
    "/r/fleets/two/state",
    "/r/fleets/two/orders",
)
DATUM = "[datum]\nlatitude_deg = 1\nlongitude_deg = 1\n"
BRIDGE = 'plant = "mavlink"\nmavlink = { connection = "udpin:0.0.0.0:14550" }'


def fleet(more: str = "") -> Fleet:
    return parse_fleet(FLEET % (DATUM + more, "", BRIDGE), source="here")


def settings(text: str) -> dict[str, str]:
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line and not line.startswith("#"))


def test_each_process_is_started_for_its_robot_from_the_installed_version():
    agent, plant, bridge, recorder = (
        arguments(fleet(), robot, role, PLACES)
        for robot, role in ((1, "agent"), (1, "plant"), (2, "plant"), (1, "recorder"))
    )
    for words, module in (
        (agent, "handfast.agent"),
        (plant, "handfast.plant"),
        (bridge, "handfast.bridges.mavlink"),
    ):
        assert words[:4] == ["/r/versions/1/bin/python", "-P", "-m", module]
    assert agent[4:8] == ["--fleet", "/r/fleets/two/fleet.toml", "--robot", "1"]
    assert agent[8:] == plant[8:10] == bridge[8:] == ["--orders", "/r/fleets/two/orders"]
    assert "--orders" not in recorder
    assert plant[-2:] == ["--pose-file", "/r/fleets/two/state/robot-1.pose"]
    assert "--pose-file" not in bridge
    assert recorder[-2:] == ["--folder", "/r/fleets/two/recordings/robot-1"]


def test_a_router_is_started_with_its_own_key() -> None:
    routed = parse_fleet(FLEET % (HOSTS + ROUTERS % "right", LEFT, RIGHT), source="here")
    left, right = routed.hosts
    places = replace(PLACES, keys="/r/fleets/two/keys")
    assert router_units(routed, left, places) == {}
    ((name, text),) = router_units(routed, right, places).items()
    assert name == "handfast-two-router.service"
    said = settings(text)
    assert said["ExecStart"] == (
        "/r/versions/1/bin/python -P -m handfast.agent.runtime.router "
        "--fleet /r/fleets/two/fleet.toml --number 1 "
        "--keys /r/fleets/two/keys"
    )
    assert '# reads: ["/r/fleets/two/keys/two.router.1.crt"]' in text
    assert "# writes: []" in text
    assert (said["Restart"], said["SyslogIdentifier"]) == ("always", "handfast-two-router")
    assert float(said["WatchdogSec"]) == systemd_units.WATCHDOG_S["router"]


def test_what_runs_can_be_read_from_the_file_again():
    text = unit(fleet(), 1, "agent", PLACES)
    found = re.search(r"^# runs: (\[.*\])$", text, re.MULTILINE)
    assert found is not None
    assert json.loads(found[1]) == arguments(fleet(), 1, "agent", PLACES)


def test_a_unit_says_which_certificate_its_processes_read():
    secured = Places("/v", "/f", "/r/keys", "/r", "/s", "/o")
    wanted = Files(Path("/r/keys"), of_robot("two", 1)).certificate
    for role in roles(fleet()):
        assert f"# reads: {json.dumps([str(wanted)])}\n" in unit(fleet(), 1, role, secured)
        assert "# reads: []\n" in unit(fleet(), 1, role, PLACES)


def test_a_unit_starts_its_process_again_but_not_one_that_was_given_nonsense():
    said = settings(unit(fleet(), 1, "agent", PLACES))
    assert said["Type"] == "notify"
    assert said["Restart"] == "always"
    assert said["RestartPreventExitStatus"] == "2"
    assert said["StartLimitIntervalSec"] == "0"
    assert said["WatchdogSignal"] == "SIGKILL"
    assert float(said["WatchdogSec"]) == systemd_units.WATCHDOG_S["agent"]
    assert int(said["LimitNOFILE"]) > 4096, "anybody can open connections to it"
    assert {"MemoryMax", "TasksMax", "TimeoutStopSec", "SyslogIdentifier"} <= said.keys()


@pytest.mark.parametrize(
    ("folder", "shown"),
    [
        ("/home/a b/x", '"/home/a b/x/bin/python"'),
        ("/home/50%/x", "/home/50%%/x/bin/python"),
        ("/home/$HOME/x", "/home/$$HOME/x/bin/python"),
        ('/home/"q"/x', '"/home/\\"q\\"/x/bin/python"'),
        ("/home/b\\c/x", '"/home/b\\\\c/x/bin/python"'),
    ],
)
def test_paths_are_written_so_that_systemd_reads_them_as_they_are(folder: str, shown: str):
    text = unit(fleet(), 1, "agent", Places(folder, "/f", None, "/r", "/s", "/o"))
    assert settings(text)["ExecStart"].startswith(f"{shown} -P -m handfast.agent")


def test_a_bridge_starts_whether_its_serial_port_is_there_or_not() -> None:
    """It waits by itself, and says for what: a unit that waits for a device does neither."""
    rovers = load_fleet(FLEETS / "rovers_on_hosts.toml")
    text = unit(rovers, 1, "plant", PLACES)
    assert ".device" not in text
    assert "PrivateDevices" not in text
    assert "DevicePolicy" not in text
    assert "PrivateDevices=yes" in unit(rovers, 1, "agent", PLACES)


def test_the_recorder_can_be_left_out():
    assert roles(fleet()) == ("plant", "agent", "recorder")
    assert roles(fleet("[recording]\nmax_mb = 0")) == ("plant", "agent")


def test_the_keys_are_named_not_shown():
    words = arguments(fleet(), 1, "agent", Places("/v", "/f", "/r/keys", "/r", "/s", "/o"))
    assert words[words.index("--keys") + 1] == "/r/keys"


def test_names_tell_fleet_robot_and_process():
    assert unit_name("two", 12, "agent") == "handfast-two-robot-12-agent.service"
