"""What `check` says of `[process]`."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.fleet.hosts import ProcessSection
from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.check.realtime import check_cores, check_realtime
from handfast.deploy.console.data_files import FLEETS

DELTA = load_fleet(FLEETS / "delta.toml")


@pytest.mark.parametrize(
    ("process", "places"),
    [
        (ProcessSection(), []),
        (ProcessSection(realtime=True, cpus=(1,)), []),
        (ProcessSection(cpus=(1,)), [("info", "process.cpus")]),
    ],
)
def test_cores_without_realtime_have_no_effect(
    process: ProcessSection, places: list[tuple[str, str]]
) -> None:
    found = list(check_realtime(replace(DELTA, process=process)))
    assert [(each.level, each.place) for each in found] == places


def test_cores_that_a_machine_has_not_are_named_with_those_that_it_has() -> None:
    fleet = replace(DELTA, process=ProcessSection(realtime=True, cpus=(1, 7, 9)))
    (found,) = check_cores(fleet, (0, 1, 2, 3))
    assert (found.level, found.place) == ("warning", "process.cpus")
    assert found.message == (
        "this machine has no cores 7, 9: robots on it would have core 1 alone; it has cores 0-3"
    )
    (found,) = check_cores(replace(fleet, process=ProcessSection(realtime=True, cpus=(7,))), (0,))
    assert "robots on it would be kept to none; it has core 0" in found.message


@pytest.mark.parametrize("process", [ProcessSection(cpus=(9,)), ProcessSection(realtime=True, cpus=(0,))])
def test_cores_that_are_there_or_that_nobody_asks_for_need_no_word(process: ProcessSection) -> None:
    assert not list(check_cores(replace(DELTA, process=process), (0, 1)))
