"""agent.fleet.plants: kinds of plant, ours and those of others."""

from __future__ import annotations

import subprocess
import sys

import pytest

from agent.common.plugins import PluginError
from agent.fleet import plants
from deploy.console.data_files import FLEETS


def test_ours() -> None:
    assert plants.kind("unicycle") is plants.KINDS["unicycle"]
    assert [entry.key for entry in plants.built_in_sections()] == ["mavlink"]


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
        "import sys, agent.__main__, plant.__main__; from agent.fleet import plants; "
        "from agent.fleet.loading import load_fleet; fleet = load_fleet(sys.argv[1]); "
        "plants.attribute(fleet.robot(1).kind.body); "
        "print(sorted({'importlib.metadata', 'plant.plugin', 'difflib', 'handfast'} & set(sys.modules)))"
    )
    found = subprocess.run(
        [sys.executable, "-c", code, str(FLEETS / "delta.toml")], capture_output=True, text=True, check=True
    )
    assert found.stdout == "[]\n"
