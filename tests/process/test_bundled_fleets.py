"""Every bundled fleet drives with `handfast run`, those with vehicles by their simulators."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from handfast.agent.supervision.state_machine import DRIVING_NAMES
from handfast.deploy.console.data_files import FLEETS, bundled
from handfast.deploy.recording.mcap_reader import read_run
from tests.process.harness import BUSY, Command, no_trouble_in_logs

pytestmark = pytest.mark.alone

DRIVEN_ELSEWHERE = {
    "delta": "tests/process/test_run.py",
    "pair": "tests/process/test_run.py",
    "reserve": "tests/process/test_membership.py",
}
ON_HOSTS = {"rovers_on_hosts": "tests/hosts/test_rovers_on_hosts.py"}
SLOWLY = (
    "--set",
    "fleet.rate_hz=10",
    "--set",
    "control.wrench_timeout_s=1",
    "--set",
    "control.plant_timeout_s=1",
)
DRIVEN = {"line10": BUSY, "obstacles": BUSY, "rovers": BUSY, "lattice45": SLOWLY}
"""Each with what it is given on a busy machine: 45 robots take two cores of a small machine at 20 Hz."""
SIMPLE = ("line10", "obstacles")
"""Fleets whose processes differ from those of delta in their number only."""
SECONDS = 5.0
NETWORK = ("--set", "network.base_port=21120")


def test_each_is_driven_here_or_elsewhere() -> None:
    assert {*DRIVEN, *DRIVEN_ELSEWHERE, *ON_HOSTS} == set(bundled(FLEETS))
    root = Path(__file__).parents[2]
    for name, path in ON_HOSTS.items():
        assert f'"{name}"' in (root / path).read_text(encoding="utf-8")
    for name, path in DRIVEN_ELSEWHERE.items():
        assert f'"run", "{name}"' in (root / path).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.long if name in SIMPLE else ()) for name in DRIVEN],
)
def test_it_drives_to_the_end_and_ends_when_asked(name: str, tmp_path: Path) -> None:
    arguments = ("run", name, "--duration", f"{SECONDS:g}", "--out", "out", "--no-report", "--no-check")
    with Command(tmp_path, *arguments, *NETWORK, *DRIVEN[name]) as command:
        status = command.wait(120.0)
    assert status in (0, 1), command.told()  # the formation need not stand so soon
    assert "did not end when asked" not in command.err, command.told()
    no_trouble_in_logs(tmp_path / "out")
    recording = read_run(tmp_path / "out")
    assert recording.reasons == (), command.told()
    # A tick is told by its number: the last one of the drive, taken late, may already know of its end.
    before_last_s = recording.end_s - 1.0 / recording.fleet.fleet.rate_hz
    for robot in recording.ids:
        told = recording.robots[robot].status.at(before_last_s)
        assert told is not None, f"robot {robot} never said a word"
        assert told[0] in DRIVING_NAMES, f"robot {robot} is {told}"
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["duration_s"] == SECONDS
    assert metrics["min_distance_m"]["any"] > recording.fleet.formation.safe_distance_m
