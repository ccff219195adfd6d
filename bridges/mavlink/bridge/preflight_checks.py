"""Checks a vehicle before it drives: the lines of `handfast preflight`, its parameters among them.

A line at level blocking keeps the fleet from starting. One whose text begins with "waiting" may change by
itself within seconds. Each of `CHECKS` has a line of its name, at every look: one that cannot be answered yet
waits, so that nothing is taken for well that was not looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from math import degrees
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.plants import MavlinkSection
from handfast.bridges.mavlink.ardupilot import constants, steering
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.bridge import driving_checks
from handfast.bridges.mavlink.session.session import Session
from handfast.plant.backend import BATTERY, WAITING, Check


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
    lines = [*_failsafes(link), *_rolls_on(link), *_fence(link), *_limits(link, section), *_ids(link, now_ns)]
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


def _rolls_on(link: Session) -> Iterator[Check]:
    """Block a GUID_TIMEOUT longer than the time for which the other robots evade a runaway vehicle."""
    planned_s = constants.SETPOINT_TIMEOUT_NS / NS_PER_S
    value = link.parameter(constants.GUID_TIMEOUT)
    if value is not None and not 0.0 < value <= planned_s:
        text = f"{value:g} s: it drives on for that long without commands; others expect {planned_s:g} s"
        yield Check(constants.GUID_TIMEOUT, "blocking", text, f"set {planned_s:g}")


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


FIRMWARE_MIN: Final = (4, 3)
BATTERY_WARN_PERCENT: Final = 30
BATTERY_MIN_PERCENT: Final = 10
ANSWERED_S: Final = 10.0
"""So long a vehicle is asked from when it is heard: what has not come by then it does not tell."""


class BridgeState(NamedTuple):
    """What the bridge knows of itself and its vehicle besides the session, at `now_ns`.

    trouble, note: of its transport. heard_s: for how long the vehicle has been heard. round_trip_s: of
    TIMESYNC, None while there was no answer. clock: what is wrong with the vehicle's clock, "" nothing.
    place: where it is (W), None while not known. start: x, y (m, W) of its start in the fleet file. prearm:
    the last complaint of its pre-arm checks.
    """

    now_ns: int
    trouble: str
    note: str
    heard_s: float
    round_trip_s: float | None
    clock: str
    place: Pose | None
    start: tuple[float, float]
    prearm: str

    @property
    def due(self) -> bool:
        """Whether all that the vehicle tells should have been told by now."""
        return self.heard_s >= ANSWERED_S


class Look(NamedTuple):
    """All that is looked at."""

    link: Session
    state: BridgeState
    section: MavlinkSection
    datum: Geodetic


def checks(look: Look) -> tuple[Check, ...]:
    """All lines; no more after one of the link, or of the kind of vehicle, that blocks."""
    lines: list[Check] = []
    for name, check in CHECKS:
        found = tuple(check(look))
        if not any(line.name == name for line in found):
            found = (Check(name, "blocking", f"{WAITING}its {name}"), *found)
        lines += found
        if name in FIRST and found[0].level == "blocking":
            return tuple(lines)
    return (*lines, *driving_checks.participants(look.link, look.state.now_ns))


def _link(look: Look) -> Check:
    state = look.state
    return driving_checks.link(look.link, look.section, state.now_ns, state.trouble, state.note)


def _type(look: Look) -> Iterator[Check]:
    link = look.link
    if link.problem:
        advice = "only ArduPilot Rover can be driven: check the connection"
        yield Check("type", "blocking", link.problem, advice)
    else:
        kind = constants.TYPE_NAMES.get(link.type, f"MAV_TYPE {link.type}")
        yield Check("type", "ok", f"ArduPilot, {kind}")


def _firmware(look: Look) -> Iterator[Check]:
    firmware = look.link.firmware
    if not firmware:
        if look.state.due:
            yield Check("firmware", "warning", "does not tell its version")
        return
    numbers = firmware.split(" ")[0].split(".")
    version = tuple(int(number) for number in numbers[:2] if number.isdigit())
    if len(version) == 2 and version < FIRMWARE_MIN:
        yield Check("firmware", "warning", firmware, "update: older than 4.3 has not been looked at")
    else:
        yield Check("firmware", "ok", firmware)


def _mode(look: Look) -> Iterator[Check]:
    mode = look.link.mode
    name = constants.mode_name(mode) if mode is not None else "unknown"
    if mode == constants.MODE_GUIDED:
        yield Check("mode", "ok", name)
    elif look.section.arm:
        yield Check("mode", "warning", name, "the bridge will put it into GUIDED")
    else:
        yield Check("mode", "warning", name, "its operator puts it into GUIDED to hand it over")


def _arming(look: Look) -> Iterator[Check]:
    link, prearm = look.link, look.state.prearm
    if link.armed:
        yield Check("arming", "ok", "armed")
    elif link.status is None and not look.state.due:
        return
    elif link.prearm_ok is False:
        text = f"{WAITING}its pre-arm checks{f': {prearm}' if prearm else ''}"
        yield Check("arming", "blocking", text, "see what its ground station says; mend that first")
    else:
        arms = "the bridge will arm it (mavlink.arm = true)" if look.section.arm else "its operator arms it"
        yield Check("arming", "warning", "disarmed", arms)


def _battery(look: Look) -> Iterator[Check]:
    link = look.link
    battery = link.battery
    if battery is None and not look.state.due:
        return
    if battery is None or (battery.voltage is None and battery.percent is None):
        yield Check(BATTERY, "warning", "not measured", "set up its battery monitor (BATT_MONITOR)")
        return
    shown = [f"{battery.voltage:.1f} V"] if battery.voltage is not None else []
    shown += [f"{battery.percent} %"] if battery.percent is not None else []
    text = ", ".join(shown)
    low = link.parameters.get(constants.BATT_LOW_VOLT)
    empty = battery.percent is not None and battery.percent < BATTERY_MIN_PERCENT
    if empty or (low and battery.voltage is not None and battery.voltage < low):
        yield Check(BATTERY, "blocking", text, "charge it")
    elif battery.percent is not None and battery.percent < BATTERY_WARN_PERCENT:
        yield Check(BATTERY, "warning", text, "charge it soon")
    else:
        yield Check(BATTERY, "ok", text)


Checker = Callable[[Look], Iterable[Check]]
"""Of one name: a line of it, and more; nothing while it cannot say yet."""
CHECKS: Final[tuple[tuple[str, Checker], ...]] = (
    ("link", lambda of: (_link(of),)),
    ("type", _type),
    ("firmware", _firmware),
    ("mode", _mode),
    ("arming", _arming),
    ("EKF", lambda of: (driving_checks.ekf(of.link, of.state.now_ns),)),
    ("GPS", lambda of: (driving_checks.gps(of.link, of.state.now_ns),)),
    ("origin", lambda of: (driving_checks.origin(of.link, of.datum),)),
    ("place", lambda of: (driving_checks.place(of.state.place, of.state.start),)),
    ("ATTITUDE", lambda of: (driving_checks.rate(of.link, "ATTITUDE", of.state.now_ns),)),
    ("LOCAL_POSITION_NED", lambda of: (driving_checks.rate(of.link, "LOCAL_POSITION_NED", of.state.now_ns),)),
    (
        "round trip",
        lambda of: (driving_checks.round_trip(of.state.round_trip_s, of.state.clock, due=of.state.due),),
    ),
    ("steering", lambda of: steers(of.link)),
    ("parameters", lambda of: parameters(of.link, of.section, of.state.now_ns)),
    (BATTERY, _battery),
    ("signing", lambda of: (driving_checks.signing(of.link, of.section, of.state.now_ns),)),
)
"""In the order of the lines."""
FIRST: Final = ("link", "type")
"""Of a vehicle that is not there, or not one of ours, nothing else is looked at."""
