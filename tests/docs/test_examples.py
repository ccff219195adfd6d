"""The package of examples is as short as its documents say, and what else these show of plugins works."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.common import plugins
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis.couplings import own_law_of
from handfast.deploy.check.own_plant import check_own_plants
from handfast.deploy.console.arguments import fleet_path
from handfast.deploy.simulate.simulation import Simulation

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = DOCS / "examples/handfast_examples"


@pytest.mark.parametrize(
    ("name", "below"), [("drag_plant.py", 60), ("spring_law.py", 40), ("consensus_law.py", 60)]
)
def test_an_example_is_short(name: str, below: int) -> None:
    assert len((EXAMPLES / name).read_text().splitlines()) < below


def test_the_law_that_is_shown_drives_and_gives_its_modes() -> None:
    law, modes = re.findall(
        r"```python\n(.*?)```", (DOCS / "plugins.md").read_text().split("## A law")[1], re.S
    )[:2]
    made: dict[str, Any] = {}
    exec(law + "\n" + modes, made)
    plugins.register("Follow", made["Follow"])
    try:
        fleet = resolved(load_fleet(fleet_path("delta"), ["control.law=Follow", "fleet.duration_s=2"]))
        found = own_law_of(fleet)
        assert found is not None
        assert len(found.modes(None)) == 12  # type: ignore[arg-type]
        driven = Simulation(fleet)
        driven.run(lambda _: True)
        assert {agent.state for agent in driven.agents} <= {State.STOPPING, State.STOPPED}
    finally:
        plugins._registered.clear()


def test_the_settings_and_the_plant_that_are_shown_work() -> None:
    settings, plant = re.findall(r"```python\n(.*?)```", (DOCS / "plugins.md").read_text(), re.S)[:2]
    made: dict[str, Any] = {"__name__": __name__}
    exec(settings + plant, made)
    made["Sledge"].section, made["Sledge"].Settings = "drag", made["Settings"]
    plugins.register("Sledge", made["Sledge"])
    try:
        overrides = ["robot_defaults.plant=Sledge", "robot_defaults.drag.drag=2"]
        fleet = load_fleet(fleet_path("pair"), overrides)
        assert fleet.robot(1).section(made["Settings"]) == made["Settings"](2.0)
        assert [finding.level for finding in check_own_plants(fleet)] == ["info"]
    finally:
        plugins._registered.clear()
