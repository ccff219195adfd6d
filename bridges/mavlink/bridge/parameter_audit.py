"""Checks a vehicle's parameters: its failsafes, its limits and whom it obeys."""

from __future__ import annotations

from collections.abc import Iterator
from math import degrees
from typing import Final

from agent.fleet.mavlink_section import MavlinkSection
from bridges.mavlink.ardupilot import constants
from bridges.mavlink.session.session import Session
from plant.backend import WAITING, Check


def parameters(link: Session, section: MavlinkSection) -> Iterator[Check]:
    """Failsafes that are off or risky, and limits that do not go with those of the fleet file."""
    if not link.parameters_done:
        yield Check("parameters", "blocking", f"{WAITING}its parameters")
        return
    lines = [*_failsafes(link), *_limits(link, section), *_ids(link, section)]
    read = sum(value is not None for value in link.parameters.values())
    untold = [name for name in _FAILSAFES if link.parameters.get(name) is None]
    if not read:
        yield Check("parameters", "warning", "it tells none", "failsafes and limits could not be looked at")
    elif untold:
        text = f"{', '.join(untold)} not told"
        yield Check("parameters", "warning", text, "look at these failsafes with its ground station")
    elif not lines:
        yield Check("parameters", "ok", f"{read} read, failsafes on")
    yield from lines


_HOMEWARD: Final = "it drives home by itself then, through its neighbours"
_GOES_HOME: Final = (1.0, 3.0, 4.0)
"""RTL and the two of SmartRTL, in FS_ACTION and BATT_FS_*_ACT alike."""
_RISKY: Final = (
    (constants.FS_ACTION, (0.0,), "a failsafe does nothing", "set 2 (HOLD)"),
    (constants.FS_ACTION, _GOES_HOME, _HOMEWARD, "set 2 (HOLD)"),
    (constants.FS_THR_ENABLE, (0.0,), "the loss of its remote control goes unnoticed", "set 1"),
    (
        constants.FS_GCS_ENABLE,
        (0.0,),
        "the loss of its ground station goes unnoticed",
        "set 1 if one is always there",
    ),
    # 2 only reports.
    (constants.FS_EKF_ACTION, (0.0, 2.0), "it drives on when its EKF fails", "set 1 (HOLD)"),
    (constants.FS_EKF_THRESH, (0.0,), "that its EKF fails goes unnoticed", "set 0.8"),
    (constants.FS_CRASH_CHECK, (0.0,), "it drives on against an obstacle", "set 1 (HOLD)"),
    (
        constants.BATT_FS_LOW_ACT,
        (0.0,),
        "a low battery goes unnoticed",
        "set 2 (HOLD) with a battery monitor",
    ),
    (constants.BATT_FS_LOW_ACT, _GOES_HOME, _HOMEWARD, "set 2 (HOLD)"),
    (constants.BATT_FS_CRT_ACT, _GOES_HOME, _HOMEWARD, "set 2 (HOLD)"),
)
_FAILSAFES: Final = tuple(dict.fromkeys(name for name, *_ in _RISKY))


def _failsafes(link: Session) -> Iterator[Check]:
    for name, values, means, advice in _RISKY:
        value = link.parameters.get(name)
        if value in values:
            yield Check(name, "warning", f"{value:g}: {means}", advice)
    checked, skipped = link.parameters.get("ARMING_CHECK"), link.parameters.get("ARMING_SKIPCHK")
    if skipped or (checked is not None and not int(checked) & 1):  # bit 0: all of them
        yield Check(
            "arming checks", "warning", "some or all are off: it arms whatever is wrong", "turn them on"
        )


def _limits(link: Session, section: MavlinkSection) -> Iterator[Check]:
    for name, unit, scale, ours, field in (
        (constants.WP_SPEED, "m/s", 1.0, section.max_speed_mps, "max_speed_mps"),
        (constants.ATC_ACCEL_MAX, "m/s2", 1.0, section.max_acceleration, "max_acceleration"),
        (constants.ATC_STR_RAT_MAX, "deg/s", degrees(1.0), section.max_yaw_rate_radps, "max_yaw_rate_radps"),
    ):
        value = link.parameters.get(name)
        if value is not None and 0.0 < value < ours * scale * 0.999:
            text = f"{value:g} {unit} is less than mavlink.{field}, {ours * scale:.3g} {unit}"
            yield Check(name, "warning", text, f"the vehicle's limit holds: lower {field}, or raise {name}")


def _ids(link: Session, section: MavlinkSection) -> Iterator[Check]:
    own = section.own_system or link.system
    station = link.parameter(constants.GROUND_STATION_ID)
    options = int(link.parameters.get(constants.MAV_OPTIONS) or 0.0)
    enforced = link.parameters.get(constants.SYSID_ENFORCE) == 1.0 or options & constants.OPTION_ENFORCE
    if enforced and own not in (link.system, station):
        text = f"it obeys its ground station {station or 255:g} only, and the bridge is system {own}"
        yield Check(constants.SYSID_ENFORCE, "blocking", text, "leave own_system out")
    if station is not None and own == station:
        text = f"its ground station's id {station:g} is the bridge's own: its failsafe would watch the bridge"
        yield Check("own_system", "warning", text, "leave own_system out")
