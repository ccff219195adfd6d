"""Checks where a vehicle is before it drives: its EKF, its GPS, its origin and its place.

What keeps it from being relied on (`..._trouble`) holds while it drives, too.
"""

from __future__ import annotations

from functools import lru_cache
from math import hypot
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, geodetic_to_world
from handfast.bridges.mavlink.session.reports import Ekf
from handfast.bridges.mavlink.session.session import Session
from handfast.plant.backend import WAITING, Check

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
