"""Checks a vehicle's parameters: its failsafes, its limits and whom it obeys."""

from __future__ import annotations

from collections.abc import Iterator
from math import degrees
from typing import Final

from handfast.agent.fleet.mavlink_section import MavlinkSection
from handfast.bridges.mavlink.ardupilot import constants, steering
from handfast.bridges.mavlink.session.session import Session
from handfast.plant.backend import WAITING, Check


def steers(link: Session) -> Iterator[Check]:
    """Whether it can turn at a standstill."""
    if not link.parameters_done:
        return
    values = link.parameters
    advice = "the law asks for turns at a standstill: it needs skid steering (73 and 74)"
    if steering.turns_on_the_spot(values):
        yield Check("steering", "ok", "turns on the spot")
    elif trouble := steering.trouble(values):
        yield Check("steering", "blocking", trouble, advice)
    elif any(values.get(name) is None for name in (*steering.ALL, steering.FRAME_TYPE)):
        text = "its outputs (SERVOn_FUNCTION) are not told"
        yield Check("steering", "warning", text, "look at them with its ground station: it needs 73 and 74")
    else:
        yield Check("steering", "warning", "no output is throttle left, or none right", advice)


def parameters(link: Session, section: MavlinkSection, now_ns: int) -> Iterator[Check]:
    """Failsafes that are off or risky, and limits that do not go with those of the fleet file."""
    if not link.parameters_done:
        yield Check("parameters", "blocking", f"{WAITING}its parameters")
        return
    lines = [*_failsafes(link), *_fence(link), *_limits(link, section), *_ids(link, now_ns)]
    read = sum(value is not None for value in link.parameters.values())
    looked_at = (*_FAILSAFES, constants.FENCE_ENABLE, constants.AVOID_ENABLE)
    untold = [name for name in looked_at if name in link.parameters and link.parameters[name] is None]
    if not read:
        yield Check("parameters", "warning", "it tells none", "failsafes and limits could not be looked at")
    elif untold:
        text = f"{', '.join(untold)} not told"
        yield Check("parameters", "warning", text, "look at these with its ground station")
    else:
        yield Check("parameters", "ok", f"{read} read" if lines else f"{read} read, failsafes on")
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


def _fence(link: Session) -> Iterator[Check]:
    avoids = int(link.parameter(constants.AVOID_ENABLE) or 0.0)
    if link.parameter(constants.FENCE_ENABLE) and avoids & constants.AVOID_FENCE:
        text = f"{avoids}: before its own fence it stops and stays in GUIDED"
        advice = "set 0, and FENCE_ACTION 2: then its fence puts it into HOLD; or keep the drive well inside"
        yield Check(constants.AVOID_ENABLE, "warning", text, advice)


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


def _name(link: Session, names: tuple[str, str]) -> str:
    """Of a parameter with today's and an older name, that which this vehicle has."""
    return next((name for name in names if link.parameters.get(name) is not None), names[-1])


def _ids(link: Session, now_ns: int) -> Iterator[Check]:
    own, mine = link.system, _name(link, constants.GROUND_STATION_ID)
    station = link.parameter(constants.GROUND_STATION_ID)
    usual = constants.SYSTEM_GROUND_STATION
    set_it = f"set {mine} to the system id of its ground station, {usual} as a rule"
    if station is not None and own == station:
        text = (
            f"{station:g} is the bridge's own system: the ground station failsafe would count its heartbeats"
        )
        yield Check(mine, "warning", text, set_it)
    heard = [system for system, _ in link.ground_stations(now_ns)]
    watched = station if link.parameter(constants.FS_GCS_ENABLE) else None
    if watched is not None and own != watched and heard and watched not in heard:
        shown = " and ".join(map(str, heard))
        text = f"{watched:g}: its failsafe does not watch the ground station that is here, system {shown}"
        yield Check(mine, "warning", text, set_it)
