"""What `check` says of `[process]`."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agent.fleet.loading import load_fleet
from agent.fleet.process_section import ProcessSection
from deploy.check.realtime import check_realtime
from deploy.console.data_files import FLEETS

DELTA = load_fleet(FLEETS / "delta.toml")


@pytest.mark.parametrize(
    ("process", "places"),
    [
        (ProcessSection(), []),
        (ProcessSection(realtime=True, cpus=(1,)), []),
        (ProcessSection(realtime=True, priority=47), []),
        (ProcessSection(realtime=True, priority=48), [("warning", "process.priority")]),
        (ProcessSection(priority=41, cpus=(1,)), [("info", "process.priority"), ("info", "process.cpus")]),
    ],
)
def test_what_has_no_effect_and_what_goes_before_interrupts(
    process: ProcessSection, places: list[tuple[str, str]]
) -> None:
    found = list(check_realtime(replace(DELTA, process=process)))
    assert [(each.level, each.place) for each in found] == places


def test_what_would_be_right_is_said() -> None:
    (found,) = check_realtime(replace(DELTA, process=ProcessSection(realtime=True, priority=60)))
    assert found.message.endswith("give at most 47")
    assert "plants get 62" in found.message
