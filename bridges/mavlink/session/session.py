"""The MAVLink session with one rover, without clock, socket or thread: bytes in, bytes out.

What a link has to carry at 25 Hz of state and 20 setpoints a second (MAVLink 2, unsigned; a signature adds 13
bytes to each message): down 2.1 kB/s (ATTITUDE and LOCAL_POSITION_NED 40 bytes each, all the rest 0.1 kB/s),
up 1.4 kB/s (setpoint 65 bytes, heartbeat, TIMESYNC): of 57600 baud 36 and 25 %, which a cable carries at
once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, Final, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants, frames
from handfast.bridges.mavlink.session import reports
from handfast.bridges.mavlink.session.identity import KEY_BYTES
from handfast.bridges.mavlink.session.identity import SessionSettings as SessionSettings
from handfast.bridges.mavlink.session.receiver import Receiver
from handfast.bridges.mavlink.session.reports import AttitudeSample, Battery, PositionSample, Text
from handfast.bridges.mavlink.session.requests import Outcome
from handfast.bridges.mavlink.session.streams import FENCE, StreamRow

HEARTBEAT_PERIOD_NS: Final = NS_PER_S
HEARTBEAT_TIMEOUT_NS: Final = 3 * NS_PER_S
"""A vehicle that has sent no heartbeat for this long (ArduPilot: 1 Hz at least) is not connected."""
ANSWERED_NS: Final = 5 * NS_PER_S
"""Of twenty questions in this time, a link that loses most of them both ways brings one answer back."""
HELD_BACK_NS: Final = 4 * NS_PER_S
"""It is said once a second, and holds for as long as it takes to see that the vehicle does not follow."""
TIMESYNC_PERIOD_NS: Final = NS_PER_S // 4
ORIGIN_PERIOD_NS: Final = NS_PER_S
ORIGIN_AGAIN_NS: Final = 30 * NS_PER_S
VERSION_PERIOD_NS: Final = 2 * NS_PER_S
LOOK_PERIOD_NS: Final = NS_PER_S // 4
"""When all is known and granted, it is only looked at so often whether that still holds."""
TOKEN_NS: Final = 65536
"""So much of the token goes into a question for the time: 66 us at most."""
MAVLINK_VERSION: Final = 3
"""Of MAVLink 1 and 2 alike, as heartbeats tell it."""
SPEED_MAX: Final = 30.0
YAW_RATE_MAX: Final = 30.0
"""Setpoints (m/s, rad/s) beyond these are a mistake, not a wish."""
_T = TypeVar("_T")


class Session(Receiver):
    """The session with one rover: what it says (`Receiver`), and what is said to it.

    The caller brings bytes with their times of arrival (`receive`), sends what `tick` and `setpoint` return,
    and calls `restart` when the connection was opened (again).
    """

    def __init__(self, settings: SessionSettings) -> None:
        super().__init__(settings)
        self._target = dialect.MAVLink_set_position_target_local_ned_message(
            0,
            0,
            constants.COMPONENT_AUTOPILOT,
            constants.FRAME_BODY_NED,
            constants.MASK_SPEED_AND_YAW_RATE,
            *(0.0, 0.0, 0.0),
            *(0.0, 0.0, 0.0),
            *(0.0, 0.0, 0.0),
            0.0,
            0.0,
        )

    # What is known.

    @property
    def origin_ours(self) -> bool:
        """Whether the EKF's origin is the datum."""
        datum = self.settings.datum
        return self.origin is not None and datum is not None and reports.same_place(self.origin, datum)

    @property
    def prearm_ok(self) -> bool | None:
        """Whether the vehicle's own checks before arming pass; None: it does not say."""
        return None if self.status is None else self.status.prearm_ok

    @property
    def battery(self) -> Battery | None:
        """Its battery, None before the first report."""
        return None if self.status is None else self.status.battery

    @property
    def parameters(self) -> Mapping[str, float | None]:
        """Values read; None for a parameter it does not have, missing while it is still asked for."""
        return self._parameters.values

    @property
    def parameters_done(self) -> bool:
        """Whether all have been read, or given up."""
        return self._parameters.done

    @property
    def parameter_changes(self) -> int:
        """Grows whenever a value may have changed."""
        return self._parameters.changes

    def parameter(self, names: str | Sequence[str]) -> float | None:
        """The value of the first of these names that the vehicle has."""
        return self._parameters.first(names)

    @property
    def signed(self) -> int:
        """Messages with a good signature."""
        return int(self._codec.signing.goodsig_count)

    @property
    def bad_signatures(self) -> int:
        """Messages refused because of another key or an old timestamp."""
        return int(self._codec.signing.badsig_count)

    @property
    def unsigned_refused(self) -> int:
        """Messages refused because they were not signed; 0 without a key."""
        signing = self._codec.signing
        return int(signing.reject_count - signing.badsig_count)

    def heartbeat_age_ns(self, now_ns: int) -> int | None:
        """Time since the vehicle's last heartbeat; None: there was none since the (re)start."""
        return None if self.heartbeat_ns is None else max(0, now_ns - self.heartbeat_ns)

    def connected(self, now_ns: int) -> bool:
        """Whether its heartbeat is fresh."""
        heard_ns = self.heartbeat_ns
        return heard_ns is not None and now_ns - heard_ns < HEARTBEAT_TIMEOUT_NS

    def absence(self, now_ns: int) -> str:
        """Why it is not connected, "" when it is."""
        if self.connected(now_ns):
            return ""
        age_ns = self.heartbeat_age_ns(now_ns)
        if age_ns is not None:
            return f"no heartbeat of the vehicle for {age_ns / NS_PER_S:.1f} s"
        vehicles = self._participants.vehicles(now_ns)
        if vehicles:
            heard = ", ".join(f"{v.system} ({constants.TYPE_NAMES.get(v.type, v.type)})" for v in vehicles)
            meant = self.settings.system or f"from 1 to {constants.SYSTEM_GROUND_STATION - 1}"
            return f"no vehicle with system id {meant} here, but with {heard}"
        if self.unsigned_refused:
            return "what comes is not signed: give the vehicle this signing key"
        if self.bad_signatures:
            return "what comes is signed with another key or an old time: give the vehicle this signing key"
        return "no heartbeat of a vehicle yet"

    def unanswered(self, now_ns: int) -> bool:
        """Whether it is heard, but has answered nothing of all that it was asked."""
        since_ns = self.heard_since_ns
        if since_ns is None or self.answered_ns is not None or not self.connected(now_ns):
            return False
        return now_ns - since_ns >= ANSWERED_NS

    def held_back(self, now_ns: int) -> bool:
        """Whether it holds itself back before its own fence."""
        return self.held_back_ns is not None and now_ns - self.held_back_ns < HELD_BACK_NS

    def streams(self, now_ns: int) -> list[StreamRow]:
        """The messages asked for, and how often they come."""
        return self._streams.rows(now_ns)

    def outcome(self, command: int) -> Outcome | None:
        """What became of the last command of that number (MAV_CMD), None when there was none."""
        return self._commands.outcome(command)

    def another_bridge(self, now_ns: int) -> str:
        """Who else may steer the vehicle, "" nobody."""
        return self._participants.another_bridge(now_ns, self.own, self.system or 0)

    def ground_stations(self, now_ns: int) -> list[tuple[int, int]]:
        """System and component of those heard in the last 5 s; they may be there."""
        return [(station.system, station.component) for station in self._participants.ground_stations(now_ns)]

    def other_vehicles(self, now_ns: int) -> list[int]:
        """System ids of the autopilots that are on this link now, but for the one that is meant."""
        return [vehicle.system for vehicle in self._participants.vehicles(now_ns)]

    @property
    def strangers(self) -> dict[int, int]:
        """Other vehicles that were heard on this link: MAV_TYPE by system id."""
        return self._participants.strangers()

    def take_positions(self) -> list[PositionSample]:
        """The samples since the last call, in order of their stamps."""
        return _emptied(self._positions)

    def take_attitudes(self) -> list[AttitudeSample]:
        """The samples since the last call, in order of their stamps."""
        return _emptied(self._attitudes)

    def take_modes(self) -> list[tuple[int | None, bool]]:
        """Mode and whether it is armed, as it has said since the last call, each change once. Not only the
        last: an operator who took the vehicle and gave it back meanwhile has had it."""
        return _emptied(self._modes)

    def take_texts(self) -> list[Text]:
        """What the vehicle said since the last call."""
        return _emptied(self._texts)

    # What is said to it.

    def setpoint(self, speed: float, yaw_rate: float) -> bytes:
        """The message that asks for a forward speed (m/s, negative in reverse) and a yaw rate (rad/s, FLU:
        counter-clockwise). b"" while there is no vehicle, for one that is not a rover, and for numbers that
        are not finite or beyond all sense, which are counted: NaN makes ArduPilot abort.

        BODY_NED with mask 0x5C7: Rover takes sqrt(vx^2 + vy^2) * sign(vx), so vx is the speed. Speed 0 turns
        on the spot.
        """
        if not (isfinite(speed) and isfinite(yaw_rate)):
            self.counts["setpoint not finite"] += 1
            return b""
        if abs(speed) > SPEED_MAX or abs(yaw_rate) > YAW_RATE_MAX:
            self.counts["setpoint out of range"] += 1
            return b""
        if self.system is None or self.problem:
            return b""
        message = self._target
        message.target_system, message.vx, message.yaw_rate = self.system, speed, frames.yaw_rate(yaw_rate)
        return self._codec.encoded(message)

    def command_mode(self, mode: int) -> None:
        """Asks for a custom mode, up to three times: `outcome(constants.CMD_DO_SET_MODE)`. Not again once the
        mode has changed: that may have been the operator. Never of a vehicle that is not a rover.
        """
        if not self.problem:
            self._commands.give(constants.CMD_DO_SET_MODE, constants.FLAG_CUSTOM_MODE, mode)

    def command_arm(self, arm: bool) -> None:
        """Arms or disarms, never by force, asking up to three times:
        `outcome(constants.CMD_COMPONENT_ARM_DISARM)`. Never a vehicle that is not a rover.
        """
        if not self.problem:
            self._commands.give(constants.CMD_COMPONENT_ARM_DISARM, 1.0 if arm else 0.0)

    def setup_signing(self, key: bytes, timestamp: int) -> bytes:
        """The message that gives the vehicle a signing key (32 bytes) and the time (10 us since 2015) from
        which it signs: readable for whoever listens, so over a cable only. b"" while there is no vehicle and
        while it is armed, when ArduPilot takes none. There is no answer but that it signs (`vehicle_signs`).

        Raises:
            ValueError: no key.
        """
        if len(key) != KEY_BYTES or not any(key):
            raise ValueError(
                f"a signing key has {KEY_BYTES} bytes that are not all 0, which switches signing off"
            )
        if self.system is None or self.armed:
            return b""
        message = dialect.MAVLink_setup_signing_message(
            self.system, constants.COMPONENT_AUTOPILOT, tuple(key), timestamp
        )
        return self._codec.encoded(message)

    def tick(self, now_ns: int) -> bytes:
        """All that is due but the setpoint: own heartbeat, TIMESYNC, requests and their repetition. Called
        from the live loop, so that a loop that hangs is not heard either.
        """
        signing = self.settings.signing
        if signing is not None:
            codec = self._codec.signing
            codec.timestamp = signing.timestamps.next(now_ns, codec.timestamp)
        self._texts.extend(self._text_parts.overdue(now_ns))
        messages = []
        if self._is_due("heartbeat", now_ns, HEARTBEAT_PERIOD_NS):
            messages.append(self._heartbeat())
        while self._replies:
            messages.append(dialect.MAVLink_timesync_message(now_ns, self._replies.popleft()))
        system = self.system
        if system is not None and self.connected(now_ns):
            if self._is_due("timesync", now_ns, TIMESYNC_PERIOD_NS):
                # Bridges of one fleet tick at the same times: the token tells whose question it was. A little
                # early is still before it was sent, which is all that `BootClock` needs.
                asked_ns = now_ns - self.settings.token % TOKEN_NS
                self._asked.append(asked_ns)
                self._own_times.append(asked_ns)
                messages.append(dialect.MAVLink_timesync_message(0, asked_ns))
            messages += self._requests(now_ns, system)
        else:
            # An order to arm that has waited for the link must not reach the vehicle when it comes back.
            self._commands.cancel()
            self._streams.cancelled()
        return b"".join(map(self._codec.encoded, messages))

    def _requests(self, now_ns: int, system: int) -> list[Any]:
        settled = (
            not self._commands.waiting and self._parameters.done and self.firmware and self.origin is not None
        )
        if settled and not self._is_due("look", now_ns, LOOK_PERIOD_NS):
            return []
        component = constants.COMPONENT_AUTOPILOT
        self._next_stream(now_ns)
        out = [
            dialect.MAVLink_command_long_message(system, component, command, confirmation, *values)
            for command, confirmation, values in self._commands.due(now_ns)
        ]
        again_ns = ORIGIN_PERIOD_NS if self.origin is None else ORIGIN_AGAIN_NS
        if self._is_due("origin", now_ns, again_ns):
            datum = self.settings.datum
            if self.origin is None and datum is not None and not self.problem:
                place = reports.scaled(datum)
                out.append(dialect.MAVLink_set_gps_global_origin_message(system, *place, now_ns // 1000))
            out.append(_request_message(system, constants.MESSAGE_GPS_GLOBAL_ORIGIN))
        if not self.firmware and self._is_due("version", now_ns, VERSION_PERIOD_NS):
            out.append(_request_message(system, constants.MESSAGE_AUTOPILOT_VERSION))
        name = self._parameters.ask(now_ns)
        if name is not None:
            out.append(
                dialect.MAVLink_param_request_read_message(system, component, name.encode("ascii"), -1)
            )
        return out

    def _next_stream(self, now_ns: int) -> None:
        outcome = self._commands.take(constants.CMD_SET_MESSAGE_INTERVAL)
        if outcome is not None:
            self._streams.answered(now_ns, outcome.result)
        if self.parameter(constants.FENCE_ENABLE):
            self._streams.want(FENCE)
        wanted = self._streams.ask(now_ns)
        if wanted is not None:
            self._commands.give(constants.CMD_SET_MESSAGE_INTERVAL, *wanted)

    def _heartbeat(self) -> Any:
        return dialect.MAVLink_heartbeat_message(
            constants.TYPE_ONBOARD_CONTROLLER,
            constants.AUTOPILOT_INVALID,
            0,
            self.settings.token,
            constants.STATE_ACTIVE,
            MAVLINK_VERSION,
        )

    def _is_due(self, name: str, now_ns: int, period_ns: int) -> bool:
        last_ns = self._due.get(name)
        if last_ns is not None and 0 <= now_ns - last_ns < period_ns:
            return False
        # On a grid, so that ticks do not stretch the period; not one that lies far back.
        late = last_ns is None or now_ns - last_ns >= 2 * period_ns or now_ns < last_ns
        self._due[name] = now_ns if late or last_ns is None else last_ns + period_ns
        return True


def _request_message(system: int, number: int) -> Any:
    values = (float(number), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return dialect.MAVLink_command_long_message(
        system, constants.COMPONENT_AUTOPILOT, constants.CMD_REQUEST_MESSAGE, 0, *values
    )


def _emptied(queue: deque[_T]) -> list[_T]:
    out = list(queue)
    queue.clear()
    return out
