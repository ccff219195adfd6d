"""A rover as a plant: once a tick reads its link, decides who commands it, and sends its setpoint."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from math import hypot, radians
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.runtime.loop import Log
from handfast.agent.supervision.orders import AWAITED
from handfast.agent.supervision.state_machine import at_rest
from handfast.bridges.mavlink.ardupilot import constants, frames
from handfast.bridges.mavlink.ardupilot.dynamics import DEFAULTS, Limits
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, LocalToWorld
from handfast.bridges.mavlink.bridge import driving_checks, preflight_checks
from handfast.bridges.mavlink.bridge.authority import (
    BREACHED,
    REBOOTED,
    UNHEARD,
    Authority,
    Holder,
    OwnFailsafe,
    Takeover,
)
from handfast.bridges.mavlink.bridge.estimate import Estimate
from handfast.bridges.mavlink.bridge.setpoint import Bounds, MotionCheck, Setpoint
from handfast.bridges.mavlink.session.identity import Signing, session_settings
from handfast.bridges.mavlink.session.requests import AUDITED
from handfast.bridges.mavlink.session.session import Session
from handfast.bridges.mavlink.transport.transport import Transport
from handfast.plant.backend import WAITING, Check, Command, PlantBackend, Reading, Said

CHECKS_PERIOD_NS: Final = NS_PER_S // 2
CHECKS_DRIVING_NS: Final = 2 * NS_PER_S
"""All is looked at so often: before a drive, and in one, where only the battery is shown."""
COMMAND_PERIOD_NS: Final = NS_PER_S // 50 - NS_PER_S // 1000
"""Setpoints go out at every tick, but no faster than 50 Hz: the vehicle's own loop is not faster."""
RESUME_AFTER_NS: Final = 3 * NS_PER_S
"""Silence of a vehicle after which it is driven again only when the fleet is told to resume: its operator may
have had it meanwhile."""
BRAKE_AT_REST_NS: Final = NS_PER_S
BRAKE_NS_MAX: Final = 3 * NS_PER_S
"""Zero setpoints are sent until the vehicle has stood for the first, at most for the second: silence stops it
then."""
WATCHED_S: Final = 0.2
"""What a tick says of the motion holds for no longer: a process that was frozen has watched nothing."""
LISTEN_NS: Final = 2 * NS_PER_S
"""Another bridge sends its heartbeat once in half of this."""
JUDGED_NS: Final = NS_PER_S // 5
"""What was found of the vehicle's reports holds until it sends others, but no longer: they age, too."""
DOES_NOT_FOLLOW: Final = "does not follow its commands"
"""How `MotionCheck` begins."""
FENCED: Final = "stands before its own fence (AVOID_ENABLE)"
JUMP_M_MAX: Final = 5.0
"""A position that comes back further from the last good one than it can have driven, and so much more, is not
believed before somebody has looked: preflight warns of a start as far off."""
SAID_MAX: Final = 32
"""So many of its texts wait for a tick; of more the newest are kept."""
DISARMED: Final = "disarmed"
NOT_HEARD_YET: Final = f"{UNHEARD} when the fleet was told to drive, and its operator may have had it"
BEGUN_LATE: Final = f"its bridge has started in mid-drive, and its operator may have had it: {AWAITED}"
PREARM: Final = ("PreArm: ", "Arm: ")
_NUMBER: Final = re.compile(r"[0-9.]+")
_NOWHERE: Final = Pose(0.0, 0.0, 0.0, 0.0, 0.0)


def session(fleet: Fleet, robot: int, signing: Signing | None, token: int) -> Session:
    """The session with the vehicle of a robot, as the fleet file describes it.

    Args:
        token: any number that other bridges are not likely to have (`SessionSettings`).
    """
    section = fleet.robot(robot).section(MavlinkSection) or MavlinkSection()
    datum = frames.datum_of(fleet)
    return Session(session_settings(section, token, signing=signing, datum=datum, parameters=AUDITED))


def _operators(said: tuple[int | None, bool]) -> str:
    """What makes a vehicle its operator's, of the mode and arming that it said; "" when nothing does."""
    mode, armed = said
    if mode != constants.MODE_GUIDED:
        return f"mode {constants.mode_name(mode) if mode is not None else 'unknown'}, not GUIDED"
    return "" if armed else DISARMED


