"""The session against the simulated rover, joined in memory, in virtual time."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session.identity import EPOCH_S, Signing, Timestamps
from handfast.bridges.mavlink.session.session import Session, SessionSettings
from handfast.bridges.mavlink.simulator.rover import Rover
from handfast.bridges.mavlink.simulator.settings import Settings

T0 = 1_700_000_000 * NS_PER_S
HOME = Geodetic(47.3977, 8.5456, 500.0)
STEP_NS = NS_PER_S // 100
TICK_STEPS = 4
KEY = bytes(range(32))


class Wire:
    """A session and a rover with `delay_s` each way between them; a share `loss` of the datagrams is lost."""

    def __init__(
        self, link: Session, rover: Rover, port: int = 0, delay_s: float = 0.005, loss: float = 0.0
    ) -> None:
        self.link, self.rover, self.port = link, rover, port
        self.now_ns = T0
        self.command: tuple[float, float] | None = None
        self.cut = False
        self.others: list[Wire] = []
        """On other ports of the same rover."""
        self._delay_ns, self._loss = round(delay_s * NS_PER_S), loss
        self._random = random.Random(1)
        self._down: deque[tuple[int, bytes]] = deque()
        self._up: deque[tuple[int, bytes]] = deque()
        self._steps = 0
        self.sent_bytes = self.received_bytes = 0

    def _carries(self) -> bool:
        return not self.cut and self._random.random() >= self._loss

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Lets time pass; returns how much it took, s."""
        begun_ns = self.now_ns
        wires = [self, *self.others]
        while self.now_ns - begun_ns < seconds * NS_PER_S and not until():
            for wire in wires:
                wire.now_ns += STEP_NS
                while wire._up and wire._up[0][0] <= wire.now_ns:
                    said = wire._up.popleft()[1]
                    self.rover.receive(wire.port, said, wire.now_ns)
                    for other in wires:
                        if other is not wire:  # a router passes it on
                            other._down.append((wire.now_ns + wire._delay_ns, said))
            for port, data in self.rover.advance(self.now_ns):
                for wire in wires:
                    if port == wire.port and wire._carries():
                        wire.received_bytes += len(data)
                        wire._down.append((wire.now_ns + wire._delay_ns, data))
            self._steps += 1
            if self._steps % TICK_STEPS == 0:
                for wire in wires:
                    wire._tick()
        return (self.now_ns - begun_ns) / NS_PER_S

    def _tick(self) -> None:
        while self._down and self._down[0][0] <= self.now_ns:
            self.link.receive(*self._down.popleft())
        out = self.link.tick(self.now_ns)
        if self.command is not None:
            out += self.link.setpoint(*self.command)
        if out and self._carries():
            self.sent_bytes += len(out)
            self._up.append((self.now_ns + self._delay_ns, out))

    def rates(self) -> dict[str, float]:
        return {row.name: row.measured_hz for row in self.link.streams(self.now_ns)}


def warm(hand_over: bool = True, **settings: object) -> Rover:
    return Rover(
        Settings(system=3, home=HOME, boot="warm", hand_over=hand_over, seed=1, **settings),  # type: ignore[arg-type]
        T0,
    )


def link(**settings: object) -> Session:
    return Session(SessionSettings(datum=HOME, **settings))  # type: ignore[arg-type]


def test_from_switching_on_to_driving() -> None:
    rover = Rover(Settings(system=3, home=HOME, hand_over=True, seed=1), T0)
    wire = Wire(link(system=3), rover)
    took = wire.run(60.0, lambda: wire.link.armed)
    assert 35.0 < took < 45.0
    assert wire.link.mode == constants.MODE_GUIDED
    assert wire.link.origin == HOME == rover.origin
    assert wire.link.origin_ours
    assert wire.link.prearm_ok is not None
    assert wire.link.firmware.startswith("4.7.0")
    assert wire.link.parameters_done
    assert wire.link.parameter(constants.GROUND_STATION_ID) == 255.0
    assert wire.link.absence(wire.now_ns) == wire.link.problem == ""
    wire.command = (0.5, 0.3)
    wire.run(3.0)
    assert rover.speed == pytest.approx(0.5, abs=0.03)
    assert rover.yaw_rate == pytest.approx(-0.3, abs=0.01)  # counter-clockwise
    wire.command = (-0.5, 0.0)
    wire.run(4.0)
    assert rover.speed == pytest.approx(-0.5, abs=0.03)
    wire.command = None
    wire.run(5.0)
    assert rover.speed == pytest.approx(0.0, abs=0.01)
    assert constants.SETPOINT_TIMEOUT_TEXT in [text.text for text in wire.link.take_texts()]


