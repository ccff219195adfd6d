"""The simulated rover moves as ArduRover was measured to (docs/rovers-measurements.md)."""

from __future__ import annotations

from math import inf, nan
from statistics import mean

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.random_streams import bits, stream
from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.rover import Rover
from handfast.bridges.mavlink.simulator.settings import Settings
from tests.unit.bridges.mavlink.rover_bench import (
    ACCEPTED,
    MASK_YAW_RATE,
    START_NS,
    Bench,
    ready,
)

# Setpoints


@pytest.mark.parametrize("frame", [1, 7, 8, 9])
def test_speed_and_yaw_rate_are_taken_in_four_frames(frame: int) -> None:
    bench = ready()
    bench.run(4.0, lambda: bench.drive(0.5, 0.3, frame=frame))
    assert bench.rover.speed == pytest.approx(0.5, abs=0.02)
    assert bench.rover.yaw_rate == pytest.approx(0.3, abs=0.01)


def test_negative_vx_reverses_and_the_speed_is_that_of_the_vector() -> None:
    bench = ready()
    bench.run(4.0, lambda: bench.drive(-0.3, 0.3, vy=0.4))
    assert bench.rover.speed == pytest.approx(-0.5, abs=0.02)
    assert bench.rover.yaw_rate == pytest.approx(0.3, abs=0.01)


def test_a_yaw_rate_alone_turns_on_the_spot() -> None:
    bench = ready()
    bench.run(3.0, lambda: bench.drive(0.5, -0.4, mask=MASK_YAW_RATE))
    assert bench.rover.speed == 0.0
    assert bench.rover.yaw_rate == pytest.approx(-0.4, abs=0.01)


@pytest.mark.parametrize(
    "mask",
    [
        0x407,  # acceleration, not masked out
        0x1C7,  # yaw and yaw rate together
        0xDFF,  # nothing at all
    ],
)
def test_masks_that_discard_the_whole_message(mask: int) -> None:
    bench = ready()
    bench.run(2.0, lambda: bench.drive(0.5, 0.3, mask=mask))
    assert (bench.rover.speed, bench.rover.yaw_rate) == (0.0, 0.0)


@pytest.mark.parametrize("silent", ["HOLD", "MANUAL", "disarmed"])
def test_without_guided_or_arming_commands_do_nothing(silent: str) -> None:
    bench = ready()
    if silent == "disarmed":
        bench.rover.disarm()
    else:
        bench.rover.set_mode(silent)
    bench.run(2.0, lambda: bench.drive(0.5, 0.3))
    assert bench.rover.speed == 0.0
    assert bench.of("COMMAND_ACK") == []


def test_arming_while_commands_flow_moves_it_at_once() -> None:
    bench = ready()
    bench.rover.disarm()
    bench.run(1.0, lambda: bench.drive(0.5))
    assert bench.rover.speed == 0.0
    assert bench.rover.arm()
    bench.run(1.0, lambda: bench.drive(0.5))
    assert bench.rover.speed > 0.4


def test_back_in_guided_it_stands_until_it_is_told_again() -> None:
    bench = ready()
    bench.run(2.0, lambda: bench.drive(0.5))
    bench.rover.set_mode("HOLD")
    bench.run(1.0)
    bench.rover.set_mode("GUIDED")
    bench.run(1.0)
    assert bench.rover.speed == 0.0


def test_before_its_origin_setpoints_are_dropped() -> None:
    bench = Bench()
    bench.run(10.0)
    assert bench.rover.set_mode("GUIDED")
    bench.run(1.0, lambda: bench.drive(nan))
    assert bench.rover.crashed == ""


@pytest.mark.parametrize("value", [nan, inf])
@pytest.mark.parametrize("field", ["speed", "vy", "yaw_rate"])
def test_a_number_that_is_none_ends_the_autopilot(field: str, value: float) -> None:
    bench = ready()
    bench.drive(**{"speed": 0.1, field: value})  # type: ignore[arg-type]
    bench.run(0.1)
    assert bench.rover.crashed
    assert any(line.startswith("crashed") for line in bench.rover.take_log())
    since = bench.time
    bench.run(3.0, bench.heartbeat)
    assert [t for t, _, _ in bench.heard if t > since] == []


@pytest.mark.parametrize(("enforce", "system", "moves"), [(0, 77, 1), (1, 77, 0), (1, 255, 1), (1, 1, 1)])
def test_who_is_obeyed(enforce: int, system: int, moves: int) -> None:
    bench = ready(parameters={"SYSID_ENFORCE": enforce})
    bench.run(2.0, lambda: bench.drive(0.5, system=system))
    assert (bench.rover.speed > 0.4) == bool(moves)


# Silence


def test_after_three_seconds_of_silence_it_stops_and_says_so() -> None:
    bench = ready()
    bench.run(4.0, lambda: bench.drive(0.5))
    last = bench.time - 0.05
    stood = bench.until(lambda: bench.rover.speed < 0.05)
    assert stood - last == pytest.approx(3.7, abs=0.15)
    assert bench.texts().count(constants.SETPOINT_TIMEOUT_TEXT) == 1
    assert (said := [t for t in bench.times("STATUSTEXT") if t > last]) == pytest.approx(
        [last + 3.0], abs=0.06
    )
    bench.run(5.0)
    assert len([t for t in bench.times("STATUSTEXT") if t > last]) == len(said)
    assert bench.rover.mode == "GUIDED"
    assert bench.rover.armed
    bench.run(1.0, lambda: bench.drive(0.5))
    assert bench.rover.speed > 0.4


