"""Gives rovers the key with which they sign from then on: `handfast keys --signing`.

ArduPilot answers SETUP_SIGNING with nothing: that it took the key shows in what it sends, signed with it.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S, Clock
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.bridges.mavlink.session.identity import (
    SessionSettings,
    Signing,
    SigningError,
    open_signing,
    session_settings,
)
from handfast.bridges.mavlink.session.session import Session
from handfast.bridges.mavlink.transport.transport import Transport, open_transport

PERIOD_NS: Final = NS_PER_S // 25
VEHICLE_NS: Final = 15 * NS_PER_S
"""A vehicle must have been heard by then; it sends a heartbeat once a second."""
LISTEN_NS: Final = 2 * NS_PER_S
"""So long all that is on the link is listened to before one vehicle is given a key."""
CATCH_UP_NS: Final = 6 * NS_PER_S
"""A vehicle with this key whose signing time is behind has caught up with ours by then."""
GIVE_AGAIN_NS: Final = 2 * NS_PER_S
GIVE_MAX: Final = 3
CONFIRM_NS: Final = 8 * NS_PER_S
"""From the first time the key was given to the last moment at which a signed message may come."""
ANSWER_NS: Final = 3 * NS_PER_S
"""From the first good signature on; then it is enough that the vehicle signs."""


class Outcome(NamedTuple):
    """How it ended for one vehicle: whether it signs with the key, and in words, with what to do."""

    done: bool
    text: str


class SigningSetup:
    """Gives the vehicle behind `transport` a key, unless it is armed, no rover, or has another key.

    It listens twice: as somebody without a key, who hears everything, and as somebody with it.

    Args:
        settings: `bridges.mavlink.session.identity.session_settings`.
        signing: the key, and the timestamps of the vehicle's bridge.

    Attributes:
        outcome: None while it is not known.
    """

    def __init__(self, settings: SessionSettings, signing: Signing, transport: Transport) -> None:
        self.outcome: Outcome | None = None
        self._signing, self._transport = signing, transport
        self._open = Session(settings)
        self._signed = Session(replace(settings, signing=signing))
        self._transport_epoch = transport.epoch
        self._begun_ns: int | None = None
        self._heard_ns: int | None = None
        self._given_ns: list[int] = []
        self._good_ns: int | None = None
        self._said = ""

    def step(self, now_ns: int) -> None:
        """Takes what came and sends what is due; called at 10 Hz at least until there is an outcome."""
        if self._begun_ns is None:
            self._begun_ns = now_ns
        if self._transport_epoch != self._transport.epoch:
            self._transport_epoch = self._transport.epoch
            self._heard_ns = self._good_ns = None
            for link in (self._open, self._signed):
                link.restart()
        for arrival_ns, data in self._transport.receive():
            for link in (self._open, self._signed):
                link.receive(arrival_ns, data)
        for text in self._open.take_texts():
            if "signing" in text.text:
                self._said = text.text
        if self._open.connected(now_ns):
            if self._heard_ns is None:
                self._heard_ns = now_ns
            self.outcome = self._judged(now_ns, now_ns - self._heard_ns)
        elif now_ns - self._begun_ns >= VEHICLE_NS:
            self.outcome = Outcome(False, self._transport.trouble or self._open.absence(now_ns))
        if self.outcome is None:
            self._say(now_ns)

    def close(self) -> None:
        """Gives the connection and the file of timestamps back."""
        self._transport.close()
        self._signing.timestamps.close()

    def _judged(self, now_ns: int, heard_for_ns: int) -> Outcome | None:
        vehicle = self._open
        if vehicle.problem:
            return Outcome(False, f"it {vehicle.problem}: given no key")
        if heard_for_ns < LISTEN_NS and not self._given_ns:
            return None
        if vehicle.settings.system is None and vehicle.strangers:
            systems = ", ".join(map(str, sorted({vehicle.system or 0, *vehicle.strangers})))
            return Outcome(
                False, f"systems {systems} are on this link: say which is meant, with mavlink.system"
            )
        if self._signed.connected(now_ns):
            return self._confirmed(now_ns)
        if not self._given_ns:
            if vehicle.vehicle_signs:
                if heard_for_ns < CATCH_UP_NS:
                    return None
                return Outcome(
                    False,
                    "it signs with another key: name that one in mavlink.signing_key, or have a ground "
                    "station replace it over the vehicle's first serial port, which needs no signature",
                )
            if vehicle.armed:
                return Outcome(
                    False, "it is armed: disarm it first, ArduPilot takes a key only while disarmed"
                )
        elif now_ns - self._given_ns[0] >= CONFIRM_NS:
            return Outcome(
                False,
                "it was given the key and does not sign with it"
                + (f", but says: {self._said}" if self._said else "")
                + ": try over its USB port, without a router between",
            )
        return None

    def _confirmed(self, now_ns: int) -> Outcome | None:
        """It signs with the key. That it takes what we sign shows in an answer, which some routers keep."""
        if self._good_ns is None:
            self._good_ns = now_ns
        answers = self._signed.clock.round_trip_ns is not None or bool(self._signed.firmware)
        if not answers and now_ns - self._good_ns < ANSWER_NS:
            return None
        what = "signs with its key from now on" if self._given_ns else "had its key already, and signs"
        note = "" if answers else "; it has answered nothing yet: see what `handfast preflight` says of it"
        return Outcome(True, f"{what} (system {self._signed.system}){note}")

    def _say(self, now_ns: int) -> None:
        vehicle = self._open
        # Signed as soon as there is a key that it may have: a vehicle whose time is behind learns ours.
        ours = self._signed if vehicle.vehicle_signs or self._given_ns else vehicle
        out = ours.tick(now_ns)
        if self._may_be_given(now_ns):
            given = vehicle.setup_signing(self._signing.key, self._signing.timestamps.next(now_ns))
            if given:
                self._given_ns.append(now_ns)
                out += given
        if out:
            self._transport.send(out)

    def _may_be_given(self, now_ns: int) -> bool:
        if not self._open.connected(now_ns) or self._open.vehicle_signs or self._heard_ns is None:
            return False
        if not self._given_ns:
            return now_ns - self._heard_ns >= LISTEN_NS
        return len(self._given_ns) < GIVE_MAX and now_ns - self._given_ns[-1] >= GIVE_AGAIN_NS


def open_setup(fleet: Fleet, robot: int, clock: Clock) -> SigningSetup:
    """The setup of a robot whose section names a connection and a key, its connection being opened.

    Raises:
        SigningError: its key or its timestamps cannot be used.
        ValueError: its connection is none, or an identity is another's.
    """
    section = fleet.robot(robot).section(MavlinkSection)
    assert section is not None
    assert section.connection is not None
    assert section.signing_key is not None
    settings = session_settings(section, secrets.randbits(32))
    transport = open_transport(section.connection, section.baud, clock.now_ns, section.system)
    try:
        signing = open_signing(fleet.fleet.name, robot, section.signing_key, clock.now_ns())
    except SigningError:
        transport.close()
        raise
    return SigningSetup(settings, signing, transport)


def give_keys(
    setups: Mapping[int, SigningSetup],
    clock: Clock,
    interrupted: Callable[[], bool],
    ended: Callable[[int, Outcome], None],
) -> None:
    """Runs setups side by side until all have ended, or it is interrupted.

    Args:
        setups: by robot; the caller closes them.
        ended: called once for each robot with its outcome.
    """
    waiting = dict(setups)
    while waiting and not interrupted():
        now_ns = clock.now_ns()
        for robot, setup in list(waiting.items()):
            setup.step(now_ns)
            if setup.outcome is not None:
                del waiting[robot]
                ended(robot, setup.outcome)
        clock.sleep_until(now_ns + PERIOD_NS)
