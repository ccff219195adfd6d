"""Three rovers, each with a computer of its own: bridges on serial ports, from `up` to `down`. Each test goes
on from the one before."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import time
import tomllib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.supervision.orders import AWAITED
from handfast.bridges.mavlink.bridge.backend import BEGUN_LATE
from handfast.bridges.mavlink.simulator.settings import settings_of
from handfast.deploy.console.data_files import FLEETS
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.host import Host, Setup
from tests.hosts.hosts import Hosts
from tests.hosts.operated_fleet import states
from tests.process.harness import measured, wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]
MakeHosts = Callable[[int | Sequence[Setup]], Hosts]
HAND_OVER: Final = Path(__file__).with_name("hand_over.py")
CABLE: Final = Path(__file__).parents[1] / "rover_serial.py"
PORT: Final = "/dev/shm/serial0"
"""Where each host has its own files below /dev: all of them have their vehicle at the same name."""
NAME: Final = "rovers_on_hosts"
DISTANCE_M: Final = 6.0
"""They may be out of sight for long on a busy machine, and must not have been able to meet meanwhile."""
OFFSETS: Final = [[0.0, 3.464], [-3.0, -1.732], [3.0, -1.732]]
CUT_S: Final = 5.0
HOME_MB: Final = 1000
"""In memory: what `up` installs is written and removed faster so."""
SECOND_S: Final = 65.0
DRIVES: Final = {"running", "degraded"}


def tables(hosts: Sequence[Host]) -> dict[str, Any]:
    """The first three robots of the bundled fleet, near their places."""
    raw = tomllib.loads((FLEETS / f"{NAME}.toml").read_text(encoding="utf-8"))
    raw["host"] = {host.name: {"address": host.address} for host in hosts}
    raw["fleet"]["duration_s"] = 40.0
    raw["formation"] |= {
        "edges": [[1, 2], [1, 3], [2, 3]],
        "distance_m": DISTANCE_M,
        "offsets": OFFSETS,
    }
    raw["trajectory"]["start_m"] = [0.0, 0.0]
    raw["robot_defaults"]["mavlink"] |= {"connection": PORT}
    raw["robot"] = raw["robot"][:3]
    for robot, host, (x, y) in zip(raw["robot"], hosts, OFFSETS, strict=True):
        robot |= {"host": host.name, "x_m": x - 0.6, "y_m": y + 0.2, "heading_rad": "0deg"}
    return raw


class Rovers(FleetOnHosts):
    """A fleet with vehicles."""

    @property
    def read(self) -> Fleet:
        return resolved(parse_fleet(self.file.read_text(), source="here"))

    @staticmethod
    def python(host: Host) -> str:
        """That of what is installed there."""
        (version,) = (host.home / ".local/share/handfast/versions").iterdir()
        return f"{host.environment['HOME']}/.local/share/handfast/versions/{version.name}/bin/python"

    def switch_on(self, robot: int, *more: str) -> None:
        """The vehicle of a robot, at the serial port of its host."""
        host, settings = self.host_of(robot), settings_of(self.read, robot)
        python, at = self.python(host), settings.home
        words = [
            *(python, "-P", "-m", "handfast.bridges.mavlink.simulator", "--listen=tcp:127.0.0.1:5760"),
            *("--listen=tcp:127.0.0.1:5762", "--warm", *more),
            f"--system={settings.system}",
            f"--home={at.latitude_deg:.9f},{at.longitude_deg:.9f},{at.altitude_m:.3f},90",
        ]
        (host.home / CABLE.name).write_bytes(CABLE.read_bytes())
        for begin in (words, [python, CABLE.name, PORT, "5760"]):
            host.run(f"setsid {shlex.join(begin)} </dev/null >>/run/rover.log 2>&1 &", check=True)

    def switch_off(self, robot: int) -> None:
        """The vehicle and its cable are gone."""
        host = self.host_of(robot)
        for words in ("-m handfast.bridges.mavlink.simulator", CABLE.name):
            for pid in host.pids(words):
                os.kill(pid, signal.SIGKILL)

    def hand_over(self, robot: int) -> None:
        """Its operator puts it into GUIDED and arms it."""
        host = self.host_of(robot)
        (host.home / HAND_OVER.name).write_bytes(HAND_OVER.read_bytes())
        host.run([self.python(host), HAND_OVER.name, "5762"], check=True)

    def state(self, robot: int) -> str:
        """What the unit of its bridge is."""
        unit = f"handfast-{self.name}-robot-{robot}-plant"
        return self.host_of(robot).run(["systemctl", "--user", "is-active", unit]).stdout.strip()


def told_to_go_on(fleet: Rovers, robot: int) -> None:
    """Waits until a robot waits for somebody to say so, and says it."""

    seen: dict[str, None] = {}

    def waits() -> bool:
        row = fleet.status()[robot, "agent"]
        seen[f"{row['state']}: {row['reason']}"] = None
        return row["state"] == "released" and row["reason"].endswith(AWAITED)

    wait_for(waits, f"robot {robot} waits", 60.0, lambda: "\n".join(seen))
    fleet.handfast("resume", "--robot", str(robot), status=None)


@pytest.fixture(scope="module")
def fleet(make_hosts: MakeHosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Rovers:
    """Not up yet, and no vehicle is switched on."""
    hosts = make_hosts([Setup(home_mb=HOME_MB)] * 3)
    fetch_wheels(hosts[0], cache)
    found = Rovers(hosts, tmp_path_factory.mktemp("fleet"), tables(list(hosts)), cache)
    found.handfast("check")
    found.handfast("keys")
    return found


def test_up_says_which_ports_are_not_there_and_bridges_wait_for_them(fleet: Rovers) -> None:
    told = fleet.handfast("up", timeout=UP_TIMEOUT_S)
    for robot, host in enumerate(fleet.hosts, 1):
        assert f"warning: {host.name}: robot {robot}: {PORT}: is not there, " in told.stderr
    assert {fleet.state(robot) for robot in (1, 2, 3)} == {"active"}
    for robot in (1, 2, 3):
        fleet.switch_on(robot)
    assert "is not there" not in fleet.handfast("up").stderr
    told = fleet.handfast("preflight")
    first, *rest = told.stdout.splitlines()
    assert first.split() == ["check", "1", "2", "3"]
    assert rest[0].split() == ["link", ".", ".", "."]
    assert "! robots 1, 2 and 3: FS_CRASH_CHECK: 0: it drives on against an obstacle" in told.stdout
    assert rest[-2].startswith("CLEAR, with ")
    files = [fleet.folder / f"{NAME}-parameters/robot-{robot}.param" for robot in (1, 2, 3)]
    assert all("\nFS_CRASH_CHECK,1\n" in file.read_text() for file in files)


def test_one_whose_host_is_gone_is_named_and_the_others_are_looked_at(fleet: Rovers) -> None:
    gone = fleet.hosts[2]
    gone.cut()
    try:
        with fleet.start("preflight") as child, ThreadPoolExecutor() as pool:
            list(pool.map(fleet.hand_over, (1, 2, 3)))  # meanwhile
            out, err = child.communicate(timeout=60.0)
    finally:
        gone.restore()
    assert child.returncode == 1, out + err
    assert "X robot 3: bridge: its host host3 cannot be asked: " in out
    assert ["link", ".", "."] in [line.split() for line in out.splitlines()]
    assert "BLOCKED: robot 3: bridge" in out
    assert "Robots 1 and 2: parameters to change are in " in out


def test_they_drive_through_a_lost_host_and_a_killed_bridge(fleet: Rovers) -> None:
    child = fleet.start("drive", "--out", "drive", "--no-report")
    wait_for(lambda: set(states(fleet).values()) == {"running"}, "all drive", 40.0)
    looked = json.loads(fleet.handfast("preflight", "--json", status=None).stdout)
    assert [len(robot["lines"]) > 10 for robot in looked["robots"]] == [True] * 3
    fleet.hosts[1].cut()
    time.sleep(CUT_S)
    fleet.hosts[1].restore()
    (bridge,) = fleet.host_of(3).pids("-m handfast.bridges.mavlink ")
    os.kill(bridge, signal.SIGKILL)
    told_to_go_on(fleet, 3)
    out, err = child.communicate(timeout=90.0)
    said = out + err
    assert "Traceback" not in said
    assert child.returncode == 0, said
    for words in (
        "no connection to robot 2's agent",
        r"degraded: without robot 2 \(no connection to its agent\)",
        "connected again: (.*, )?robot 2's agent",  # both at once, or one after the other
        "connected again: (.*, )?robot 2's plant",
        "no connection to robot 3's plant",
        "robot 3 is in fault: plant silent for ",
        "connected again: robot 3's plant",
        "robot 3 is back: running",
    ):
        assert re.search(words, said), f"{words}\n{said}"
    gaps = re.findall(r"Robot (\d) sent no pose .*, in which nothing can have happened", out)
    assert set(gaps) == {"2", "3"}, "for who only hears: robot 2 itself knows better"
    assert "No connection to robot 2's agent from " in out
    assert "`handfast fetch` has what they recorded" in out
    assert "No connection to robot 3's plant from " in out
    assert "formation within 5 % after " in out


def test_what_they_recorded_is_fetched_and_told(fleet: Rovers) -> None:
    fetched = fleet.handfast("fetch", "--out", "fetched")
    assert "messages of 3 robots in fetched" in fetched.stdout
    assert (fleet.folder / "fetched/report.html").exists()
    metrics = json.loads((fleet.folder / "fetched/metrics.json").read_text())
    assert metrics["verdict"]["passed"], json.dumps(metrics["verdict"], indent=1)
    told = metrics["verdict"]["warnings"]
    (gap,) = (each for each in told if " sent no pose " in each)
    assert gap.startswith("Robot 3 "), "and robot 2 recorded while it was cut off"
    (released,) = (each for each in told if " released " in each)
    assert released.startswith("Robot 3 "), "until somebody said resume"
    assert BEGUN_LATE in released
    assert metrics["min_distance_m"]["any"] > 2.0
    measured("the closest pair, m", metrics["min_distance_m"]["any"])


def test_over_a_bad_radio_they_drive_on_after_a_pulled_cable_and_a_reboot(fleet: Rovers) -> None:
    radio = ("--loss", "30%", "--delay", "300ms", "--name", "radio", "--stay")
    fleet.by_name("faults", "set", str(fleet.file), *radio)
    child = fleet.start("drive", "--out", "second", "--no-report", "--duration", f"{SECOND_S:g}")
    wait_for(lambda: set(states(fleet).values()) <= DRIVES, "all drive", 40.0)
    fleet.switch_off(2)
    wait_for(lambda: states(fleet)[2] == "fault", "its bridge says so", 10.0)
    time.sleep(CUT_S)
    fleet.switch_on(2, "--hand-over")
    told_to_go_on(fleet, 2)
    wait_for(lambda: states(fleet)[2] in DRIVES, "the cable is back, and it drives on", 20.0)
    fleet.hosts[2].reboot()
    fleet.handfast("up", timeout=UP_TIMEOUT_S)
    fleet.switch_on(3, "--hand-over")
    told_to_go_on(fleet, 3)
    wait_for(
        lambda: states(fleet)[3] in DRIVES,
        "its computer is up again, and it drives on",
        60.0,
        lambda: fleet.handfast("status", status=None).stdout,
    )
    out, err = child.communicate(timeout=90.0)
    assert "Traceback" not in out + err
    assert "robot 2 is in fault: " in out + err
    assert "no connection to robot 3's agent" in out + err
    told = fleet.handfast("fetch", "--out", "fetched2")
    assert "messages of 3 robots in fetched2" in told.stdout
    metrics = json.loads((fleet.folder / "fetched2/metrics.json").read_text())
    measured("the closest pair, m", metrics["min_distance_m"]["any"])
    sent, lost = metrics["messages"]["sent"], metrics["messages"]["lost"]
    measured("of the hand states that agents sent, lost, %", 100.0 * lost / sent)
    assert lost > 0.15 * sent, "the radio was bad"
    assert metrics["min_distance_m"]["any"] > 1.0, metrics["verdict"]
    assert not [each for each in metrics["verdict"]["reasons"] if "came within" in each]
    events = (fleet.folder / "fetched2/events.txt").read_text()
    assert "robot 2 fault: " in events
    fleet.handfast("down")
    assert fleet.processes() == set()
