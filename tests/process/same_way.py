"""Whether a fleet of processes goes as it does in virtual time, as far as the machine lets it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from tests.process.harness import measured

GRID_S: Final = 0.02
LATE_M: Final = 0.02
"""Where its robots begin decides at whose side a robot of the delta passes another: robot 6 was 28 mm off
after one tick that was 15 ms late, its first, and 70 mm after four that were late by up to 39 ms."""
FORGOTTEN_S: Final = 10.0
"""By then the formation has pulled a robot back to where it would have been."""
LATE_SHARE: Final = 0.25


def assert_same_way(run: Path | Recording, simulated: Path | Recording, end_s: float, limit_m: float) -> None:
    """Fails the test when the hand points of `run` and `simulated` until `end_s` differ by `limit_m` or more.

    A run whose processes are given their time goes to the last digit as the simulated one. For each time that
    the machine was late (`late_times`), `LATE_M` more is allowed for `FORGOTTEN_S`. Late more often than
    `LATE_SHARE` of all ticks: nothing can be said, which is a failure: such tests are `alone`.
    """
    one, other = (each if isinstance(each, Recording) else read_run(each) for each in (run, simulated))
    grid = np.arange(0.0, end_s, GRID_S)
    for recording in (one, other):
        assert recording.data_end_s >= grid[-1] - 0.05, f"it ends after {recording.data_end_s:.2f} s"
    there, wanted = one.hand_positions(grid), other.hand_positions(grid)
    assert there.shape == wanted.shape
    assert np.isfinite(there).all()
    assert np.isfinite(wanted).all()
    late = late_times(one, other)
    late = late[late < end_s]
    ticks = 2e9 * end_s / one.fleet.period_ns * len(one.robots)
    assert len(late) <= LATE_SHARE * ticks, f"late {len(late)} times in {ticks:.0f} ticks"
    recent = np.searchsorted(late, grid) - np.searchsorted(late, grid - FORGOTTEN_S)
    limits = limit_m + LATE_M * recent[:, None]
    off = np.hypot(*np.moveaxis(there - wanted, -1, 0))
    most = measured("apart, m", float(off.max()))
    measured("late, times", len(late))
    k, robot = np.unravel_index(int((off - limits).argmax()), off.shape)
    above = grid[(off >= limits).any(axis=1)]
    assert not len(above), (
        f"{off[k, robot]:.3f} m apart at {grid[k]:.2f} s (the robot of index {robot}: {there[k, robot]} and "
        f"{wanted[k, robot]}; at most {most:.3f}); {limits[k, 0]:.3f} m allowed, late at "
        f"{np.round(late, 2)} s; more at {len(above)} times, {above[0]:.2f} s to {above[-1]:.2f} s"
    )


def late_times(recording: Recording, simulated: Recording) -> np.ndarray:
    """When (s), in order, the machine was late: ticks left out or late, wrenches and hand states that came
    after the tick that they were for."""
    return np.sort(
        np.concatenate(
            (
                skipped(recording),
                late_ticks(recording),
                late_wrenches(recording),
                late_hand_states(recording, simulated),
            )
        )
    )


def skipped(recording: Recording) -> np.ndarray:
    """When (s) each tick was that a robot or a plant left out, by the gaps in what they sent."""
    period_s = recording.fleet.period_ns / 1e9
    found: list[np.ndarray] = []
    for robot in recording.robots.values():
        for times in (robot.hand.t, robot.plant.t):
            count = np.rint(np.diff(times) / period_s - 1.0).clip(min=0).astype(int)
            found.append(np.repeat(times[:-1] + period_s, count))
    return np.sort(np.concatenate(found))


def late_ticks(recording: Recording) -> np.ndarray:
    """When (s) agents and plants ticked so late that they said by their clocks when, and not when they should
    have: stamps off the grid of all others."""
    period_ns = recording.fleet.period_ns
    found: list[np.ndarray] = []
    for tables in zip(*((robot.hand, robot.plant) for robot in recording.robots.values()), strict=True):
        phases = np.concatenate([table.stamps_ns % period_ns for table in tables])
        values, counts = np.unique(phases, return_counts=True)
        off = phases != values[counts.argmax()]
        found.append(np.concatenate([table.t for table in tables])[off])
    return np.sort(np.concatenate(found))


def late_wrenches(recording: Recording) -> np.ndarray:
    """When (s) a plant did not drive by its agent's last wrench, because that came after the plant's tick, or
    the plant's tick after the next. One that asks to brake says no force, and is left out."""
    found: list[np.ndarray] = []
    for robot in recording.robots.values():
        plant, wrench = robot.plant, robot.wrench
        last = np.searchsorted(wrench.t, plant.t, side="right") - 1
        asked, driven = (np.column_stack((each["force"], each["torque"])) for each in (wrench, plant))
        other = (last >= 0) & (wrench["brake"][last] == 0.0) & (asked[last] != driven).any(axis=1)
        found.append(plant.t[other])
    return np.sort(np.concatenate(found))


def late_hand_states(recording: Recording, simulated: Recording) -> np.ndarray:
    """When (s) an agent said that it went by a neighbour's hand state that was older, by more than half a
    tick, than any in `simulated`: the newer one came after its tick."""
    half_us = recording.fleet.period_ns / 2e3
    oldest_us = max(robot.status.ages_us.max(initial=0) for robot in simulated.robots.values())
    found: list[np.ndarray] = []
    for robot in recording.robots.values():
        status = robot.status
        since = np.concatenate(([0.0], status.t[:-1]))  # as of the status before: its ages are of ticks since
        found.append(np.repeat(since, status.age_counts)[status.ages_us > oldest_us + half_us])
    return np.sort(np.concatenate(found))
