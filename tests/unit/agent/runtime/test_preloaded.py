"""A fleet file that is read once for many processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.common.settings import entries
from handfast.agent.fleet.loading import digest, load_fleet
from handfast.agent.fleet.model import FleetError
from handfast.agent.fleet.scenario import parse_scenario
from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.mission_plan import trajectory_parts, written_plan
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Mission, Place
from handfast.agent.runtime import preloaded
from handfast.deploy.console.data_files import FLEETS


@pytest.fixture(autouse=True)
def nothing_preloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preloaded, "_fleets", {})


def copied(folder: Path, name: str = "pair") -> str:
    path = folder / "fleet.toml"
    path.write_text((FLEETS / f"{name}.toml").read_text())
    return str(path)


def test_what_was_preloaded_is_taken_as_it_was(tmp_path: Path) -> None:
    path = copied(tmp_path)
    preloaded.preload(path)
    fleet = preloaded.fleet_of(path)
    assert fleet == load_fleet(path)
    Path(path).unlink()
    assert preloaded.fleet_of(path) is fleet


def test_what_it_takes_to_read_a_live_rule_is_known_by_then(tmp_path: Path) -> None:
    """All processes of a fleet read it at the same time."""
    fleet = preloaded.preload(copied(tmp_path))
    before = entries.cache_info().misses
    rule = '[[faults.rule]]\nlink = "1->2"\ndelay = "20ms"\nat = 1.0\nfor = 2.0\n'
    assert len(parse_scenario(rule, fleet.ids).rules) == 1
    assert entries.cache_info().misses == before


def test_nor_does_a_mission_take_longer_because_it_is_the_first(tmp_path: Path) -> None:
    """That of a drive leaves its trajectory to the fleet file: what reads one is a change in mid-drive."""
    fleet = preloaded.preload(copied(tmp_path))
    before = entries.cache_info().misses
    parts = trajectory_parts(TrajectorySection(kind="line", velocity_mps=(0.5, 0.25)))
    places = (Place(1, 0.0, 0.0), Place(2, 1.0, 0.0))
    mission = decode(encode(Mission(2, 0, 0, 1, digest(fleet), trajectory=parts, robots=places)))
    assert isinstance(mission, Mission)
    assert written_plan(mission, fleet).section.velocity_mps == (0.5, 0.25)
    assert entries.cache_info().misses == before


def test_what_the_command_line_sets_is_read_anew(tmp_path: Path) -> None:
    path = copied(tmp_path)
    preloaded.preload(path)
    assert preloaded.fleet_of(path, ["fleet.rate_hz=12"]).fleet.rate_hz == 12
    assert preloaded.fleet_of(path, (), "paper") == load_fleet(path, (), "paper")
    assert preloaded.fleet_of(path) == load_fleet(path)


def test_a_file_that_was_not_preloaded_is_read(tmp_path: Path) -> None:
    assert preloaded.fleet_of(copied(tmp_path)).fleet.name == "pair"
    with pytest.raises(FleetError, match="no such file"):
        preloaded.preload(str(tmp_path / "none.toml"))
    with pytest.raises(FleetError, match="no such file"):
        preloaded.fleet_of(str(tmp_path / "none.toml"))


def test_that_a_process_has_started_is_told_once() -> None:
    told: list[str] = []
    preloaded.on_start(lambda: told.append("started"))
    preloaded.started()
    preloaded.started()
    assert told == ["started"]