def test_rates_are_granted_kept_and_within_what_a_radio_carries() -> None:
    wire = Wire(link(), warm())
    wire.command = (0.2, 0.1)
    wire.run(12.0)
    assert wire.link.parameters_done
    assert {row.answer for row in wire.link.streams(wire.now_ns)} == {"accepted"}
    assert wire.rates()["ATTITUDE"] == pytest.approx(25.0, rel=0.03)
    assert wire.rates()["LOCAL_POSITION_NED"] == pytest.approx(25.0, rel=0.03)
    assert wire.rates()["HEARTBEAT"] == pytest.approx(5.0, rel=0.05)
    assert wire.link.clock.round_trip_ns is not None
    received, sent = wire.received_bytes, wire.sent_bytes
    wire.run(10.0)
    assert (wire.received_bytes - received) / 10 < 2600
    assert (wire.sent_bytes - sent) / 10 < 1900


def test_a_rate_above_what_is_granted_is_lowered() -> None:
    wire = Wire(link(state_rate_hz=50.0), warm())
    wire.run(8.0)
    row = wire.link.streams(wire.now_ns)[0]
    assert (row.asked_hz, row.granted_hz) == (50.0, 25.0)
    assert row.measured_hz == pytest.approx(25.0, rel=0.03)


def test_samples_are_dated_to_a_few_milliseconds() -> None:
    wire = Wire(link(), warm(), delay_s=0.1)
    wire.run(5.0)
    wire.link.take_attitudes()
    wire.run(1.0)
    samples = wire.link.take_attitudes()
    assert len(samples) == pytest.approx(25, abs=2)
    for sample in samples:
        true_ns = wire.rover.boot_ns + sample.stamp_ms * 1_000_000
        assert abs(sample.valid_ns - true_ns) < 25_000_000
        assert sample.arrival_ns - true_ns > 90_000_000


def test_everything_is_known_in_the_end_over_a_bad_link() -> None:
    wire = Wire(link(), warm(), delay_s=0.2, loss=0.3)
    took = wire.run(
        60.0,
        lambda: (
            wire.link.parameters_done
            and wire.link.origin is not None
            and bool(wire.link.firmware)
            and all(row.granted_hz for row in wire.link.streams(wire.now_ns))
        ),
    )
    assert took < 40.0, "each parameter more takes a second or two on such a link"
    assert wire.link.parameter("WP_SPEED") == 3.0
    wire.run(5.0)
    assert wire.rates()["ATTITUDE"] == pytest.approx(25.0 * 0.7, rel=0.25)
    assert wire.link.epoch == 0


def test_a_reboot_is_noticed_and_the_rates_are_asked_for_again() -> None:
    rover = warm()
    wire = Wire(link(), rover)
    wire.run(6.0)
    rover.reboot()
    assert wire.run(10.0, lambda: wire.link.epoch == 1) < 10.0
    assert not wire.link.armed
    wire.run(8.0)
    assert wire.link.epoch == 1
    assert wire.link.mode != constants.MODE_GUIDED
    assert wire.rates()["ATTITUDE"] == pytest.approx(25.0, rel=0.03)
    assert wire.run(60.0, lambda: wire.link.origin is not None) < 60.0


def test_a_link_that_was_cut_comes_back_by_itself() -> None:
    wire = Wire(link(), warm())
    wire.run(6.0)
    wire.cut = True
    wire.run(10.0)
    assert not wire.link.connected(wire.now_ns)
    assert "no heartbeat" in wire.link.absence(wire.now_ns)
    wire.cut = False
    assert wire.run(2.0, lambda: wire.link.connected(wire.now_ns)) <= 1.1
    wire.run(6.0)
    assert wire.rates()["ATTITUDE"] == pytest.approx(25.0, rel=0.03)
    assert wire.link.epoch == 0


