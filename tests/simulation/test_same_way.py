"""The judge of runs on busy machines: what it takes for late, and that it excuses nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import pytest

from handfast.deploy.api.drive import simulate
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from tests.process.harness import BUSY_SETTINGS
from tests.process.same_way import assert_same_way, late_hand_states, late_ticks, late_times, late_wrenches

DRIVE_S: Final = 10.0
LIMIT_M: Final = 0.02
FIRST_TICKS_LATE: Final = {"tick_jitter": "39ms", "robot": 6, "at": "0s", "for": "0.04s"}
MOMENT: Final = {"robot": 2, "at": "2s", "for": "0.1s"}
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


@pytest.mark.parametrize("seed", [1, 2])
def test_a_machine_that_was_late_for_a_moment_is_excused(
    driven: Drive, punctual: Recording, seed: int
) -> None:
    late = driven(FIRST_TICKS_LATE, seed)
    assert len(late_ticks(late))
    grid = np.arange(0.0, DRIVE_S, 0.02)
    off = np.linalg.norm(late.hand_positions(grid) - punctual.hand_positions(grid), axis=-1)
    assert off.max() > LIMIT_M, "a case that needs no excuse"
    assert_same_way(late, punctual, DRIVE_S, LIMIT_M)


@pytest.mark.parametrize(
    ("fault", "seen"),
    [
        ({"topic": "wrench", "delay": "30ms"}, lambda late, _: late_wrenches(late)),
        ({"topic": "hand", "delay": "60ms"}, late_hand_states),
    ],
)
def test_what_comes_after_its_tick_is_seen(
    driven: Drive,
    punctual: Recording,
    fault: dict[str, Any],
    seen: Callable[[Recording, Recording], np.ndarray],
) -> None:
    late = driven(MOMENT | fault)
    assert not len(late_ticks(late))
    times = seen(late, punctual)
    assert len(times)
    assert times[0] > 1.7
    assert times[-1] < 2.3


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
