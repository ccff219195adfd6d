"""Checks a vehicle before it drives: the lines of `handfast preflight`.

A line at level blocking keeps the fleet from starting. One whose text begins with "waiting" may change by
itself within seconds. Each of `CHECKS` has a line of its name, at every look: one that cannot be answered yet
waits, so that nothing is taken for well that was not looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

from handfast.agent.control.hand import Pose
from handfast.agent.fleet.mavlink_section import MavlinkSection
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.bridge import link_checks, navigation_checks, parameter_audit
from handfast.bridges.mavlink.session.session import Session
from handfast.plant.backend import BATTERY, WAITING, Check

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
    return (*lines, *link_checks.participants(look.link, look.state.now_ns))


def _link(look: Look) -> Check:
    state = look.state
    return link_checks.link(look.link, look.section, state.now_ns, state.trouble, state.note)


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
    ("EKF", lambda of: (navigation_checks.ekf(of.link, of.state.now_ns),)),
    ("GPS", lambda of: (navigation_checks.gps(of.link, of.state.now_ns),)),
    ("origin", lambda of: (navigation_checks.origin(of.link, of.datum),)),
    ("place", lambda of: (navigation_checks.place(of.state.place, of.state.start),)),
    ("ATTITUDE", lambda of: (link_checks.rate(of.link, "ATTITUDE", of.state.now_ns),)),
    ("LOCAL_POSITION_NED", lambda of: (link_checks.rate(of.link, "LOCAL_POSITION_NED", of.state.now_ns),)),
    (
        "round trip",
        lambda of: (link_checks.round_trip(of.state.round_trip_s, of.state.clock, due=of.state.due),),
    ),
    ("steering", lambda of: parameter_audit.steers(of.link)),
    ("parameters", lambda of: parameter_audit.parameters(of.link, of.section, of.state.now_ns)),
    (BATTERY, _battery),
    ("signing", lambda of: (link_checks.signing(of.link, of.section, of.state.now_ns),)),
)
"""In the order of the lines."""
FIRST: Final = ("link", "type")
"""Of a vehicle that is not there, or not one of ours, nothing else is looked at."""
