"""Checks a vehicle before it drives: the lines of `handfast preflight`.

A line at level blocking keeps the fleet from starting. One whose text begins with "waiting" may change by
itself within seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from math import hypot
from typing import Final, NamedTuple

from agent.common.time import NS_PER_S
from agent.control.hand import Pose
from agent.fleet.mavlink_section import MavlinkSection
from bridges.mavlink.ardupilot import constants
from bridges.mavlink.ardupilot.frames import Geodetic, geodetic_to_world
from bridges.mavlink.bridge import parameter_audit
from bridges.mavlink.session.reports import Ekf
from bridges.mavlink.session.session import Session
from bridges.mavlink.transport.connection_string import BY_ID
from plant.backend import BATTERY, WAITING, Check

FIRMWARE_MIN: Final = (4, 3)
DATUM_FAR_M: Final = 1_000.0
DATUM_TOO_FAR_M: Final = 10_000.0
"""An EKF's origin this far from the datum is another place than was meant."""
START_FAR_M: Final = 5.0
START_TOO_FAR_M: Final = 100.0
"""A rover so far from its start would cross ground that nobody has thought of."""
HDOP_MAX: Final = 2.0
SATELLITES_MIN: Final = 6
VARIANCE_WARN: Final = 0.5
VARIANCE_MAX: Final = 0.8
"""ArduPilot's own FS_EKF_THRESH, where it does not tell."""
REPORTED_NS: Final = 5 * NS_PER_S
"""What EKF and GPS said longer ago holds no more: both are asked for once a second at least."""
RATE_SHARE: Final = 0.8
RATE_MIN_HZ: Final = 4.0
ROUND_TRIP_WARN_S: Final = 0.15
ROUND_TRIP_MAX_S: Final = 0.5
BATTERY_WARN_PERCENT: Final = 30
BATTERY_MIN_PERCENT: Final = 10


class BridgeState(NamedTuple):
    """What the bridge knows of itself and its vehicle besides the session, at `now_ns`.

    trouble, note: of its transport. round_trip_s: of TIMESYNC, None while there was no answer. clock: what
    is wrong with the vehicle's clock, "" nothing. place: where it is (W), None while not known. start: x, y
    (m, W) of its start in the fleet file. prearm: the last complaint of its pre-arm checks.
    """

    now_ns: int
    trouble: str
    note: str
    round_trip_s: float | None
    clock: str
    place: Pose | None
    start: tuple[float, float]
    prearm: str


def checks(link: Session, state: BridgeState, section: MavlinkSection, datum: Geodetic) -> tuple[Check, ...]:
    """All lines that can be said now; the first is that of the link, and without one there is no other."""
    first = _link(link, state, section)
    if first.level == "blocking":
        return (first,)
    lines = [first, _type(link)]
    if lines[-1].level == "blocking":
        return tuple(lines)
    lines += [_firmware(link), _mode(link, section), _arming(link, state, section)]
    lines += [_ekf(link, state.now_ns), _gps(link, state.now_ns)]
    lines += [_origin(link, datum), *_place(state), *_rates(link, state.now_ns), _round_trip(state)]
    lines += [
        *parameter_audit.parameters(link, section),
        *_battery(link),
        _signing(link, section, state),
        *_participants(link, state.now_ns),
    ]
    return tuple(lines)


def _link(link: Session, state: BridgeState, section: MavlinkSection) -> Check:
    where = section.connection or ""
    if state.trouble:
        return Check("link", "blocking", state.trouble, f"check {where} and what is behind it")
    absence = link.absence(state.now_ns)
    if absence:
        advice = "is it switched on, and does its telemetry go there?"
        if link.system is None and (link.unsigned_refused or link.bad_signatures):
            advice = "`handfast signing` gives it the key, by USB and while it is disarmed"
        return Check("link", "blocking", f"{WAITING}it: {absence} on {where}", advice)
    text = f"system {link.system} on {where}"
    if where.startswith("/dev/") and not where.startswith(BY_ID):
        return Check("link", "warning", text, "name the port by /dev/serial/by-id/: this name can change")
    return Check("link", "warning" if state.note else "ok", text, state.note)


