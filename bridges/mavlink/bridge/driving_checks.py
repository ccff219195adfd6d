"""Checks the link to a vehicle, and where it is: its EKF, GPS, origin and place.

The lines are for preflight. Reasons not to rely on it (`..._trouble`) count while it drives, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from math import hypot
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.plants import MavlinkSection
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, geodetic_to_world
from handfast.bridges.mavlink.session.reports import Ekf
from handfast.bridges.mavlink.session.session import Session
from handfast.bridges.mavlink.transport.connection_string import BY_ID, is_lasting
from handfast.bridges.mavlink.transport.port_diagnosis import TO_DO
from handfast.plant.backend import WAITING, Check

RATE_SHARE: Final = 0.8
RATE_MIN_HZ: Final = 4.0
ROUND_TRIP_WARN_S: Final = 0.15
ROUND_TRIP_MAX_S: Final = 0.5


def link(session: Session, section: MavlinkSection, now_ns: int, trouble: str, note: str) -> Check:
    """Whether the vehicle is heard and answers.

    Args:
        trouble, note: of the transport.
    """
    where = section.connection or ""
    if trouble:
        found, _, advice = trouble.partition(TO_DO)
        return Check("link", "blocking", found, advice or f"check {where} and what is behind it")
    odd, _, remedy = note.partition(TO_DO)
    absence = session.absence(now_ns)
    if absence:
        found = f"{WAITING}it: {absence} on {where}"
        if remedy:
            return Check("link", "blocking", f"{found}; {odd}", remedy)
        return Check("link", "blocking", found, _absent(session, where, now_ns))
    # That it signs, and we do not, is the line of the signing.
    if session.unanswered(now_ns) and not _unsigned(session):
        text = f"system {session.system} is heard on {where}, but answers nothing"
        return Check("link", "blocking", text, _deaf(session))
    text = f"system {session.system} on {where}"
    if remedy:
        return Check("link", "warning", f"{text}; {odd}", remedy)
    if odd:
        return Check("link", "warning", text, odd)
    if not is_lasting(where):
        return Check("link", "warning", text, f"name the port by {BY_ID}: this name can change")
    return Check("link", "ok", text)


def silence(session: Session, now_ns: int) -> str:
    """Why a vehicle that is heard cannot be commanded, "" when it answers."""
    if not session.unanswered(now_ns):
        return ""
    return f"system {session.system} is heard, but answers nothing: {_deaf(session)}"


def _absent(session: Session, where: str, now_ns: int) -> str:
    """What to do about a vehicle that is not there."""
    others = session.other_vehicles(now_ns)
    if others:
        new, old = constants.SYSTEM_ID
        meant = session.settings.system
        here = " or ".join(str(system) for system in others if 1 <= system < constants.SYSTEM_GROUND_STATION)
        wanted = f"{meant}" if meant is not None else "an id from 1 to 254"
        renamed = f"give the vehicle {old} (newer firmware: {new}) = {wanted}"
        return f"mavlink.system = {here}, or {renamed}, or swap connections" if here else renamed
    if session.system is None and (session.unsigned_refused or session.bad_signatures):
        return "`handfast keys --signing` gives it the key, by USB and while it is disarmed"
    if where.startswith("/"):
        return "is it switched on, TX wired to RX both ways, and SERIALx_PROTOCOL = 2 for that port of it?"
    return "is it switched on, and does its telemetry go there?"


def _unsigned(session: Session) -> bool:
    """Whether it signs, and we do not."""
    return session.vehicle_signs and session.settings.signing is None


def _deaf(session: Session) -> str:
    """Why it may be that a vehicle that is heard answers nothing, and what to do."""
    settings = session.settings
    if _unsigned(session):
        return "it signs, and takes nothing that is not signed: name its key in mavlink.signing_key"
    ways = "TX of this side is not wired, or a router or firewall sends nothing back to it"
    if settings.signing is not None:
        ways += ", or it has another signing key or a later signing time"
    return f"nothing of ours reaches it: {ways}"


def rate(session: Session, name: str, now_ns: int) -> Check:
    """How often a message of the state comes."""
    stream = next(stream for stream in session.streams(now_ns) if stream.name == name)
    text = f"{stream.measured_hz:.1f} Hz of {stream.asked_hz:g} Hz"
    if stream.answer == "waiting" or stream.measured_hz == 0.0:
        return Check(name, "blocking", f"{WAITING}it", "its telemetry link may be too slow")
    if stream.measured_hz < RATE_MIN_HZ:
        advice = f"at least {RATE_MIN_HZ:g} Hz are needed: raise the link's speed, or end other streams on it"
        return Check(name, "blocking", text, advice)
    if stream.measured_hz < RATE_SHARE * (stream.granted_hz or stream.asked_hz):
        return Check(name, "warning", text, "driven all the same, less closely: raise the link's speed")
    if stream.granted_hz is not None and stream.granted_hz < stream.asked_hz:
        loop_hz = session.parameter(constants.SCHED_LOOP_RATE) or constants.LOOP_RATE_HZ
        advice = (
            f"its SCHED_LOOP_RATE {loop_hz:g} allows {constants.STREAM_RATE_PART * loop_hz:g} Hz: take "
            f"state_rate_hz = {stream.granted_hz:g}"
        )
        return Check(name, "warning", text, advice)
    return Check(name, "ok", text)


def round_trip(trip_s: float | None, clock: str, *, due: bool) -> Check:
    """How long a message takes there and back.

    Args:
        trip_s: of TIMESYNC, None while there was no answer.
        clock: what is wrong with the vehicle's clock, "" nothing.
        due: an answer should have come by now.
    """
    if trip_s is None:
        if not due:
            return Check("round trip", "blocking", f"{WAITING}an answer to TIMESYNC")
        text = "it does not answer TIMESYNC: times of validity are those of arrival, less the shortest delay"
        return Check("round trip", "warning", text, "update the firmware, or let a router pass TIMESYNC")
    text = f"{trip_s * 1000.0:.0f} ms"
    if clock:
        return Check("round trip", "warning", f"{text}; {clock}", "a simulated vehicle must run in real time")
    if trip_s > ROUND_TRIP_MAX_S:
        advice = f"more than {ROUND_TRIP_MAX_S * 1000:.0f} ms: take a faster link"
        return Check("round trip", "blocking", text, advice)
    if trip_s > ROUND_TRIP_WARN_S:
        return Check("round trip", "warning", text, "the formation will be held less closely")
    return Check("round trip", "ok", text)


def signing(session: Session, section: MavlinkSection, now_ns: int) -> Check:
    """Whether what is said to it, and what it says, is signed."""
    if section.signing_key is None and _unsigned(session):
        advice = "name its key in mavlink.signing_key"
        answers = {stream.answer for stream in session.streams(now_ns)}
        if session.answered_ns is not None or answers & {"accepted", "denied"}:
            text = "the vehicle signs, and this port of it takes what is not signed"
            return Check("signing", "warning", text, advice)
        if answers == {"waiting"}:
            return Check("signing", "blocking", f"{WAITING}an answer to what is not signed", advice)
        return Check("signing", "blocking", "the vehicle signs, and takes nothing that is not signed", advice)
    if section.signing_key is None:
        advice = "whoever reaches its link can drive it: see docs/rovers.md, signing"
        return Check("signing", "warning", "messages are not signed", advice)
    # With a key a vehicle that does not sign with it is not heard at all: that is the line of the session.
    if session.bad_signatures:
        text = f"on; refused for another key's or an old signature: {session.bad_signatures} messages"
        return Check("signing", "warning", text, "somebody else on the link has another key, or repeats them")
    return Check("signing", "ok", "on, the vehicle signs")


def participants(session: Session, now_ns: int) -> Iterator[Check]:
    """Who else is on the session."""
    other = session.another_bridge(now_ns)
    if other:
        yield Check("other bridges", "blocking", other, "end it: two would pull the vehicle two ways")
    stations = session.ground_stations(now_ns)
    if stations:
        shown = ", ".join(str(system) for system, _ in stations)
        yield Check("ground station", "ok", f"system {shown}")
    if session.strangers and session.settings.system is None:
        shown = ", ".join(str(system) for system in sorted(session.strangers))
        yield Check("other vehicles", "warning", f"systems {shown} on the same link", "give mavlink.system")


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
    """Rover's own rule for its EKF failsafe: the variance of the velocity beyond the threshold `most`, or
    both others. A compass alone may be upset by the current of a motor."""
    variances = {
        "velocity": ekf.velocity_variance,
        "position": ekf.position_variance,
        "compass": ekf.compass_variance,
    }
    beyond = {name: variance for name, variance in variances.items() if not variance < most}
    if len(beyond) > 1 or "velocity" in beyond:
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


def ekf(link: Session, now_ns: int) -> Check:
    """What its EKF says of itself."""
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


def gps(link: Session, now_ns: int) -> Check:
    """What its GPS says of itself."""
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


def origin(link: Session, datum: Geodetic) -> Check:
    """The origin of its EKF against the datum."""
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


def place(where: Pose | None, start: tuple[float, float]) -> Check:
    """Where it is (W), None while that is not seen, against x, y (m, W) of its start in the fleet file."""
    if where is None:
        return Check("place", "blocking", f"{WAITING}its position", "see what its EKF and its link wait for")
    apart = hypot(where.x - start[0], where.y - start[1])
    text = f"({where.x:.2f}, {where.y:.2f}) m, {apart:.1f} m from its start in the fleet file"
    if apart > START_TOO_FAR_M:
        return Check("place", "blocking", text, "bring it there, or correct x_m, y_m or [datum]")
    if apart > START_FAR_M:
        return Check("place", "warning", text, "it will drive from where it is: is the way free?")
    return Check("place", "ok", text)
