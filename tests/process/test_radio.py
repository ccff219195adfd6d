"""Real processes whose emulated radios carry too little: late as in virtual time, and they end when asked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.process.harness import Command

SLOW = tuple(
    word
    for setting in (
        "fleet.rate_hz=20",
        "control.wrench_timeout_s=0.5",
        "control.plant_timeout_s=0.5",
        "network.base_port=21900",
        "network.budget=30kbit",
        "network.emulate_budget=true",
    )
    for word in ("--set", setting)
)  # a pair needs 43 kbit/s
DRIVE = ("--duration", "10", "--no-report", "--out", "out")


def metrics_of(folder: Path, command: str) -> dict[str, Any]:
    with Command(folder, command, "pair", *DRIVE, *SLOW) as done:
        assert done.wait() == 0, done.told()
    found: dict[str, Any] = json.loads((folder / "out" / "metrics.json").read_text())
    return found


def test_what_an_emulated_radio_does_to_processes_is_what_it_does_in_virtual_time(tmp_path: Path) -> None:
    real, virtual = metrics_of(tmp_path / "real", "run"), metrics_of(tmp_path / "virtual", "simulate")
    ages = [found["age_of_information_ms"]["p50"] for found in (real, virtual)]
    assert 0.7 * ages[1] < ages[0] < 1.4 * ages[1], ages
    assert ages[1] > 300.0, "the queues are long"
    for found in (real, virtual):
        assert found["injected"]["queued"] > 50
        assert found["messages"]["received"] < 0.9 * 2 * 10 * 20, "some were dropped"
        assert found["links_audit"]["differing"] == 0
        assert found["verdict"]["passed"], found["verdict"]