class MavlinkPlant(PlantBackend):
    """The vehicle of robot `robot` behind `transport`.

    Args:
        link: the session with it.
        log: takes a line for the log.
        look: it is there to look only, and arms nothing whatever the fleet file says.

    Attributes:
        authority: who has the vehicle.
    """

    def __init__(
        self, fleet: Fleet, robot: int, link: Session, transport: Transport, log: Log, *, look: bool = False
    ) -> None:
        body = fleet.robot(robot)
        self._section = section = body.section(MavlinkSection) or MavlinkSection()
        self._start = body.x_m, body.y_m
        self._datum = frames.datum_of(fleet)
        self._link, self._transport, self._log = link, transport, log
        self.authority: Final = Authority()
        bounds = Bounds(section.max_speed_mps, section.max_acceleration, section.max_yaw_rate_radps)
        self._setpoint = Setpoint(body.mass_kg, body.inertia_kgm2, bounds)
        self._asked: tuple[float, float] | None = None
        self._motion = MotionCheck()
        self._estimate = Estimate()
        self._yaw: float | None = None
        self._origin: Geodetic | None = None
        self._to_world: LocalToWorld | None = None
        self._limits_read = -1
        self._transport_epoch, self._session_epoch = transport.epoch, link.epoch
        self._pose = _NOWHERE
        self._known = self._located = self._placed = False
        self._placed_ns = 0
        self._jumped = ""  # how far its position was off when it came back, until the fleet is told to go on
        self._resume_after_ns = RESUME_AFTER_NS
        self._heartbeat_ns: int | None = None
        self._reboots = 0
        self._failsafe: Final = OwnFailsafe()
        self._breached = False
        self._texts: deque[Said] = deque(maxlen=SAID_MAX)
        self._listening_since_ns: int | None = None
        self._now_ns: int | None = None
        self._driving = False
        self._braking_since_ns: int | None = None
        self._resting_since_ns: int | None = None
        self._commanded_ns: int | None = None
        self._refusal = ""
        self._begun_late = False
        self._takeover = Takeover(link, log, wanted=section.arm and not look)
        self._interlude = ""  # what the operator did since the last tick, though it may be undone by now
        self._prearm = ""
        self._judged: tuple[object, ...] = ()  # the reports of which `_unfit` and `_unlocated` speak
        self._judged_until_ns = 0
        self._unfit = self._unlocated = ""
        self._checks: tuple[Check, ...] = ()
        self._checks_due_ns = 0
        self._said = ""

    # ------------------------------------------------------------------ one tick

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """See `PlantBackend.step`."""
        dt = 0.0 if self._now_ns is None else max(0.0, (now_ns - self._now_ns) / NS_PER_S)
        self._now_ns = now_ns
        self._listen()
        lapse = self._lapse()
        trouble = self._locate(now_ns)
        heard = self._link.connected(now_ns)
        operator = self._operator if heard else ""
        operator = operator or self._interlude
        self._failsafe.step(now_ns, operator)
        self.authority.step(trouble, operator, self._refusal, self._failsafe.why, lapse, heard=heard)
        if self.authority.holder is Holder.RELEASED or not self.authority.cleared:
            self._jumped = ""  # whoever has it knows where it is
        self._log_holder()
        self._takeover.step(now_ns, self.authority.holder, trouble)
        # A wrench of a drive that nobody has begun since this process did.
        self._begun_late = not self.authority.cleared and (self._begun_late or command is not None)
        if self._begun_late:
            command = None
        out = self._drive(now_ns, dt, command) + self._link.tick(now_ns)
        if out:
            self._transport.send(out)
        return self._reading(now_ns, trouble)

    def _listen(self) -> None:
        """Takes what the vehicle has said since the last tick."""
        link = self._link
        if self._transport_epoch != self._transport.epoch:
            self._transport_epoch = self._transport.epoch
            link.restart()
        for arrival_ns, data in self._transport.receive():
            link.receive(arrival_ns, data)
        self._interlude = next(filter(None, map(_operators, link.take_modes())), "")
        if self._session_epoch != link.epoch:
            self._session_epoch = link.epoch
            self._estimate.forget()
            self._yaw = None
            self._known = self._located = False
            self._takeover.begin_again()
            self._prearm = ""
        self._follow_motion()
        self._hear_texts()

    def _follow_motion(self) -> None:
        """Takes where the vehicle says it was."""
        link = self._link
        for attitude in link.take_attitudes():
            self._yaw = attitude.yaw
            self._estimate.attitude(
                attitude.valid_ns, frames.heading_from_yaw(attitude.yaw), frames.yaw_rate(attitude.rate)
            )
        if link.origin != self._origin:
            self._origin = link.origin
            self._to_world = None if link.origin is None else LocalToWorld(self._datum, link.origin)
        for position in link.take_positions():
            # Before its EKF has a position it says (0, 0), and jumps from there when it has one.
            if self._to_world is not None and self._yaw is not None and self._located:
                x, y = self._to_world(position.north, position.east)
                speed = frames.forward_speed(self._yaw, position.v_north, position.v_east)
                self._estimate.position(position.valid_ns, x, y, speed)

    def _hear_texts(self) -> None:
        """Takes the vehicle's texts, and what it says of its fence."""
        link = self._link
        if link.fence_breached and not self._breached:
            self._failsafe.hear(self._now_ns or 0, BREACHED)
        self._breached = link.fence_breached
        for text in link.take_texts():
            said = Said(constants.severity_name(text.severity), text.text)
            self._texts.append(said)
            self._failsafe.hear(self._now_ns or 0, said.text)
            self._log(f"the vehicle says ({said.severity}): {said.text}")
            for mark in PREARM:
                if text.text.startswith(mark):
                    self._prearm = text.text.removeprefix(mark)

    def _lapse(self) -> str:
        """What was between vehicle and bridge, at the tick when that is known; "" as a rule.

        It is heard again after so long that its operator may have had it, also where this process has stood:
        of what came meanwhile, no buffer keeps more than the first seconds. Or it has rebooted.
        """
        reboots, heard_ns, before_ns = self._link.clock.reboots, self._link.heartbeat_ns, self._heartbeat_ns
        if reboots != self._reboots:
            self._reboots = reboots
            return REBOOTED
        if heard_ns is None or heard_ns == before_ns:
            return ""
        self._heartbeat_ns = heard_ns
        if before_ns is None:  # whoever had the fleet drive before did not know of it
            return NOT_HEARD_YET if self.authority.cleared else ""
        if heard_ns - before_ns <= self._resume_after_ns:
            return ""
        silent_s = (heard_ns - before_ns) / NS_PER_S
        return f"{UNHEARD} for {silent_s:.1f} s, and its operator may have had it"

    def _locate(self, now_ns: int) -> str:
        """Finds the pose. Says why the vehicle is not there or cannot be relied on; "" when all is well."""
        found = self._estimate.pose_at(now_ns)
        self._placed = found.healthy
        if found.healthy:
            self._jumped = self._jumped or self._jump_to(found.pose, now_ns)
            self._pose, self._known, self._placed_ns = found.pose, True, now_ns
        link = self._link
        absence = self._trouble or link.absence(now_ns)
        if absence:
            self._listening_since_ns = None
        elif self._listening_since_ns is None:
            self._listening_since_ns = now_ns
        self._judge(now_ns)
        self._located = not self._unlocated
        return (
            absence
            or link.problem
            or driving_checks.silence(link, now_ns)
            or self._other_bridge(now_ns)
            or self._unfit
            or self._unlocated
            or found.note
            or self._jumped
        )

    def _jump_to(self, pose: Pose, now_ns: int) -> str:
        """How far it is from the last good position, where it cannot have driven there; else ""."""
        off = hypot(pose.x - self._pose.x, pose.y - self._pose.y)
        drove = self._section.max_speed_mps * (now_ns - self._placed_ns) / NS_PER_S
        far = self._known and off > drove + JUMP_M_MAX
        return f"its position jumped by {off:.2f} m: {AWAITED}" if far else ""

    def _judge(self, now_ns: int) -> None:
        """What GPS, EKF and origin say against driving; they come once or twice a second, ticks 25 times."""
        link = self._link
        reports = link.ekf, link.gps, link.origin, link.parameter_changes
        if reports != self._judged or now_ns >= self._judged_until_ns:
            self._judged, self._judged_until_ns = reports, now_ns + JUDGED_NS
            self._unfit = driving_checks.gps_trouble(link, now_ns)
            ekf = driving_checks.ekf_trouble(link, now_ns)
            self._unlocated = ekf or driving_checks.origin_trouble(link, self._datum)

    @property
    def _trouble(self) -> str:
        """Of the connection, "" when it is open."""
        trouble = self._transport.trouble
        return f"{WAITING}it: {trouble}" if trouble and self._transport.transient else trouble

    def _other_bridge(self, now_ns: int) -> str:
        """Which other bridge keeps this one from driving; it listens for a while before it believes in none.

        Of two, the one that has the vehicle keeps it; of two that start at once neither takes it.
        """
        if self.authority.holder is Holder.BRIDGE:
            return ""
        other = self._link.another_bridge(now_ns)
        since_ns = self._listening_since_ns
        if not other and since_ns is not None and now_ns - since_ns < LISTEN_NS:
            return f"{WAITING}other bridges to be heard, if there are any"
        return other

    @property
    def _operator(self) -> str:
        """What the vehicle's operator has still to do, or has undone; "" when it is in GUIDED and armed."""
        return _operators((self._link.mode, self._link.armed))

    def _log_holder(self) -> None:
        why = self.authority.why
        said = why and _NUMBER.sub("", why)  # an age that grows is not news
        if said != self._said:
            self._said = said
            self._checks_due_ns = 0
            self._log(why or "armed and in GUIDED: it obeys")

    # ------------------------------------------------------------------ commands

    def _drive(self, now_ns: int, dt: float, command: Command | None) -> bytes:
        """The setpoint of this tick; nothing unless the vehicle is the bridge's to command, or to brake."""
        if self._limits_read != self._link.parameter_changes:
            self._limits_read = self._link.parameter_changes
            self._setpoint.vehicle = self._vehicle_limits()
        residual = self._estimate.residual
        obeys = self.authority.holder is Holder.BRIDGE
        if obeys and command is not None:
            self._driving, self._braking_since_ns = True, None
        elif self._driving:
            # Disarmed in GUIDED it is told to stand: armed anew, it would take up what it was told last.
            taken = (self._operator or self._interlude) not in ("", DISARMED)
            self._driving = not taken and self._still_braking(now_ns)
        wanted = command if obeys else None
        asked = self._setpoint.step(dt, wanted, self._pose, residual)
        if self._setpoint.note:
            self._log(self._setpoint.note)
        predicted = self._estimate.predicted
        watched = self._driving and obeys
        self._refusal = self._motion.step(min(dt, WATCHED_S), watched, predicted, residual)
        if " m/s" in self._refusal and self._link.held_back(now_ns):
            self._refusal = self._refusal.replace(DOES_NOT_FOLLOW, FENCED)
        self._estimate.command(now_ns, *asked, self._setpoint.vehicle)
        if not self._driving:
            self._asked = None
            return b""
        if self._commanded_ns is not None and now_ns - self._commanded_ns < COMMAND_PERIOD_NS:
            return b""
        self._commanded_ns, self._asked = now_ns, asked
        return self._link.setpoint(*asked)

    def _still_braking(self, now_ns: int) -> bool:
        """False when the vehicle has stood for a while, or had time enough."""
        if self._braking_since_ns is None:
            self._braking_since_ns, self._resting_since_ns = now_ns, None
        if not self._standing:
            self._resting_since_ns = None
        elif self._resting_since_ns is None:
            self._resting_since_ns = now_ns
        rested = self._resting_since_ns is not None and now_ns - self._resting_since_ns >= BRAKE_AT_REST_NS
        return not rested and now_ns - self._braking_since_ns < BRAKE_NS_MAX

    @property
    def _standing(self) -> bool:
        """Whether the vehicle is at rest, by the newest pose that was good."""
        return at_rest(self._pose.speed, self._pose.yaw_rate)

    def _vehicle_limits(self) -> Limits:
        """What the vehicle's own parameters allow, as far as they are known."""
        link = self._link
        speed, acceleration, turn, turn_g = map(
            link.parameter,
            (
                constants.WP_SPEED,
                constants.ATC_ACCEL_MAX,
                constants.ATC_STR_RAT_MAX,
                constants.ATC_TURN_MAX_G,
            ),
        )
        return Limits(
            DEFAULTS.speed if speed is None else max(0.0, speed),
            DEFAULTS.acceleration if acceleration is None else max(0.0, acceleration),
            DEFAULTS.yaw_rate if turn is None else max(0.0, radians(turn)),
            DEFAULTS.turn_g if turn_g is None else max(0.0, turn_g),
        )

    def _reading(self, now_ns: int, trouble: str) -> Reading:
        """What the agent gets: where the vehicle is, and the motion of the body that the law drives.

        While the bridge drives, its speed and yaw rate are those of the reference (`setpoint`), else those
        measured: then `Setpoint.step` keeps the two alike.
        """
        pose = self._pose
        if self._driving and self.authority.holder is Holder.BRIDGE:
            pose = Pose(pose.x, pose.y, pose.heading, self._setpoint.speed, self._setpoint.yaw_rate)
        obeying = self.authority.holder is Holder.BRIDGE and not self._begun_late
        if trouble or not self._known:
            return Reading(now_ns, pose, 0.0, 0.0, False, trouble or "no position yet", obeying)
        note = self.authority.why or (BEGUN_LATE if self._begun_late else "")
        force, torque = self._setpoint.force, self._setpoint.torque
        return Reading(now_ns, pose, force, torque, True, note, obeying, self._asked)

    # ------------------------------------------------------------------ before and after

    def clear_to_drive(self) -> None:
        """See `PlantBackend.clear_to_drive`."""
        was, self._jumped = self.authority.holder, ""
        able = self.authority.clear_to_drive()
        if not able and self.authority.holder is Holder.RELEASED:
            self._log(f"told to drive, but cannot: {self.authority.why}")
        elif able and was is Holder.RELEASED:
            self._log("told to resume")

    def status_texts(self) -> Sequence[Said]:
        """See `PlantBackend.status_texts`."""
        if not self._texts:
            return ()
        said = tuple(self._texts)
        self._texts.clear()
        return said

    def checks(self, now_ns: int) -> tuple[Check, ...]:
        """See `PlantBackend.checks`."""
        if now_ns >= self._checks_due_ns:
            self._checks_due_ns = now_ns + (CHECKS_DRIVING_NS if self._driving else CHECKS_PERIOD_NS)
            link = self._link
            trip_ns = link.clock.round_trip_ns
            since_ns = now_ns if link.heard_since_ns is None else link.heard_since_ns
            found = preflight_checks.BridgeState(
                now_ns,
                self._trouble,
                self._transport.note,
                (now_ns - since_ns) / NS_PER_S,
                None if trip_ns is None else trip_ns / NS_PER_S,
                link.clock.note,
                self._pose if self._placed else None,
                self._start,
                self._prearm,
            )
            look = preflight_checks.Look(link, found, self._section, self._datum)
            self._checks = preflight_checks.checks(look)
        return self._checks

    def close(self) -> None:
        """See `PlantBackend.close`: a vehicle that was armed here, and stands, is disarmed."""
        now_ns = self._now_ns
        if (
            now_ns is not None
            and self._takeover.armed_here
            and self._link.armed
            and self._standing
            and not self._operator
        ):
            self._log("disarming it, as it was armed here")
            self._link.command_arm(False)
            self._transport.send(self._link.tick(now_ns))
        odd = dict(self._link.counts) | (
            {"not sent": self._transport.dropped} if self._transport.dropped else {}
        )
        if odd:
            self._log(
                f"odd on its link: {', '.join(f'{count} {what}' for what, count in sorted(odd.items()))}"
            )
        self._transport.close()
        signing = self._link.settings.signing
        if signing is not None:
            signing.timestamps.close()