def _type(link: Session) -> Check:
    if link.problem:
        return Check(
            "type", "blocking", link.problem, "only ArduPilot Rover can be driven: check the connection"
        )
    return Check("type", "ok", f"ArduPilot, {constants.TYPE_NAMES.get(link.type, f'MAV_TYPE {link.type}')}")


def _firmware(link: Session) -> Check:
    if not link.firmware:
        return Check("firmware", "warning", "does not tell its version")
    numbers = link.firmware.split(" ")[0].split(".")
    version = tuple(int(number) for number in numbers[:2] if number.isdigit())
    if len(version) == 2 and version < FIRMWARE_MIN:
        return Check("firmware", "warning", link.firmware, "update: older than 4.3 has not been looked at")
    return Check("firmware", "ok", link.firmware)


def _mode(link: Session, section: MavlinkSection) -> Check:
    name = constants.mode_name(link.mode) if link.mode is not None else "unknown"
    if link.mode == constants.MODE_GUIDED:
        return Check("mode", "ok", name)
    advice = (
        "the bridge will put it into GUIDED"
        if section.arm
        else "its operator puts it into GUIDED to hand it over"
    )
    return Check("mode", "warning", name, advice)


def _arming(link: Session, state: BridgeState, section: MavlinkSection) -> Check:
    if link.armed:
        return Check("arming", "ok", "armed")
    if link.prearm_ok is False:
        text = f"{WAITING}its pre-arm checks{f': {state.prearm}' if state.prearm else ''}"
        return Check("arming", "blocking", text, "see what its ground station says; mend that first")
    advice = "the bridge will arm it (mavlink.arm = true)" if section.arm else "its operator arms it"
    return Check("arming", "warning", "disarmed", advice)


def ekf_trouble(link: Session, now_ns: int) -> str:
    """Why the vehicle's own estimate cannot be relied on, by what its EKF says of itself; "" when it can."""
    ekf = link.ekf
    if ekf is None:
        return f"{WAITING}the state of its EKF"
    if now_ns - ekf.arrival_ns > REPORTED_NS:
        return f"{WAITING}its EKF: silent for {(now_ns - ekf.arrival_ns) / NS_PER_S:.0f} s"
    if ekf.flags & constants.EKF_UNINITIALIZED:
        return f"{WAITING}its EKF to start"
    if ekf.flags & constants.EKF_GPS_GLITCHING:
        return "its EKF says that the GPS is glitching"
    if ekf.flags & constants.EKF_CONST_POS_MODE:
        return f"{WAITING}its EKF to have a position"
    missing = constants.EKF_NEEDED & ~ekf.flags
    if missing:
        names = {
            constants.EKF_ATTITUDE: "attitude",
            constants.EKF_VELOCITY_HORIZ: "velocity",
            constants.EKF_POS_HORIZ_REL: "position",
            constants.EKF_POS_HORIZ_ABS: "position on the earth",
        }
        return f"{WAITING}its EKF to have {', '.join(name for flag, name in names.items() if missing & flag)}"
    return _inconsistency(ekf, link.parameter(constants.FS_EKF_THRESH) or VARIANCE_MAX)


def _inconsistency(ekf: Ekf, most: float) -> str:
    """ArduPilot's own rule for its EKF failsafe: two of three variances beyond the threshold `most`, or that
    of the velocity beyond twice it. A compass alone may be upset by the current of a motor."""
    variances = {
        "velocity": ekf.velocity_variance,
        "position": ekf.position_variance,
        "compass": ekf.compass_variance,
    }
    beyond = {name: variance for name, variance in variances.items() if not variance < most}
    if len(beyond) > 1 or not ekf.velocity_variance < 2.0 * most:
        said = ", ".join(f"{name} {variance:.2f}" for name, variance in beyond.items())
        return f"its EKF is inconsistent: variances {said}, below {most:g} is good"
    return ""


