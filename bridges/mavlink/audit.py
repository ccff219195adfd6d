"""What a vehicle's parameters say of its failsafes, its limits and whom it obeys."""

from __future__ import annotations

from collections.abc import Iterator
from math import degrees
from typing import Final

from agent.fleet_sections import MavlinkSection
from bridges.mavlink import ardurover
from bridges.mavlink.link import Link
from plant.backend import Check

WAITING: Final = "waiting for "
"""How the text of a line begins that may change by itself."""


def parameters(link: Link, section: MavlinkSection) -> Iterator[Check]:
    """Failsafes that are off or risky, and limits that do not go with those of the fleet file."""
    if not link.parameters_done:
        yield Check("parameters", "blocking", f"{WAITING}its parameters")
        return
    lines = [*_failsafes(link), *_limits(link, section), *_ids(link, section)]
    read = sum(value is not None for value in link.parameters.values())
    if not any(value is not None for value in link.parameters.values()):
        yield Check("parameters", "warning", "it tells none", "failsafes and limits could not be looked at")
    elif not lines:
        yield Check("parameters", "ok", f"{read} read, failsafes on")
    yield from lines


_OFF: Final = (
    (ardurover.FS_ACTION, "a failsafe does nothing", "set 2 (HOLD)"),
    (ardurover.FS_THR_ENABLE, "the loss of its remote control goes unnoticed", "set 1"),
    (
        ardurover.FS_GCS_ENABLE,
        "the loss of its ground station goes unnoticed",
        "set 1 if one is always there",
    ),
    (ardurover.FS_EKF_ACTION, "it drives on when its EKF fails", "set 1 (HOLD)"),
    (ardurover.FS_CRASH_CHECK, "it drives on against an obstacle", "set 1 (HOLD)"),
    (ardurover.BATT_FS_LOW_ACT, "a low battery goes unnoticed", "set 2 (HOLD) with a battery monitor"),
)


def _failsafes(link: Link) -> Iterator[Check]:
    for name, means, advice in _OFF:
        if link.parameters.get(name) == 0.0:
            yield Check(name, "warning", f"0: {means}", advice)
    if link.parameters.get("ARMING_CHECK") == 0.0 or link.parameters.get("ARMING_SKIPCHK") not in (None, 0.0):
        yield Check(
            "arming checks", "warning", "some or all are off: it arms whatever is wrong", "turn them on"
        )


def _limits(link: Link, section: MavlinkSection) -> Iterator[Check]:
    for name, unit, scale, ours, field in (
        (ardurover.WP_SPEED, "m/s", 1.0, section.max_speed_mps, "max_speed_mps"),
        (ardurover.ATC_ACCEL_MAX, "m/s2", 1.0, section.max_acceleration, "max_acceleration"),
        (ardurover.ATC_STR_RAT_MAX, "deg/s", degrees(1.0), section.max_yaw_rate_radps, "max_yaw_rate_radps"),
    ):
        value = link.parameters.get(name)
        if value is not None and 0.0 < value < ours * scale * 0.999:
            text = f"{value:g} {unit} is less than mavlink.{field}, {ours * scale:.3g} {unit}"
            yield Check(name, "warning", text, f"the vehicle's limit holds: lower {field}, or raise {name}")


def _ids(link: Link, section: MavlinkSection) -> Iterator[Check]:
    own = section.own_system or link.system
    station = link.parameter(ardurover.GROUND_STATION_ID)
    options = int(link.parameters.get(ardurover.MAV_OPTIONS) or 0.0)
    enforced = link.parameters.get(ardurover.SYSID_ENFORCE) == 1.0 or options & ardurover.OPTION_ENFORCE
    if enforced and own not in (link.system, station):
        text = f"it obeys its ground station {station or 255:g} only, and the bridge is system {own}"
        yield Check(ardurover.SYSID_ENFORCE, "blocking", text, "leave own_system out")
    if station is not None and own == station:
        text = f"its ground station's id {station:g} is the bridge's own: its failsafe would watch the bridge"
        yield Check("own_system", "warning", text, "leave own_system out")
