"""A fleet on a host whose plant and law are from a package of somebody else's."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Callable
from math import hypot
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.console.data_files import FLEETS
from handfast.plant.backend import Place
from handfast.plant.server import PoseFile
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.hosts import Hosts
from tests.process.examples import installed
from tests.process.harness import ROOT

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]


class WithExamples(FleetOnHosts):
    """A fleet whose operator has the package of examples installed, in `folder`."""

    def environment(self) -> dict[str, str]:
        return {**super().environment(), "PYTHONPATH": f"{ROOT}:{self.folder / 'site'}"}


def tables(hosts: Hosts) -> dict[str, Any]:
    """Two robots on the first host, with a plant and a law of others."""
    raw = tomllib.loads((FLEETS / "pair.toml").read_text(encoding="utf-8"))
    raw["host"] = {hosts[0].name: {"address": hosts[0].address}}
    raw["fleet"] |= {"rate_hz": 25.0, "duration_s": 20.0}
    raw["robot_defaults"] = raw.get("robot_defaults", {}) | {
        "plant": "drag", "drag": {"slip": 0.05}
    }  # fmt: skip
    for robot in raw["robot"]:
        robot["host"] = hosts[0].name
    raw["control"] = raw.get("control", {}) | {
        "law": "spring", "spring": {"stiffness": 2.0}, "wrench_timeout_s": 0.5, "plant_timeout_s": 0.5
    }  # fmt: skip
    raw["network"] = raw.get("network", {}) | {"security": "off"}
    return raw


@pytest.fixture(scope="module")
def fleet(
    make_hosts: Callable[[int], Hosts], cache: Path, tmp_path_factory: pytest.TempPathFactory
) -> FleetOnHosts:
    """Up."""
    hosts = make_hosts(1)
    fetch_wheels(hosts[0], cache)
    folder = tmp_path_factory.mktemp("fleet")
    with installed(folder / "site"):
        found = WithExamples(hosts, folder, tables(hosts), cache)
    told = found.handfast("up", timeout=UP_TIMEOUT_S)
    assert told.stdout.count("stopped: stop: the fleet came up") == 2
    return found


def test_it_drives(fleet: FleetOnHosts) -> None:
    said = fleet.handfast("drive", "--out", "drive", "--no-report").stdout
    assert "formation within 5 %" in said
    text = (fleet.folder / "drive" / "fleet.toml").read_text()
    assert 'plant = "handfast_examples.drag_plant:Drag"' in text


def test_a_body_stands_where_it_was_when_its_process_comes_back(fleet: FleetOnHosts) -> None:
    file = fleet.hosts[0].home / ".local/share/handfast/fleets/pair/state/robot-1.pose"

    def place() -> Place:
        copy = fleet.folder / "pose"
        shutil.copyfile(file, copy)
        found = PoseFile(copy).place
        assert found is not None
        return found

    before, process = place(), fleet.process(1, "plant")
    start = load_fleet(FLEETS / "pair.toml").robot(1)
    assert hypot(before[0] - start.x_m, before[1] - start.y_m) > 0.1, "it has driven"
    fleet.hosts[0].run("systemctl --user kill -s KILL handfast-pair-robot-1-plant", check=True)
    fleet.started_again(1, "plant", process)
    assert "nothing to do" in fleet.handfast("up").stderr
    assert place() == pytest.approx(before, abs=1e-3)


def test_a_change_of_the_package_is_a_new_version(fleet: FleetOnHosts) -> None:
    before = fleet.processes()
    assert "nothing to do" in fleet.handfast("up").stderr
    assert fleet.processes() == before
    plant = fleet.folder / "site/handfast_examples/drag_plant.py"
    plant.write_text(plant.read_text() + "\n# a change\n")
    fleet.handfast("up", timeout=UP_TIMEOUT_S)
    assert not fleet.processes() & before


def test_what_cannot_be_sent_or_does_not_load_there_is_one_line(fleet: FleetOnHosts) -> None:
    site = fleet.folder / "site"
    plant, compiled = site / "handfast_examples/drag_plant.py", site / "handfast_examples/core.so"
    whole = plant.read_text()
    (site / "only_here.py").write_text("")
    plant.write_text(f"import only_here\n{whole}")
    told = fleet.handfast("up", status=1, timeout=UP_TIMEOUT_S)
    assert "python: ModuleNotFoundError: No module named 'only_here'" in told.stdout + told.stderr
    plant.write_text(whole)
    compiled.write_text("\0")
    told = fleet.handfast("up", status=2)
    compiled.unlink()
    assert told.stderr.count("handfast_examples/core.so is compiled for this machine") == 1
    assert "nothing to do" in fleet.handfast("up").stderr
