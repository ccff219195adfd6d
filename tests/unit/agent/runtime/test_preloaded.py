"""A fleet file that is read once for many processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import FleetError
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
