"""The MAVLink session: whom it believes, what it asks for and how often, what it never sends."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session.identity import EPOCH_S, Signing, Timestamps
from handfast.bridges.mavlink.session.session import Session, SessionSettings
from tests.unit.bridges.mavlink.session.clock_error import error_ns

T0 = 1_700_000_000 * NS_PER_S
MS = NS_PER_S // 1000
TICK_NS = 40 * MS
HOME = Geodetic(47.3977, 8.5456, 500.0)
KEY = bytes(range(32))


class Speaker:
    """Somebody on the link, as packed by pymavlink itself."""

    def __init__(self, system: int = 3, component: int = 1) -> None:
        self.mav = dialect.MAVLink(None, system, component)

    def __getattr__(self, name: str) -> Callable[..., bytes]:
        encode = getattr(self.mav, f"{name}_encode")

        def pack(*values: Any) -> bytes:
            data = bytes(encode(*values).pack(self.mav))
            self.mav.seq = (self.mav.seq + 1) % 256
            return data

        return pack

    def alive(
        self, mode: int = constants.MODE_GUIDED, armed: bool = True, kind: int = 10, autopilot: int = 3
    ) -> bytes:
        return self.heartbeat(kind, autopilot, 1 | (128 if armed else 0), mode, 4, 3)

    def position(self, stamp_ms: int, north: float = 1.0) -> bytes:
        return self.local_position_ned(stamp_ms, north, 2.0, 0.0, 0.5, -0.5, 0.0)

    def yaw(self, stamp_ms: int, yaw: float = 0.5) -> bytes:
        return self.attitude(stamp_ms, 0.0, 0.0, yaw, 0.0, 0.0, 0.1)


def read(data: bytes) -> list[Any]:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser.parse_buffer(data) or []


def named(data: bytes, name: str) -> list[Any]:
    return [message for message in read(data) if message.get_type() == name]


def joined(settings: SessionSettings | None = None, system: int = 3) -> tuple[Session, Speaker]:
    """A session that has heard its vehicle at T0, and that vehicle."""
    link, rover = Session(settings or SessionSettings(parameters=())), Speaker(system)
    link.receive(T0, rover.alive())
    return link, rover


def run(link: Session, rover: Speaker, since_ns: int, seconds: float, name: str) -> list[tuple[float, Any]]:
    """Ticks, the vehicle only beating; what was sent of one message, with its time in s."""
    sent = []
    for index in range(round(seconds * NS_PER_S / TICK_NS)):
        now_ns = since_ns + index * TICK_NS
        if index % 25 == 0:
            link.receive(now_ns, rover.alive())
        sent += [((now_ns - since_ns) / NS_PER_S, message) for message in named(link.tick(now_ns), name)]
    return sent


def state(link: Session, command: int) -> str:
    outcome = link.outcome(command)
    assert outcome is not None
    return outcome.state


# Whom it believes.


def test_the_first_autopilot_is_the_vehicle_and_nobody_else() -> None:
    link = Session(SessionSettings())
    link.receive(T0, Speaker(255, 190).heartbeat(6, 8, 0, 0, 4, 3))  # a ground station
    link.receive(T0, Speaker(3, 191).heartbeat(18, 8, 0, 0, 4, 3))  # a companion
    link.receive(T0, Speaker(3, 1).heartbeat(6, 3, 0, 0, 4, 3))  # a ground station as component 1
    link.receive(T0, Speaker(3, 1).heartbeat(10, 8, 0, 0, 4, 3))  # a rover without an autopilot
    link.receive(T0, Speaker(3, 2).alive())  # a second autopilot's component
    assert link.system is None
    assert link.absence(T0) == "no heartbeat of a vehicle yet"
    link.receive(T0, Speaker(3).alive())
    link.receive(T0, Speaker(4).alive(mode=constants.MODE_HOLD))
    assert (link.system, link.mode, link.armed) == (3, constants.MODE_GUIDED, True)
    assert link.absence(T0) == ""
    assert link.strangers == {4: constants.TYPE_GROUND_ROVER}


def test_a_vehicle_with_another_id_is_noted_not_taken() -> None:
    link = Session(SessionSettings(system=3))
    link.receive(T0, Speaker(4).alive())
    assert link.system is None
    assert link.absence(T0) == "no vehicle with system id 3 here, but with 4 (ground rover)"
    assert link.setpoint(0.1, 0.0) == b""


@pytest.mark.parametrize("system", [0, 255])
def test_a_vehicle_with_an_id_that_is_none_is_not_taken(system: int) -> None:
    link = Session(SessionSettings())
    link.receive(T0, Speaker(system).alive())
    assert link.system is None
    assert (
        link.absence(T0) == f"no vehicle with system id from 1 to 254 here, but with {system} (ground rover)"
    )
    assert link.own == (1, 191)
    assert link.setpoint(0.1, 0.0) == b""


@pytest.mark.parametrize(
    ("kind", "autopilot", "problem"),
    [
        (10, 3, ""),
        (11, 3, ""),
        (2, 3, "is a quadrotor (MAV_TYPE 2), not a rover"),
        (99, 3, "is a vehicle of another kind (MAV_TYPE 99), not a rover"),
        (10, 12, "runs PX4 (MAV_AUTOPILOT 12), not ArduPilot"),
    ],
)
def test_only_a_rover_of_ardupilot_is_driven(kind: int, autopilot: int, problem: str) -> None:
    link, rover = Session(SessionSettings(datum=HOME, parameters=())), Speaker()
    link.receive(T0, rover.alive(kind=kind, autopilot=autopilot))
    assert link.problem == problem
    assert bool(link.setpoint(0.1, 0.0)) is not bool(problem)
    link.command_arm(True)
    link.command_mode(constants.MODE_GUIDED)
    sent = link.tick(T0)
    for command in (constants.CMD_COMPONENT_ARM_DISARM, constants.CMD_DO_SET_MODE):
        assert bool(requests(sent, command)) is not bool(problem)
    assert bool(named(sent, "SET_GPS_GLOBAL_ORIGIN")) is not bool(problem)


@pytest.mark.parametrize("sender", [(4, 1), (3, 191), (255, 190)])
def test_what_others_say_changes_nothing(sender: tuple[int, int]) -> None:
    link, _ = joined()
    other = Speaker(*sender)
    link.receive(T0, other.position(1000) + other.yaw(1000) + other.gps_global_origin(47 * 10**7, 8, 0))
    link.receive(T0, other.ekf_status_report(831, 0, 0, 0, 0, 0) + other.statustext(2, b"PreArm: no"))
    link.receive(T0, other.heartbeat(18, 8, 0, constants.MODE_HOLD, 4, 3))
    assert [*link.take_positions(), *link.take_attitudes(), *link.take_texts()] == []
    assert link.origin is link.ekf is None
    assert (link.mode, link.armed) == (constants.MODE_GUIDED, True)


@pytest.mark.parametrize(
    "settings",
    [
        {"system": 255},
        {"system": 0},
        {"component": 1},
        {"component": 0},
        {"state_rate_hz": 0.0},
        {"state_rate_hz": nan},
        {"token": -1},
    ],
)
def test_an_identity_that_is_anothers_is_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        SessionSettings(**settings)


# What it sends by itself.


def test_the_own_heartbeat_goes_out_once_a_second_from_the_first_tick() -> None:
    link = Session(SessionSettings(token=77, parameters=()))
    first = named(link.tick(T0), "HEARTBEAT")
    assert [(m.type, m.autopilot, m.custom_mode) for m in first] == [(18, 8, 77)]
    sent = run(link, Speaker(), T0 + NS_PER_S, 5.0, "HEARTBEAT")
    assert [time for time, _ in sent] == pytest.approx([0, 1, 2, 3, 4], abs=0.05)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for _, m in sent} == {(3, 191)}
    assert not named(Session(SessionSettings()).tick(T0), "COMMAND_LONG")


def test_timesync_four_times_a_second_bounds_the_clock() -> None:
    link, rover = joined()
    sent = run(link, rover, T0, 10.0, "TIMESYNC")
    assert len(sent) == 40
    asked = sent[-1][1].ts1
    assert sent[-1][1].tc1 == 0
    link.receive(asked + 20 * MS, rover.timesync(70_000 * MS, asked))
    link.receive(asked + 90 * MS, rover.timesync(71_000 * MS, asked))  # the same again: not believed
    link.receive(asked + 20 * MS, rover.timesync(72_000 * MS, asked + 1))  # not ours
    assert error_ns(link.clock) == 10 * MS
    link.receive(asked + 60 * MS, rover.yaw(70_050))
    (sample,) = link.take_attitudes()
    assert sample.valid_ns == pytest.approx(asked + 60 * MS, abs=11 * MS)


def test_a_timesync_of_others_is_answered() -> None:
    link, rover = joined()
    link.receive(T0, rover.timesync(0, 12345))
    answers = [m for m in named(link.tick(T0 + MS), "TIMESYNC") if m.tc1]
    assert [(m.tc1, m.ts1) for m in answers] == [(T0 + MS, 12345)]
    assert not [m for m in named(link.tick(T0 + 2 * MS), "TIMESYNC") if m.tc1]


def requests(data: bytes, command: int) -> list[Any]:
    return [m for m in named(data, "COMMAND_LONG") if m.command == command]


# Commands.


def test_arming_is_asked_three_times_and_never_forced() -> None:
    link, rover = joined()
    link.receive(T0, rover.alive(armed=False))
    link.command_arm(True)
    sent = []
    for index in range(150):
        now_ns = T0 + index * TICK_NS
        if index % 25 == 0:
            link.receive(now_ns, rover.alive(armed=False))
        sent += [(index, m) for m in requests(link.tick(now_ns), 400)]
    assert [(index, m.param1, m.param2, m.confirmation) for index, m in sent] == [
        (0, 1.0, 0.0, 0),
        (25, 1.0, 0.0, 1),
        (50, 1.0, 0.0, 2),
    ]
    assert state(link, 400) == "no answer"


@pytest.mark.parametrize(("mode", "armed"), [(constants.MODE_HOLD, False), (constants.MODE_GUIDED, True)])
def test_an_order_is_not_repeated_after_the_operator_acted(mode: int, armed: bool) -> None:
    link, rover = joined()
    link.receive(T0, rover.alive(constants.MODE_MANUAL, armed=False))
    link.command_mode(constants.MODE_GUIDED)
    link.command_arm(True)
    sent = link.tick(T0)
    assert [(m.param1, m.param2) for m in requests(sent, 176)] == [(1.0, 15.0)]
    assert requests(sent, 400)
    link.receive(T0 + NS_PER_S, rover.alive(mode, armed))
    for index in range(100):
        sent = link.tick(T0 + NS_PER_S + index * TICK_NS)
        assert not requests(sent, 176)
        assert not requests(sent, 400)


# Setpoints.


def test_a_setpoint_is_what_the_facts_give() -> None:
    link, _ = joined()
    (message,) = read(link.setpoint(-0.5, 0.25))
    assert (message.target_system, message.target_component) == (3, 1)
    assert (message.coordinate_frame, message.type_mask) == (8, 0x5C7)
    assert (message.vx, message.vy, message.vz) == (-0.5, 0.0, 0.0)
    assert message.yaw_rate == -0.25  # clockwise seen from above: FRD


@pytest.mark.parametrize("wrong", [nan, inf, -inf, 1e39, 31.0])
def test_a_setpoint_that_is_not_finite_or_beyond_sense_is_never_sent(wrong: float) -> None:
    link, _ = joined()
    assert link.setpoint(wrong, 0.0) == b""
    assert link.setpoint(0.0, wrong) == b""
    assert link.counts.total() == 2


# Reports.


def test_reports_are_kept_with_their_units() -> None:
    link, rover = joined()
    link.receive(T0, rover.ekf_status_report(831, 0.1, 0.2, 0.3, nan, 0.0))
    link.receive(T0, rover.gps_raw_int(0, 6, 0, 0, 0, 87, 0, 0, 0, 14))
    bits = constants.SENSOR_PREARM_CHECK
    link.receive(T0, rover.sys_status(bits, bits, 0, 0, 12600, 0, 88, 0, 0, 0, 0, 0, 0))
    link.receive(
        T0, rover.autopilot_version(0, 0x040507FF, 0, 0, 0, b"1a2b3c4d", bytes(8), bytes(8), 0, 0, 0)
    )
    assert link.ekf == (T0, 831, pytest.approx(0.1), pytest.approx(0.2), inf)
    assert link.gps == (T0, constants.GPS_RTK_FIXED, 14, 0.87)
    assert link.battery == (12.6, 88)
    assert link.prearm_ok is False
    assert link.firmware == "4.5.7 (1a2b3c4d)"
    link.receive(T0, rover.sys_status(bits, 0, bits, 0, 65535, 0, -1, 0, 0, 0, 0, 0, 0))
    link.receive(T0, rover.gps_raw_int(0, 1, 0, 0, 0, 65535, 0, 0, 0, 255))
    assert link.battery == (None, None)
    assert link.prearm_ok is None
    assert link.gps == (T0, constants.GPS_NO_FIX, 0, None)


def test_samples_come_in_order_once_and_finite() -> None:
    link, rover = joined()
    link.receive(T0, rover.position(1000, 1.0) + rover.position(1040, 2.0))
    link.receive(T0 + MS, rover.position(1040, 9.0) + rover.position(1000, 9.0) + rover.position(1080, nan))
    assert [(s.stamp_ms, s.arrival_ns, s.north) for s in link.take_positions()] == [
        (1000, T0, 1.0),
        (1040, T0, 2.0),
    ]
    assert link.take_positions() == []
    assert link.counts == {"out of order": 2, "not finite": 1}


def test_parameters_are_read_and_what_is_missing_is_said() -> None:
    link, rover = joined(SessionSettings(parameters=("FS_ACTION", "MAV_SYSID", "WP_SPEED")))
    asked = {m.param_id for _, m in run(link, rover, T0, 1.0, "PARAM_REQUEST_READ")}
    assert asked == {"FS_ACTION", "MAV_SYSID", "WP_SPEED"}
    link.receive(T0, rover.param_value(b"FS_ACTION", 2.0, 9, 900, 5))
    link.receive(T0, rover.param_value(b"WP_SPEED", nan, 9, 900, 6))
    link.receive(T0, rover.param_error(3, 191, b"MAV_SYSID", -1, 1))
    assert link.parameters == {"FS_ACTION": 2.0, "MAV_SYSID": None}
    assert not link.parameters_done
    link.receive(T0, rover.param_value(b"WP_SPEED", 3.0, 9, 900, 6))
    assert link.parameters_done
    assert link.parameter(("MAV_SYSID", "WP_SPEED")) == 3.0


# The origin.


def test_the_datum_is_offered_once_a_second_until_an_origin_is_told() -> None:
    link, rover = joined(SessionSettings(datum=HOME, parameters=()))
    offered = run(link, rover, T0, 3.0, "SET_GPS_GLOBAL_ORIGIN")
    assert [time for time, _ in offered] == pytest.approx([0, 1, 2], abs=0.05)
    assert {(m.target_system, m.latitude, m.longitude, m.altitude) for _, m in offered} == {
        (3, 473977000, 85456000, 500000)
    }
    link.receive(T0, rover.gps_global_origin(473977001, 85456000, 501000))
    assert link.origin_ours
    assert run(link, rover, T0 + 3 * NS_PER_S, 65.0, "SET_GPS_GLOBAL_ORIGIN") == []
    link.receive(T0, rover.gps_global_origin(473977100, 85456000, 500000))
    assert link.origin == Geodetic(47.39771, 8.5456, 500.0)
    assert not link.origin_ours


def test_no_origin_is_offered_without_a_datum() -> None:
    link, rover = joined(SessionSettings(parameters=()))
    assert run(link, rover, T0, 3.0, "SET_GPS_GLOBAL_ORIGIN") == []


@pytest.mark.parametrize("place", [(0, 0), (910_000_000, 0), (1, 1_900_000_000)])
def test_an_origin_that_is_no_place_is_not_believed(place: tuple[int, int]) -> None:
    link, rover = joined()
    link.receive(T0, rover.gps_global_origin(*place, 0))
    assert link.origin is None


# Beginning anew.


def known(settings: SessionSettings | None = None) -> tuple[Session, Speaker]:
    link, rover = joined(settings)
    link.receive(
        T0, rover.position(60_000) + rover.yaw(60_000) + rover.gps_global_origin(473977001, 85456000, 0)
    )
    link.receive(T0, rover.gps_raw_int(0, 3, 0, 0, 0, 87, 0, 0, 0, 14))
    for index in range(20):
        now_ns = T0 + index * TICK_NS
        if requests(link.tick(now_ns), 511):
            link.receive(now_ns, rover.command_ack(511, 0, 0, 0, 3, 191))
    assert all(row.granted_hz for row in link.streams(T0))
    return link, rover


@pytest.mark.parametrize("by", ["stamp", "timesync"])
def test_after_a_reboot_nothing_is_believed_and_all_is_asked_again(by: str) -> None:
    link, rover = known()
    epoch, now_ns = link.epoch, T0 + NS_PER_S
    if by == "stamp":
        link.receive(now_ns, rover.position(1500))
    else:
        asked = named(link.tick(now_ns), "TIMESYNC")[0].ts1
        link.receive(now_ns, rover.timesync(1500 * MS, asked))
    assert link.epoch == epoch + 1
    assert (link.heartbeat_ns, link.mode, link.armed, link.origin, link.gps) == (
        None,
        None,
        False,
        None,
        None,
    )
    assert [s.stamp_ms for s in link.take_positions()] == ([1500] if by == "stamp" else [])
    assert link.take_attitudes() == []
    assert link.system == 3
    link.receive(now_ns, rover.alive(constants.MODE_HOLD, armed=False))
    sent = link.tick(now_ns)
    assert requests(sent, 511)
    assert link.mode == constants.MODE_HOLD
    link.receive(now_ns + TICK_NS, rover.position(1540))
    assert link.epoch == epoch + 1


def test_a_message_that_is_merely_late_is_no_reboot() -> None:
    link, rover = known()
    link.receive(T0 + NS_PER_S, rover.position(59_500))
    assert (link.epoch, link.mode) == (0, constants.MODE_GUIDED)


def test_after_the_connection_was_opened_again_the_vehicle_may_be_another() -> None:
    link, rover = known()
    asked = named(link.tick(T0 + NS_PER_S), "TIMESYNC")[0].ts1
    link.receive(asked + 20 * MS, rover.timesync(61_000 * MS, asked))
    assert error_ns(link.clock) is not None
    link.receive(T0, rover.alive()[:9])  # half a message
    link.restart()
    assert (link.epoch, link.system, link.heartbeat_ns, link.mode, link.armed) == (1, None, None, None, False)
    assert link.setpoint(0.1, 0.0) == b""
    assert error_ns(link.clock) is None
    assert not requests(link.tick(T0 + NS_PER_S), 511)
    link.receive(T0 + NS_PER_S, Speaker(5).alive(constants.MODE_HOLD))
    assert (link.system, link.mode) == (5, constants.MODE_HOLD)
    sent = link.tick(T0 + NS_PER_S)
    assert requests(sent, 511)
    assert {m.get_srcSystem() for m in read(sent)} == {5}


# Others on the link.


def test_a_ground_station_may_be_there_another_bridge_may_not() -> None:
    link, _ = joined(SessionSettings(token=77))
    link.receive(T0, Speaker(255, 190).heartbeat(6, 8, 0, 0, 4, 3))
    link.receive(T0, Speaker(3, 154).heartbeat(26, 8, 0, 0, 4, 3))  # a gimbal
    link.receive(T0, Speaker(3, 193).heartbeat(30, 8, 0, 0, 4, 3))  # a camera
    link.receive(T0, Speaker(3, 158).heartbeat(18, 8, 0, 0, 4, 3))  # a peripheral's controller
    link.receive(T0, Speaker(4, 191).heartbeat(18, 8, 0, 0, 4, 3))  # the bridge of another vehicle
    assert link.ground_stations(T0) == [(255, 190)]
    assert link.another_bridge(T0) == ""
    link.receive(T0, Speaker(3, 240).heartbeat(18, 8, 0, 0, 4, 3))  # MAVROS
    assert link.another_bridge(T0) == (
        "another onboard controller is on this vehicle (system 3, component 240)"
    )
    later_ns = T0 + 5 * NS_PER_S + 1
    assert link.another_bridge(later_ns) == ""
    assert link.ground_stations(later_ns) == []


def test_an_echo_is_not_another_bridge_a_twin_is() -> None:
    link, _ = joined(SessionSettings(token=77))
    link.receive(T0, link.tick(T0))
    assert link.another_bridge(T0) == ""
    link.receive(T0, Speaker(3, 191).heartbeat(18, 8, 0, 78, 4, 3))
    assert "this bridge's own identity" in link.another_bridge(T0)


# Signing.

SIGNED_NS = (EPOCH_S + 10**8) * NS_PER_S


def signed(system: int = 3, key: bytes = KEY, stamp_ns: int = SIGNED_NS) -> Speaker:
    speaker = Speaker(system)
    speaker.mav.signing.secret_key = key
    speaker.mav.signing.sign_outgoing = True
    speaker.mav.signing.timestamp = (stamp_ns - EPOCH_S * NS_PER_S) // 10_000
    return speaker


@pytest.fixture
def signing_link(tmp_path: Path) -> Any:
    stamps = Timestamps(tmp_path / "stamp", SIGNED_NS)
    yield Session(SessionSettings(signing=Signing(KEY, stamps), parameters=()))
    stamps.close()


def test_with_a_key_only_signed_messages_count(signing_link: Session) -> None:
    link = signing_link
    link.receive(T0, Speaker(3).alive())
    assert link.absence(T0) == "what comes is not signed: give the vehicle this signing key"
    link.receive(T0, signed(key=bytes(32)).alive())
    assert link.system is None
    link.receive(T0, signed().alive())
    assert link.system == 3
    assert (link.signed, link.bad_signatures, link.unsigned_refused) == (1, 1, 1)


def test_what_is_sent_is_signed_with_growing_stamps(signing_link: Session) -> None:
    link = signing_link
    link.receive(SIGNED_NS, signed().alive())
    sent = [
        link.tick(SIGNED_NS),
        link.setpoint(0.1, 0.0),
        link.tick(SIGNED_NS + TICK_NS),
        link.setpoint(0.1, 0),
    ]
    reader = dialect.MAVLink(None)
    reader.signing.secret_key = KEY
    messages = [m for data in sent for m in reader.parse_buffer(data) or []]  # raises on a stamp used twice
    assert len(messages) >= 5
    assert all(m.get_signed() for m in messages)


def test_a_message_is_not_taken_twice_nor_from_long_ago(signing_link: Session) -> None:
    link = signing_link
    old = signed(stamp_ns=SIGNED_NS - 61 * NS_PER_S).alive()
    link.receive(T0, old)
    assert link.system is None
    data = signed().alive()
    link.receive(T0, data)
    link.receive(T0, data)
    assert (link.signed, link.bad_signatures) == (1, 2)


def test_a_forged_stamp_does_not_shut_the_vehicle_out(signing_link: Session) -> None:
    link = signing_link
    forged = bytearray(signed(stamp_ns=SIGNED_NS + 10**18).alive())
    forged[-1] ^= 1
    link.receive(T0, bytes(forged))
    link.receive(T0, signed().alive())
    assert link.system == 3


def test_without_a_key_it_is_known_whether_the_vehicle_signs() -> None:
    link, _ = joined()
    assert not link.vehicle_signs
    link.receive(T0, signed().alive())
    assert link.vehicle_signs
    assert link.unsigned_refused == 0