def gps_trouble(link: Session, now_ns: int) -> str:
    """Why its GPS is not good enough, "" when it is."""
    if link.gps is None:
        return f"{WAITING}its GPS"
    if now_ns - link.gps.arrival_ns > REPORTED_NS:
        return f"{WAITING}its GPS: silent for {(now_ns - link.gps.arrival_ns) / NS_PER_S:.0f} s"
    if link.gps.fix < constants.GPS_3D_FIX:
        return f"{WAITING}a GPS fix: {constants.GPS_FIX_NAMES.get(link.gps.fix, link.gps.fix)}"
    return ""


def _ekf(link: Session, now_ns: int) -> Check:
    trouble = ekf_trouble(link, now_ns)
    if trouble:
        return Check(
            "EKF", "blocking", trouble, "give it open sky and half a minute; then see its ground station"
        )
    assert link.ekf is not None
    worst = max(link.ekf.velocity_variance, link.ekf.position_variance, link.ekf.compass_variance)
    if worst > VARIANCE_WARN:
        return Check(
            "EKF",
            "warning",
            f"worst variance {worst:.2f}",
            "compass and GPS disagree: calibrate, move away from iron",
        )
    return Check("EKF", "ok", f"healthy, worst variance {worst:.2f}")


def _gps(link: Session, now_ns: int) -> Check:
    trouble = gps_trouble(link, now_ns)
    if trouble or link.gps is None:
        return Check("GPS", "blocking", trouble, "give it open sky; check the antenna")
    hdop = f", hdop {link.gps.hdop:.1f}" if link.gps.hdop is not None else ""
    text = (
        f"{constants.GPS_FIX_NAMES.get(link.gps.fix, link.gps.fix)}, {link.gps.satellites} satellites{hdop}"
    )
    if link.gps.satellites < SATELLITES_MIN or (link.gps.hdop or 0.0) > HDOP_MAX:
        return Check("GPS", "warning", text, "wait for more satellites: positions may be metres off")
    return Check("GPS", "ok", text)


@lru_cache(maxsize=64)  # asked for at every tick, and changes with a reboot at most
def _apart(datum: Geodetic, place: Geodetic) -> float:
    """Distance of a place from the datum, m."""
    return hypot(*geodetic_to_world(datum, place))


def origin_trouble(link: Session, datum: Geodetic) -> str:
    """Why the vehicle's frame cannot be brought to the world, "" when it can."""
    if link.origin is None:
        return f"{WAITING}the origin of its EKF"
    distance = _apart(datum, link.origin)
    if distance > DATUM_TOO_FAR_M:
        return f"the origin of its EKF is {distance / 1000.0:.0f} km from the datum"
    return ""


def _origin(link: Session, datum: Geodetic) -> Check:
    trouble = origin_trouble(link, datum)
    if trouble or link.origin is None:
        waiting = trouble.startswith(WAITING)
        return Check(
            "origin", "blocking", trouble, "" if waiting else "correct [datum], or restart the vehicle"
        )
    distance = _apart(datum, link.origin)
    whose = "ours" if link.origin_ours else "its own"
    text = f"{distance:.2f} m from the datum ({whose})"
    if distance > DATUM_FAR_M:
        return Check("origin", "warning", text, "is [datum] where the fleet drives?")
    return Check("origin", "ok", text)


def _place(state: BridgeState) -> Iterator[Check]:
    if state.place is None:
        return
    x, y = state.start
    apart = hypot(state.place.x - x, state.place.y - y)
    text = f"({state.place.x:.2f}, {state.place.y:.2f}) m, {apart:.1f} m from its start in the fleet file"
    if apart > START_TOO_FAR_M:
        advice = "bring it there, or correct x_m, y_m or [datum]"
        yield Check("place", "blocking", text, advice)
    elif apart > START_FAR_M:
        yield Check("place", "warning", text, "it will drive from where it is: is the way free?")
    else:
        yield Check("place", "ok", text)


