"""handfast.agent.fleet.plants: kinds of plant, ours and those of others."""

from __future__ import annotations

import subprocess
import sys
from math import inf

import pytest

from handfast.agent.common.plugins import PluginError
from handfast.agent.fleet import plants
from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.console.data_files import FLEETS


def test_ours() -> None:
    assert plants.kind("unicycle") is plants.KINDS["unicycle"]
    assert [entry.key for entry in plants.built_in_sections()] == ["mavlink"]


def test_how_fast_a_body_turns_is_a_matter_of_its_kind() -> None:
    fleet = load_fleet(FLEETS / "pair.toml", ["robot.2.plant=mavlink", *OF_A_ROVER])
    assert fleet.robot(1).yaw_rate_max == inf
    assert fleet.robot(2).yaw_rate_max == 0.7


OF_A_ROVER = (
    "robot.2.mavlink.connection=tcp:10.0.0.1:5760", "robot.2.mavlink.max_yaw_rate_radps=0.7",
    "datum.latitude_deg=-35.36", "datum.longitude_deg=149.16", "fleet.rate_hz=20",
    "control.plant_timeout_s=0.5", "formation.distance_m=3", "formation.offsets=[[0,0],[3,0]]",
    "robot.2.hand_offset_m=0.4", "robot.2.x_m=3",
)  # fmt: skip


def test_no_kind() -> None:
    wrong = 'must be one of "unicycle", "mavlink", or a plugin, got "unicyle"; did you mean "unicycle"?'
    with pytest.raises(PluginError) as caught:
        plants.kind("unicyle")
    assert str(caught.value) == wrong
    with pytest.raises(PluginError, match='or a plugin, got "tractor": no plugin has the name "tractor"'):
        plants.kind("tractor")
    with pytest.raises(PluginError, match=r"^a\.b:C: there is no module a"):
        plants.kind("a.b:C")


def test_a_fleet_without_plugins_loads_nothing_of_them() -> None:
    code = (
        "import sys, agent.__main__, plant.__main__; from handfast.agent.fleet import plants; "
        "from handfast.agent.fleet.loading import load_fleet; fleet = load_fleet(sys.argv[1]); "
        "plants.attribute(fleet.robot(1).kind.body); "
        "print(sorted({'importlib.metadata', 'handfast.plant.plugin', 'difflib'} & set(sys.modules)))"
    )
    found = subprocess.run(
        [sys.executable, "-c", code, str(FLEETS / "delta.toml")], capture_output=True, text=True, check=True
    )
    assert found.stdout == "[]\n"
