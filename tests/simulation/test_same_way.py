"""The judge of runs on busy machines: what it takes for late, and that it excuses nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import pytest

from handfast.deploy.api.drive import simulate
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from tests.process.harness import BUSY_SETTINGS
from tests.process.same_way import assert_same_way, late_times

DRIVE_S: Final = 10.0
LIMIT_M: Final = 0.02
BUSY: Final[dict[str, Any]] = {
    name: float(value) for name, value in (setting.split("=") for setting in BUSY_SETTINGS)
}


Drive = Callable[..., Recording]


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    def drive(rule: dict[str, Any] | None = None, seed: int = 1, **control: float) -> Recording:
        changes = BUSY | {f"control.{name}": value for name, value in control.items()}
        changes["faults.rule"] = [] if rule is None else [rule]
        out = tmp_path_factory.mktemp("driven") / "out"
        simulate("delta", changes, duration=DRIVE_S, seed=seed, check=False, out=out, report=False)
        return read_run(out)

    return drive


@pytest.fixture(scope="module")
def punctual(driven: Drive) -> Recording:
    return driven()


def test_a_fleet_in_time_is_never_late(driven: Drive, punctual: Recording) -> None:
    assert not len(late_times(punctual, punctual))
    assert_same_way(driven(), punctual, DRIVE_S, 1e-9)


@pytest.mark.parametrize(
    "fault",
    [{"tick_jitter": "39ms"}, {"topic": "wrench", "delay": "30ms"}, {"topic": "hand", "delay": "60ms"}],
)
def test_a_fleet_that_is_always_late_fails(driven: Drive, punctual: Recording, fault: dict[str, Any]) -> None:
    with pytest.raises(AssertionError, match=r"late [0-9]+ times"):
        assert_same_way(driven(fault), punctual, DRIVE_S, LIMIT_M)


def test_a_fleet_that_drives_otherwise_though_in_time_fails(driven: Drive, punctual: Recording) -> None:
    with pytest.raises(AssertionError, match=r"m apart at .* late at \[\] s"):
        assert_same_way(driven(c2=0.75), punctual, DRIVE_S, LIMIT_M)