def test_mode_and_arming_are_asked_for_and_answered() -> None:
    rover = warm(hand_over=False)
    wire = Wire(link(), rover)
    wire.run(5.0)
    assert not rover.armed
    wire.link.command_mode(constants.MODE_GUIDED)
    wire.run(1.0)
    assert (wire.link.mode, rover.mode) == (constants.MODE_GUIDED, "GUIDED")
    wire.link.command_arm(True)
    wire.run(1.0)
    assert wire.link.armed
    assert rover.armed
    for command in (constants.CMD_DO_SET_MODE, constants.CMD_COMPONENT_ARM_DISARM):
        outcome = wire.link.outcome(command)
        assert outcome is not None
        assert outcome.state == "accepted"


def test_arming_before_the_vehicle_is_ready_is_refused_and_does_no_harm() -> None:
    rover = Rover(Settings(system=3, home=HOME, seed=1), T0)
    wire = Wire(link(), rover)
    wire.run(25.0, lambda: wire.link.connected(wire.now_ns))
    wire.link.command_arm(True)
    wire.run(4.0)
    outcome = wire.link.outcome(constants.CMD_COMPONENT_ARM_DISARM)
    assert outcome is not None
    assert outcome.state == "refused"
    assert not rover.crashed


@pytest.mark.parametrize("port", [0, 1])
def test_a_signed_session(port: int, tmp_path: Path) -> None:
    stamps = Timestamps(tmp_path / "stamp", T0)
    assert EPOCH_S * NS_PER_S < T0
    rover = warm(ports=2, signing_key=KEY)
    wire = Wire(link(signing=Signing(KEY, stamps)), rover, port)
    wire.command = (0.5, 0.0)
    wire.run(8.0)
    stamps.close()
    assert wire.link.signed > 100
    assert wire.link.bad_signatures == 0
    assert wire.rates()["ATTITUDE"] == pytest.approx(25.0, rel=0.03)
    assert rover.speed == pytest.approx(0.5, abs=0.05)


def test_without_the_key_a_signed_port_does_not_obey() -> None:
    rover = warm(ports=2, signing_key=KEY)
    wire = Wire(link(), rover, port=1)
    wire.command = (0.5, 0.0)
    wire.run(8.0)
    assert rover.speed == pytest.approx(0.0, abs=0.01)
    assert wire.link.vehicle_signs
    assert wire.link.streams(wire.now_ns)[0].answer == "no answer"


def test_a_key_is_given_to_a_disarmed_vehicle_only(tmp_path: Path) -> None:
    rover = warm(hand_over=False, ports=2)
    wire = Wire(link(), rover)
    assert wire.link.setup_signing(KEY, 1) == b""
    wire.run(2.0)
    assert not wire.link.vehicle_signs
    stamps = Timestamps(tmp_path / "stamp", wire.now_ns)
    rover.receive(0, wire.link.setup_signing(KEY, stamps.next(wire.now_ns)), wire.now_ns)
    wire.run(2.0)
    assert wire.link.vehicle_signs
    other = Wire(link(signing=Signing(KEY, stamps)), rover, port=1)
    other.now_ns = wire.now_ns
    other.run(3.0)
    stamps.close()
    assert other.link.signed > 0
    rover.set_mode("GUIDED")
    rover.arm()
    other.run(2.0)
    assert other.link.armed
    assert other.link.setup_signing(bytes(reversed(KEY)), 1) == b""


@pytest.mark.parametrize("key", [bytes(32), bytes(range(31)), b""])
def test_what_is_no_key_is_not_given(key: bytes) -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        link().setup_signing(key, 1)


def test_two_bridges_on_two_ports_of_one_vehicle_find_each_other() -> None:
    rover = warm(ports=2)
    wire, other = (Wire(link(token=77 + port), rover, port) for port in (0, 1))
    wire.others = [other]
    wire.run(4.0)
    for found in (wire.link, other.link):
        assert "this bridge's own identity" in found.another_bridge(wire.now_ns)


def test_a_bridge_with_another_component_is_found_too() -> None:
    rover = warm(ports=2)
    wire, other = Wire(link(token=77), rover), Wire(link(component=192), rover, 1)
    wire.others = [other]
    wire.run(4.0)
    assert "component 192" in wire.link.another_bridge(wire.now_ns)
    assert "component 191" in other.link.another_bridge(wire.now_ns)


def test_one_bridge_alone_finds_nobody() -> None:
    wire = Wire(link(token=77), warm(ports=2))
    wire.run(10.0)
    assert wire.link.another_bridge(wire.now_ns) == ""