def test_zero_stops_it_within_a_second() -> None:
    bench = ready()
    bench.run(4.0, lambda: bench.drive(0.5))
    since = bench.time
    while bench.rover.speed > 0.025:
        bench.run(0.05, lambda: bench.drive(0.0))
    assert bench.time - since == pytest.approx(0.8, abs=0.2)


# Response


def response(bench: Bench) -> tuple[float, float]:
    """s from the first command of a turn to a tenth of it: in truth, and as ATTITUDE says."""
    since = bench.time
    truth = seen = inf
    while truth == inf or seen == inf:
        bench.run(0.005, lambda: bench.drive(0.0, 0.3))
        if abs(bench.rover.yaw_rate) > 0.03:
            truth = min(truth, bench.time - since)
        if any(m.yawspeed > 0.03 for m in bench.of("ATTITUDE", since)):
            seen = min(seen, bench.time - since)
        assert bench.time < since + 1.0
    return truth, seen


def test_delay_in_truth_and_as_seen() -> None:
    truths, seens = [], []
    for seed in range(12):
        bench = ready(seed=seed)
        assert bench.interval(constants.MESSAGE_ATTITUDE, 25.0) == ACCEPTED
        bench.run(0.4 + 0.007 * seed)
        truth, seen = response(bench)
        truths.append(truth)
        seens.append(seen)
    assert mean(truths) == pytest.approx(0.052, abs=0.015)
    assert mean(seens) == pytest.approx(0.092, abs=0.015)


@pytest.mark.parametrize(
    ("speed", "yaw_rate", "parameters", "reached"),
    [
        (5.0, 0.0, {}, (3.0, 0.0)),
        (1.0, 0.0, {"WP_SPEED": 0.6}, (0.6, 0.0)),
        (0.0, 3.0, {}, (0.0, 2.094)),
        (0.0, 1.0, {"ATC_STR_RAT_MAX": 30}, (0.0, 0.524)),
        (3.0, 2.0, {"ATC_TURN_MAX_G": 0.2}, (3.0, 0.654)),
    ],
)
def test_limits(
    speed: float, yaw_rate: float, parameters: dict[str, float], reached: tuple[float, float]
) -> None:
    bench = ready(parameters=parameters)
    bench.run(8.0, lambda: bench.drive(speed, yaw_rate))
    assert (bench.rover.speed, bench.rover.yaw_rate) == pytest.approx(reached, abs=0.05)


# Any bytes, any calls


def test_garbage_does_no_harm() -> None:
    bench = Bench(boot="warm")
    draws = stream("garbage")
    for k in range(300):
        noise = bytes(bits(draws, 40 * k + i) & 0xFF for i in range(bits(draws, 40 * k + 39) % 40))
        bench.rover.receive(0, noise, bench.now_ns)
        bench.rover.receive(0, b"\xfd" + noise, bench.now_ns)
        bench.run(0.02)
    bench.rover.receive(0, bytes(300), bench.now_ns)
    bench.heard.clear()
    bench.until(lambda: bench.of("PARAM_VALUE") or bench.set_parameter("WP_SPEED", 2.0), 5.0)
    assert not bench.rover.crashed


def test_any_message_of_the_dialect_does_no_harm() -> None:
    bench = Bench(boot="warm", ports=2)
    for id_, kind in mavlink.mavlink_map.items():
        for fill in (0, 1, 0xFF):
            payload = bytes([fill]) * kind.unpacker.size
            codec = bench.sender()
            message = mavlink.MAVLink_message(id_, kind.msgname)
            bench.rover.receive(0, message._pack(codec, kind.crc_extra, payload), bench.now_ns)
            bench.run(0.02)
    since = bench.time
    bench.run(2.5)
    assert not bench.rover.crashed
    assert len(bench.of("HEARTBEAT", since, port=0)) >= 2


def test_the_same_calls_give_the_same_bytes() -> None:
    def once(step_ns: int) -> list[tuple[int, bytes]]:
        rover = Rover(Settings(boot="warm", hand_over=True, seed=3), START_NS)
        codec = mavlink.MAVLink(None, 255, 190)
        out = []
        for k in range(0, 4 * NS_PER_S, step_ns):
            if k % (NS_PER_S // 10) == 0:
                message = mavlink.MAVLink_set_position_target_local_ned_message(
                    0, 1, 1, 8, 0x5C7, 0, 0, 0, 0.5, 0, 0, 0, 0, 0, 0, 0.1
                )
                rover.receive(0, message.pack(codec), START_NS + k)
            out += rover.advance(START_NS + k)
        return out

    assert once(NS_PER_S // 100) == once(NS_PER_S // 100)
    # Not how often it is looked at, only what it is told and when, makes a difference.
    fine, coarse = once(NS_PER_S // 500), once(NS_PER_S // 50)
    assert fine[: len(coarse)] == coarse[: len(fine)]
