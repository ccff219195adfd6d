"""Checks the link to a vehicle before it drives: who is there, whether it answers, how it carries."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from handfast.agent.fleet.mavlink_section import MavlinkSection
from handfast.bridges.mavlink.ardupilot import constants
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
        return "`handfast signing` gives it the key, by USB and while it is disarmed"
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