def _rates(link: Session, now_ns: int) -> Iterator[Check]:
    for stream in link.streams(now_ns):
        if stream.name not in ("ATTITUDE", "LOCAL_POSITION_NED"):
            continue
        text = f"{stream.measured_hz:.1f} Hz of {stream.asked_hz:g} Hz"
        if stream.answer == "waiting" or stream.measured_hz == 0.0:
            yield Check(stream.name, "blocking", f"{WAITING}it", "its telemetry link may be too slow")
        elif stream.measured_hz < RATE_MIN_HZ:
            advice = (
                f"at least {RATE_MIN_HZ:g} Hz are needed: raise the link's speed, or end other streams on it"
            )
            yield Check(stream.name, "blocking", text, advice)
        elif stream.measured_hz < RATE_SHARE * (stream.granted_hz or stream.asked_hz):
            yield Check(
                stream.name, "warning", text, "driven all the same, less closely: raise the link's speed"
            )
        elif stream.granted_hz is not None and stream.granted_hz < stream.asked_hz:
            loop_hz = link.parameter(constants.SCHED_LOOP_RATE) or constants.LOOP_RATE_HZ
            advice = (
                f"its SCHED_LOOP_RATE {loop_hz:g} allows {constants.STREAM_RATE_PART * loop_hz:g} Hz: take "
                f"state_rate_hz = {stream.granted_hz:g}"
            )
            yield Check(stream.name, "warning", text, advice)
        else:
            yield Check(stream.name, "ok", text)


def _round_trip(state: BridgeState) -> Check:
    if state.round_trip_s is None:
        text = "it does not answer TIMESYNC: times of validity are those of arrival, less the shortest delay"
        return Check("round trip", "warning", text, "update the firmware, or let a router pass TIMESYNC")
    text = f"{state.round_trip_s * 1000.0:.0f} ms"
    if state.clock:
        return Check(
            "round trip", "warning", f"{text}; {state.clock}", "a simulated vehicle must run in real time"
        )
    if state.round_trip_s > ROUND_TRIP_MAX_S:
        return Check(
            "round trip", "blocking", text, f"more than {ROUND_TRIP_MAX_S * 1000:.0f} ms: take a faster link"
        )
    if state.round_trip_s > ROUND_TRIP_WARN_S:
        return Check("round trip", "warning", text, "the formation will be held less closely")
    return Check("round trip", "ok", text)


def _battery(link: Session) -> Iterator[Check]:
    battery = link.battery
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


def _signing(link: Session, section: MavlinkSection, state: BridgeState) -> Check:
    if section.signing_key is None and link.vehicle_signs:
        advice = "name its key in mavlink.signing_key"
        answers = {stream.answer for stream in link.streams(state.now_ns)}
        if state.round_trip_s is not None or answers & {"accepted", "denied"}:
            text = "the vehicle signs, and this port of it takes what is not signed"
            return Check("signing", "warning", text, advice)
        if answers == {"waiting"}:
            return Check("signing", "blocking", f"{WAITING}an answer to what is not signed", advice)
        return Check("signing", "blocking", "the vehicle signs, and takes nothing that is not signed", advice)
    if section.signing_key is None:
        advice = "whoever reaches its link can drive it: see docs/rovers.md, signing"
        return Check("signing", "warning", "messages are not signed", advice)
    # With a key a vehicle that does not sign with it is not heard at all: that is the line of the link.
    if link.bad_signatures:
        text = f"on; refused for another key's or an old signature: {link.bad_signatures} messages"
        return Check("signing", "warning", text, "somebody else on the link has another key, or repeats them")
    return Check("signing", "ok", "on, the vehicle signs")


def _participants(link: Session, now_ns: int) -> Iterator[Check]:
    other = link.another_bridge(now_ns)
    if other:
        yield Check("other bridges", "blocking", other, "end it: two would pull the vehicle two ways")
    stations = link.ground_stations(now_ns)
    if stations:
        shown = ", ".join(str(system) for system, _ in stations)
        yield Check("ground station", "ok", f"system {shown}")
    if link.strangers and link.settings.system is None:
        shown = ", ".join(str(system) for system in sorted(link.strangers))
        yield Check("other vehicles", "warning", f"systems {shown} on the same link", "give mavlink.system")
