"""handfast.agent.fleet.plugin_tables: tables of plugins are read, checked, inherited and written as ours
are."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
import tomli_w

from handfast.agent.common import plugins
from handfast.agent.common.settings import about, setting
from handfast.agent.control.own_law import Law
from handfast.agent.fleet.loading import digest, law_name, parse_fleet, to_dict
from handfast.agent.fleet.model import FleetError
from handfast.plant.backend import Plant
from tests.unit.agent.fleet.fleet_texts import SMALL, problems, small


@dataclass(frozen=True)
class DragSettings:
    """How it slips."""

    slip: float = setting(0.1, "Slip.", unit="ratio", ge=0, lt=1)
    tau_s: float = setting(0.5, "Time constant.", unit="s", gt=0, le=10)


@dataclass(frozen=True)
class SpringSettings:
    stiffness: float = field(metadata=about("Stiffness.", unit="1/s2", ge=0, le=100))


@dataclass(frozen=True)
class RangeSettings:
    low: float = setting(0, "From.", ge=0)
    high: float = setting(1.0, "To.", ge=0)

    def __post_init__(self) -> None:
        if self.low >= self.high:
            raise ValueError("low must be\nbelow high")


class Drag(Plant):
    section = "drag"
    Settings = DragSettings


class Tow(Drag):
    section = "drag"
    Settings = SpringSettings


class Mass(Drag):
    section = "mass_kg"


class Range(Drag):
    section = "range"
    Settings = RangeSettings


class Spring(Law):
    section = "spring"
    Settings = SpringSettings


DRAG = SMALL.replace("mass_kg = 8", 'mass_kg = 8\nplant = "drag"\n[robot_defaults.drag]\ntau_s = 2.0')


@pytest.fixture(autouse=True)
def _known() -> Iterator[None]:
    for name, plugin in {"drag": Drag, "tow": Tow, "mass": Mass, "range": Range, "spring": Spring}.items():
        plugins.register(name, plugin)
    yield
    plugins._registered.clear()


def test_a_plants_table_is_inherited_set_and_written_again() -> None:
    fleet = small("robot.7.drag.slip=30%", "robot.5.plant=unicycle", text=DRAG)
    assert fleet.robot(3).section(DragSettings) == DragSettings(0.1, 2.0)
    assert fleet.robot(7).section(DragSettings) == DragSettings(0.3, 2.0)
    assert fleet.robot(5).section(DragSettings) is None, "another kind of plant"
    again = parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again")
    assert again == fleet
    assert digest(again) == digest(fleet) != digest(small(text=DRAG))
    assert pickle.loads(pickle.dumps(fleet)) == fleet  # noqa: S301 (our own bytes)
    assert hash(fleet)


def test_a_default_is_the_number_that_a_file_would_give() -> None:
    fleet = small("robot_defaults.plant=range")
    again = parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again")
    assert again == fleet
    assert digest(again) == digest(fleet)


def test_the_order_of_overrides_does_not_matter() -> None:
    one, other = "robot_defaults.plant=drag", "robot_defaults.drag.slip=0.2"
    fleet = small(one, other)
    assert fleet == small(other, one)
    assert fleet.robot(3).section(DragSettings) == DragSettings(0.2)
    assert small(one).robot(3).section(DragSettings) == DragSettings(), "defaults where none is given"


def test_a_laws_table() -> None:
    fleet = small("control.spring.stiffness=3", law="spring")
    assert (fleet.control.law, law_name(fleet.control)) == ("spring", "spring")
    assert fleet.control.section(SpringSettings) == SpringSettings(3.0)
    assert parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again") == fleet
    text = SMALL + '[control]\nlaw = "spring"\nspring = { stiffness = 3 }\n'
    assert small(text=text) == fleet
    plain = SMALL + '[control]\nlaw = "spring"\n'
    assert small(law="joint", text=plain).control.law is None, "a preset is a law as well"


def test_a_law_of_ours_has_a_name_in_the_same_place():
    """So one axis of a sweep compares ours with those of others."""
    text = SMALL + '[control]\nlaw = "spring"\nkp = 3.0\nspring = { stiffness = 3 }\n'
    ours = text.replace("spring = { stiffness = 3 }", "")
    fleet = small("control.law=edge", text=ours)
    assert (fleet.control.law, fleet.control.coupling, fleet.control.kp) == (None, "edge", 1.0)
    written = small(text=ours.replace('"spring"', '"edge"'))
    assert (written.control.coupling, written.control.kp) == ("edge", 3.0), "a file's own values hold"
    assert small("control.kp=2", "control.law=joint", text=ours).control.kp == 2.0
    assert not small("control.law=paper", text=ours).avoidance.enabled


def test_a_recording_is_looked_at_where_its_plugins_are_not():
    text = DRAG.replace('"drag"', '"not.here:Drag"') + (
        '[control]\nlaw = "not.here:Spring"\nspring = { stiffness = 3 }\n'
    )
    with pytest.raises(FleetError, match="there is no module not"):
        small(text=text)
    fleet = parse_fleet(text, source="a recording", recorded=True)
    assert (fleet.control.law, fleet.robot(3).plant) == ("not.here:Spring", "not.here:Drag")
    assert not fleet.robot(3).kind.vehicle
    assert parse_fleet(DRAG, source="a recording", recorded=True) == small(text=DRAG)
    with pytest.raises(FleetError, match="unknown field"):
        parse_fleet(DRAG.replace("tau_s", "tua_s"), source="a recording", recorded=True)


@pytest.mark.parametrize(
    ("overrides", "law", "text", "said"),
    [
        (["robot.7.drag.slp=1"], None, DRAG, "--set robot.7.drag.slp: unknown field; did you mean slip?"),
        (["robot.7.drag.slip=2"], None, DRAG, "--set robot.7.drag.slip: must be at least 0 and less than 1"),
        (["robot_defaults.drag.tau_s=soon"], None, DRAG, "--set robot_defaults.drag.tau_s: must be a number"),
        (["robot.3.drag.slip=0.1"], None, SMALL, "--set robot.3.drag.slip: unknown table: no plugin that"),
        ([], None, DRAG.replace('"drag"', '"unicycle"'), "robot_defaults.drag: unknown table: no plugin"),
        (["robot.3.drag=3"], None, DRAG, "--set robot.3.drag: must be a table"),
        (["robot.3.plant=tow"], None, DRAG, "--set robot.3.plant: tow: another plugin here has"),
        (["robot.3.plant=mass"], None, SMALL, '--set robot.3.plant: mass: section = "mass_kg" is taken'),
        (
            ["robot.3.plant=range", "robot.3.range.low=2"],
            None,
            SMALL,
            "robot[1].range: ValueError: low must be (test_plugin_tables.py:",
        ),
        (["robot.3.plant=no.such:Thing"], None, DRAG, "--set robot.3.plant: no.such:Thing: there is no "),
        ([], "spring", SMALL, "control.spring: table [control.spring] is missing: it must give"),
        ([], "sprig", SMALL, '--law: must be one of paper, edge, joint, penalty, or a plugin, got "sprig"'),
        (
            [],
            "jiont",
            SMALL,
            '--law: must be one of paper, edge, joint, penalty, or a plugin, got "jiont": '
            'no plugin has the name "jiont"; did you mean joint?',
        ),
        (
            ["control.law=jiont"],
            None,
            SMALL,
            '--set control.law: must be one of paper, edge, joint, penalty, or a plugin, got "jiont": '
            'no plugin has the name "jiont"; did you mean joint?',
        ),
        (["control.law=a.b:C"], None, SMALL, "--set control.law: a.b:C: there is no module a"),
        (["control.law=3", "control.spring.stiffness=1"], None, SMALL, "--set control.law: must be one of "),
    ],
)
def test_one_line_says_what_is_wrong(overrides: list[str], law: str | None, text: str, said: str) -> None:
    (found,) = problems(*overrides, law=law, text=text)
    assert found.startswith(said)
    assert "\n" not in found
