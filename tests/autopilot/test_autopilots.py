"""The bridge against real ArduPilot Rovers: ArduPilot's own simulator, or vehicles on a field.

**VEHICLES NAMED HERE ARE ARMED AND DRIVE BY THEMSELVES**: a few metres each, about 10 m in the test of the
formation. Put them on open ground, 3 m and more from each other and 15 m from anything else, with the
transmitter on and somebody's thumb at its mode switch: any mode but GUIDED stops them, and fails the test.

    HANDFAST_AUTOPILOTS=tcp:127.0.0.1:5760+tcp:127.0.0.1:5762,tcp:127.0.0.1:5770+tcp:127.0.0.1:5772 \
        pytest tests/autopilot

names two of ArduPilot's simulator, each with a second port for the tests' operator; without one the operator
speaks on the bridge's connection. Start the simulators at places 3 m and more apart (`--home`), at speedup 1.
What is measured is judged by what a real ArduRover was measured to do (docs/rovers-measurements.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from math import cos, hypot, pi, sin

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Mission, PlantState
from handfast.agent.node import Node
from handfast.agent.supervision.state_machine import State
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.session.session import Session, SessionSettings
from handfast.plant.backend import Command, Reading
from handfast.plant.node import PlantNode
from tests.autopilot.vehicles import (
    BOOT_S,
    HAND_M,
    INERTIA,
    MASS,
    VARIABLE,
    Field,
    Vehicle,
    fleet_of,
    metres,
    places,
)
from tests.unit.bridges.mavlink.session.clock_error import error_ns

PLACES = places()
pytestmark = [
    pytest.mark.autopilot,
    pytest.mark.timeout(300),
    pytest.mark.skipif(
        not PLACES,
        reason=f"{VARIABLE} names no autopilots (as tcp:127.0.0.1:5760,udpin:0.0.0.0:14550); those that it "
        "names are armed and drive",
    ),
]
several = pytest.mark.skipif(
    len(PLACES) == 1, reason=f"{VARIABLE} names one autopilot; this needs two and more"
)
STILL_M = 0.15
"""What a rover that stands may creep, or its EKF drift, within seconds."""


@pytest.fixture(scope="module")
def field() -> Iterator[Field]:
    found = Field(PLACES)
    try:
        yield found
    finally:
        found.close()


@pytest.fixture(params=range(len(PLACES) or 1), ids=lambda index: f"vehicle{index + 1}")
def vehicle(request: pytest.FixtureRequest, field: Field) -> Vehicle:
    return field.vehicles[request.param]


def wrapped(angle: float) -> float:
    return (angle + pi) % (2.0 * pi) - pi


def at(speed: float, yaw_rate: float) -> Callable[[Reading], Command]:
    """Brings a vehicle to a speed and a yaw rate by forces, as the law does."""

    def command(reading: Reading) -> Command:
        acceleration = 2.0 * (speed - reading.pose.speed)
        spin = 3.0 * (yaw_rate - reading.pose.yaw_rate)
        return Command(MASS * max(-0.5, min(0.5, acceleration)), INERTIA * max(-1.0, min(1.0, spin)))

    return command


# ---------------------------------------------------------------------- what it says of itself


def test_it_is_there_and_is_a_rover(field: Field, vehicle: Vehicle) -> None:
    link = vehicle.link
    field.until(lambda: link.connected(time.time_ns()), "a heartbeat", BOOT_S)
    assert link.problem == ""
    assert link.autopilot == constants.AUTOPILOT_ARDUPILOT
    assert link.type in constants.ROVER_TYPES
    field.until(lambda: link.firmware, "its version", 30.0)
    print(f"system {link.system}, firmware {link.firmware}")


def test_the_streams_that_are_asked_for_come(field: Field, vehicle: Vehicle) -> None:
    def rates() -> dict[str, float]:
        return {row.name: row.measured_hz for row in vehicle.link.streams(time.time_ns()) if row.granted_hz}

    wanted = {"ATTITUDE": 25.0, "LOCAL_POSITION_NED": 25.0, "HEARTBEAT": 1.0, "EKF_STATUS_REPORT": 1.0}
    field.until(
        lambda: all(rates().get(name, 0.0) >= 0.8 * rate for name, rate in wanted.items()),
        "its streams",
        BOOT_S,
    )
    print(rates())


def test_a_rate_above_what_it_can_do_is_refused_and_a_lower_one_taken(field: Field, vehicle: Vehicle) -> None:
    field.until(lambda: vehicle.link.parameters_done, "its parameters", BOOT_S)
    loop_hz = vehicle.link.parameter(constants.SCHED_LOOP_RATE)
    if loop_hz is None or constants.STREAM_RATE_PART * loop_hz >= 50.0:
        pytest.skip(f"its loop rate is {loop_hz}: it grants 50 Hz")
    greedy = Session(SessionSettings(state_rate_hz=50.0, component=192))
    shared = vehicle.tee.other()

    def granted() -> float | None:
        now_ns = time.time_ns()
        for arrival_ns, data in shared.receive():
            greedy.receive(arrival_ns, data)
        shared.send(greedy.tick(now_ns))
        return greedy.streams(now_ns)[0].granted_hz

    field.until(granted, "a rate", 30.0)
    assert granted() == 25.0


def test_its_clock_is_found_by_timesync(field: Field, vehicle: Vehicle) -> None:
    clock = vehicle.link.clock
    field.until(
        lambda: clock.round_trip_ns is not None and error_ns(clock) is not None, "answers to TIMESYNC", 20.0
    )
    field.run(3.0)
    error = error_ns(clock)
    assert clock.round_trip_ns is not None
    assert error is not None
    print(f"round trip {clock.round_trip_ns / 1e6:.1f} ms, error {error / 1e6:.1f} ms, {clock.note}")
    assert clock.round_trip_ns < 0.5 * NS_PER_S
    assert error <= clock.round_trip_ns
    assert clock.note == "", "a simulator must run in real time (speedup 1, a machine that can)"


def test_its_parameters_are_read(field: Field, vehicle: Vehicle) -> None:
    field.until(lambda: vehicle.link.parameters_done, "its parameters", BOOT_S)
    for names in (constants.WP_SPEED, constants.ATC_ACCEL_MAX, constants.FS_ACTION):
        assert vehicle.link.parameter(names) is not None, names


def test_it_becomes_ready_and_nothing_blocks(field: Field, vehicle: Vehicle) -> None:
    def blocking() -> list[str]:
        return [str(c) for c in vehicle.plant.checks(time.time_ns()) if c.level == "blocking"]

    field.until(lambda: vehicle.reading is not None and not blocking(), "nothing blocks", BOOT_S)
    names = [check.name for check in vehicle.plant.checks(time.time_ns())]
    assert {"type", "mode", "arming", "EKF", "GPS", "origin", "ATTITUDE", "round trip", "battery"} <= set(
        names
    )


def test_its_origin_is_taken_into_account(field: Field, vehicle: Vehicle) -> None:
    """The position in the world agrees with the latitude and longitude that it tells besides."""
    field.ready(vehicle)
    field.until(lambda: "GLOBAL_POSITION_INT" in vehicle.operator.latest, "GLOBAL_POSITION_INT", 20.0)
    field.run(1.5)
    x, y = metres((field.datum.latitude_deg, field.datum.longitude_deg), vehicle.globally())
    assert (vehicle.pose.x, vehicle.pose.y) == pytest.approx((x, y), abs=0.1 + 1e-3 * hypot(x, y))


@several
def test_all_are_in_one_world(field: Field) -> None:
    field.ready()
    field.until(
        lambda: all("GLOBAL_POSITION_INT" in v.operator.latest for v in field.vehicles),
        "GLOBAL_POSITION_INT",
        20.0,
    )
    field.run(1.5)
    for one, other in pairwise(field.vehicles):
        apart = metres(one.globally(), other.globally())
        assert (other.pose.x - one.pose.x, other.pose.y - one.pose.y) == pytest.approx(apart, abs=0.1)


# ---------------------------------------------------------------------- driving


def test_it_is_armed_and_put_into_guided(field: Field, vehicle: Vehicle) -> None:
    field.ready(vehicle)
    assert (vehicle.link.mode, vehicle.link.armed) == (constants.MODE_GUIDED, True)
    place = vehicle.pose
    field.run(3.0)
    assert hypot(vehicle.pose.x - place.x, vehicle.pose.y - place.y) < STILL_M, "armed, it stands"


def drives(field: Field, vehicle: Vehicle, speed: float, metre: float = 1.0) -> tuple[float, float]:
    """Drives straight for a metre; returns how far it came along its heading and to the left of it, by
    GLOBAL_POSITION_INT and its own yaw."""
    field.ready(vehicle)
    field.run(1.2)
    start, begun, yaw = vehicle.pose, vehicle.globally(), vehicle.operator.latest["ATTITUDE"].yaw
    vehicle.command = at(speed, 0.0)
    try:
        field.until(
            lambda: hypot(vehicle.pose.x - start.x, vehicle.pose.y - start.y) >= metre,
            f"drives {metre} m",
            10.0,
        )
        reached = vehicle.pose.speed
    finally:
        vehicle.command = lambda _: None
    field.until(lambda: vehicle.standing, "stands again", 5.0)
    field.run(1.5)
    assert reached == pytest.approx(speed, abs=0.12)
    end = vehicle.pose
    along = (end.x - start.x) * cos(start.heading) + (end.y - start.y) * sin(start.heading)
    assert along == pytest.approx(metre * (1.0 if speed > 0.0 else -1.0), abs=0.7)
    east, north = metres(begun, vehicle.globally())
    return north * cos(yaw) + east * sin(yaw), north * sin(yaw) - east * cos(yaw)


def test_forward_is_forward(field: Field, vehicle: Vehicle) -> None:
    along, left = drives(field, vehicle, 0.5)
    assert 0.9 < along < 1.8
    assert abs(left) < 0.3


def test_reverse_is_backwards(field: Field, vehicle: Vehicle) -> None:
    along, left = drives(field, vehicle, -0.5)
    assert -1.8 < along < -0.9
    assert abs(left) < 0.3


def test_a_positive_yaw_rate_turns_counter_clockwise_on_the_spot(field: Field, vehicle: Vehicle) -> None:
    field.ready(vehicle)
    start, yaw = vehicle.pose, vehicle.operator.latest["ATTITUDE"].yaw
    vehicle.command = at(0.0, 0.4)
    turned, last = 0.0, start.heading
    end = time.monotonic() + 3.0
    while time.monotonic() < end:
        field.tick()
        turned += wrapped(vehicle.pose.heading - last)
        last = vehicle.pose.heading
    rate = vehicle.pose.yaw_rate
    vehicle.command = lambda _: None
    field.until(lambda: vehicle.standing, "stands again", 5.0)
    field.run(1.2)
    assert rate == pytest.approx(0.4, abs=0.1)
    assert 0.7 < turned < 1.5
    assert wrapped(vehicle.operator.latest["ATTITUDE"].yaw - yaw) < -0.7, "its own yaw is clockwise"
    assert hypot(vehicle.pose.x - start.x, vehicle.pose.y - start.y) < 0.4


def test_without_a_wrench_it_stops_and_is_left_in_peace(field: Field, vehicle: Vehicle) -> None:
    field.ready(vehicle)
    vehicle.command = at(0.5, 0.0)
    field.until(lambda: vehicle.pose.speed > 0.45, "drives", 5.0)
    vehicle.command = lambda _: None
    took = field.until(lambda: vehicle.standing, "stands", 3.0)
    print(f"stood after {took:.2f} s")
    field.run(4.0)
    assert vehicle.standing
    assert setpoints(vehicle, time.time_ns() - NS_PER_S // 2) == 0, "silence once it stands"
    assert (vehicle.link.mode, vehicle.link.armed) == (constants.MODE_GUIDED, True)


def setpoints(vehicle: Vehicle, since_ns: int) -> int:
    """How many the bridge has sent since."""
    return sum(
        "SET_POSITION_TARGET_LOCAL_NED" in names
        for at_ns, names in vehicle.tee.sent_names()
        if at_ns >= since_ns
    )


def test_the_operator_wins_and_gives_back_and_it_waits_for_leave(field: Field, vehicle: Vehicle) -> None:
    field.ready(vehicle)
    vehicle.command = at(0.4, 0.0)
    field.until(lambda: vehicle.pose.speed > 0.35, "drives", 5.0)
    field.operate(vehicle, lambda operator: operator.set_mode("HOLD"))
    field.until(lambda: vehicle.reading and not vehicle.reading.obeying, "is let go", 1.5)
    since_ns = time.time_ns()
    field.until(lambda: vehicle.standing, "stands", 5.0)
    assert vehicle.reading is not None
    assert "HOLD" in vehicle.reading.note
    field.operate(vehicle, lambda operator: operator.set_mode("GUIDED"))
    place = vehicle.pose
    field.run(4.0)
    assert not vehicle.reading.obeying
    assert hypot(vehicle.pose.x - place.x, vehicle.pose.y - place.y) < STILL_M
    assert setpoints(vehicle, since_ns) == 0
    vehicle.plant.clear_to_drive()
    field.until(lambda: vehicle.pose.speed > 0.2, "drives again", 5.0)
    vehicle.command = lambda _: None
    field.until(lambda: vehicle.standing, "stands", 5.0)


# ---------------------------------------------------------------------- together

DRIVE_S, SETTLE_S, LAST_S = 60.0, 20.0, 15.0
VELOCITY = (0.0, 0.15)
WIDER = 1.1
"""The formation is wanted so much larger than the vehicles stand."""


@several
def test_all_of_them_hold_a_formation_for_a_minute(field: Field) -> None:
    """By agents over a bus in memory. Each edge within 0.15 m after 20 s, 0.05 m over the last 15 s."""
    field.ready()
    hands = np.array(
        [
            [v.pose.x + HAND_M * cos(v.pose.heading), v.pose.y + HAND_M * sin(v.pose.heading)]
            for v in field.vehicles
        ]
    )
    nearest = min(float(np.hypot(*(a - b))) for i, a in enumerate(hands) for b in hands[:i])
    if nearest < 2.0:
        pytest.skip(
            f"two hand points are {nearest:.1f} m apart: put the vehicles 3 m and more from each other"
        )
    if np.ptp(hands, axis=0).max() > 40.0:
        pytest.skip("the vehicles are more than 40 m apart")
    centre = hands.mean(axis=0)
    n = len(hands)
    edges = [[i + 1, j + 1] for i in range(n) for j in range(i + 1, n) if n <= 3 or j == i + 1]
    formation = (
        f"[formation]\nedges = {edges}\nassign = false\nsafe_distance_m = 1.0\n"
        f"offsets = {(WIDER * (hands - centre)).round(4).tolist()}\n"
        '[control]\ncoupling = "joint"\nkp = 1.0\nc1 = 0.4\nc2 = 0.6\nkd = 1.8\nk2 = 5.0\n'
        "max_acceleration = 0.8\nplant_timeout_s = 0.5\nwrench_timeout_s = 0.25\n"
        f'[trajectory]\nkind = "line"\nstart_m = {centre.tolist()}\nvelocity_mps = {list(VELOCITY)}'
    )
    starts = [(v.pose.x, v.pose.y) for v in field.vehicles]
    fleet = fleet_of(PLACES, field.datum, formation, starts)
    agents = [Agent(fleet, robot) for robot in fleet.ids]
    plants = [PlantNode(fleet, v.robot, v.plant) for v in field.vehicles]
    nodes: list[Node] = [*plants, *agents]
    states: dict[int, PlantState] = {}

    def say(now_ns: int, key: str, payload: bytes) -> None:
        for node in nodes:
            if key in node.subscriptions:
                node.receive(now_ns, key, payload)
        message = decode(payload)
        if isinstance(message, PlantState):
            states[message.robot] = message

    def tick() -> int:
        field.wait()
        for node in nodes:
            now_ns = time.time_ns()
            for key, payload in node.tick(now_ns):
                say(now_ns, key, payload)
        for v in field.vehicles:
            v.operator.poll()
        return time.time_ns()

    def told() -> str:
        return "\n".join(
            [f"{a.robot}: {a.state.value} {a.reason}" for a in agents] + [v.told() for v in field.vehicles]
        )

    deadline = time.monotonic() + 10.0
    while not all(agent.state is State.READY for agent in agents):
        assert time.monotonic() < deadline, told()
        now_ns = tick()
    epoch_ns = now_ns + NS_PER_S // 2
    mission = Mission(1, now_ns, epoch_ns, round(DRIVE_S * NS_PER_S), digest(fleet))
    say(now_ns, key_expressions.mission(fleet.fleet.name), encode(mission))
    wanted = dict(zip(map(tuple, edges), resolve(fleet).distances, strict=True))
    worst: list[tuple[float, float]] = []
    while now_ns < epoch_ns + DRIVE_S * NS_PER_S:
        now_ns = tick()
        at_s = (now_ns - epoch_ns) / NS_PER_S
        if at_s > 1.0 and at_s < DRIVE_S - 0.2:
            assert all(agent.state is State.RUNNING for agent in agents), told()
        hand = {r: (s.x + HAND_M * cos(s.heading), s.y + HAND_M * sin(s.heading)) for r, s in states.items()}
        errors = [
            abs(hypot(hand[i][0] - hand[j][0], hand[i][1] - hand[j][1]) - d) for (i, j), d in wanted.items()
        ]
        worst.append((at_s, max(errors)))
        closest = min(
            hypot(hand[i][0] - hand[j][0], hand[i][1] - hand[j][1]) for i in hand for j in hand if i < j
        )
        assert closest > 1.0, "never below the safe distance"
    deadline = time.monotonic() + 5.0
    while not all(v.standing for v in field.vehicles):
        assert time.monotonic() < deadline, told()
        tick()
    settled = max(error for at_s, error in worst if at_s > SETTLE_S)
    last = max(error for at_s, error in worst if at_s > DRIVE_S - LAST_S)
    print(
        f"worst edge error: {worst[0][1]:.3f} m at first, {settled:.3f} m after {SETTLE_S:g} s, "
        f"{last:.3f} m over the last {LAST_S:g} s"
    )
    assert settled < 0.15
    assert last < 0.05
