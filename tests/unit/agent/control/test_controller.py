"""The law in time: what a controller is given by the fleet file."""

from __future__ import annotations

from math import cos, hypot, sin, tau

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.controller import LOOK_PERIOD_NS, REST_PERIOD_NS, Controller
from handfast.agent.control.hand import Pose, advance, hand, wrench
from handfast.agent.control.limits import barrier_rate
from handfast.agent.control.peers.prediction import BRAKING_TIME_S
from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import ACTS_PERIODS, NEIGHBOURS_MAX, HandState, PlantState, Wrench
from handfast.deploy.console.arguments import fleet_path
from handfast.plant.backend import Command
from handfast.plant.node import PlantNode
from handfast.plant.unicycle import from_fleet

S = 1_000_000_000
T0 = 1000 * S


@pytest.mark.parametrize("prediction", [True, False])
def test_prediction_is_as_the_fleet_file_has_it(prediction: bool):
    fleet = load_fleet(fleet_path("delta"), [f"control.prediction={str(prediction).lower()}"])
    controller = Controller(fleet, resolve(fleet), 1)
    controller.look(T0)
    assert controller.edges
    for _, peer in controller.edges:
        state = HandState(peer.robot, 0, T0, True, 2, 1.0, 2.0, 0.5, *[0.0] * 8, (), ())
        assert controller.peers.accept(state, T0 + fleet.period_ns) is None
        shown = controller.peers.predict(peer, T0 + S)
        assert (shown.position == (1.0, 2.0)) is not prediction


@pytest.mark.parametrize(("rate_hz", "timeout_s"), [(50, 0.2), (50, 1.0), (1000, 0.2)])
def test_as_many_wrenches_are_remembered_as_the_oldest_plant_state_needs(rate_hz: int, timeout_s: float):
    """A sensor's link may be as late as `plant_timeout_s`: all that was sent since has acted on the body."""
    fleet = load_fleet(
        fleet_path("delta"), [f"fleet.rate_hz={rate_hz}", f"control.plant_timeout_s={timeout_s}"]
    )
    controller, body = Controller(fleet, resolve(fleet), 1), fleet.robot(1)
    period_ns = fleet.period_ns
    age_ns = round(timeout_s * S)
    now_ns = T0 + period_ns // 2 + age_ns // period_ns * period_ns - period_ns
    for tick_ns in range(T0 - 10 * period_ns + period_ns // 2, now_ns, period_ns):
        controller.sent(tick_ns, (2.0 if tick_ns > T0 else 0.0, 0.0))
    state = PlantState(1, 0, T0, 0.0, 0.0, 0.3, 0.1, 0.0, 0.0, 0.0, True, True, True, "")
    pushed_s = (now_ns - T0 - period_ns) / S  # the wrench of T0's round acts from the next on
    pose = Pose(
        *advance(Pose(0.0, 0.0, 0.3, 0.1, 0.0), 0.0, 0.0, body.mass_kg, body.inertia_kgm2, period_ns / S)
    )
    pose = Pose(*advance(pose, 2.0, 0.0, body.mass_kg, body.inertia_kgm2, pushed_s))
    assert tuple(controller.hand_at(state, now_ns)) == pytest.approx(
        tuple(hand(pose, body.hand_offset_m)), abs=1e-9
    )


@given(
    st.floats(-1.5, 1.5),
    st.floats(-4.0, 4.0),
    st.integers(0, 9),
    st.sampled_from((10, 20, 50)),
    st.booleans(),
)
def test_a_body_that_brakes_is_carried_on_until_it_stands(
    speed: float, yaw_rate: float, rounds: int, rate_hz: int, asked: bool
) -> None:
    """By itself, or as its agent asked: what it states of its brake's force is of one moment. Held on, it
    would drive a body backwards that stands, and who believes that would push it forwards."""
    fleet = load_fleet(fleet_path("delta"), [f"fleet.rate_hz={rate_hz}"])
    controller, body, period_ns = Controller(fleet, resolve(fleet), 1), from_fleet(fleet, 1), fleet.period_ns
    body._pose = Pose(0.0, 0.0, 0.4, speed, yaw_rate)
    pose, force, torque, *_ = body.step(T0, Command(0.0, 0.0) if asked else None)[1:]
    state = PlantState(1, 0, T0, *pose, force, torque, asked, True, True, "")
    if asked:
        controller.sent(T0, None)  # it acts a period later, until when it rolls on
    before = speed, yaw_rate
    for k in range(1, rounds + 1):
        body.step(T0 + k * period_ns, None)
        shown = Pose(*controller._pose_at(state, T0 + k * period_ns))
        for was, now in zip(before, shown[3:], strict=True):
            assert abs(now) <= abs(was) + 1e-12, "it slows down"
            assert abs(now) < 1e-12 or now * was > 0.0, "and does not turn round"
        before = shown.speed, shown.yaw_rate
    stands = Pose(*controller._pose_at(state, T0 + 5 * S))
    assert max(map(abs, stands[3:])) < 1e-9
    assert hypot(stands.x, stands.y) <= abs(speed) * (BRAKING_TIME_S + period_ns / S) + 1e-9


@pytest.mark.parametrize("step", [0, 1])
def test_a_wrench_that_is_not_followed_by_another_acts_on_the_own_body_as_on_its_plants(step: int) -> None:
    fleet = load_fleet(fleet_path("delta"), ["control.wrench_timeout_s=1"])
    controller, plant = Controller(fleet, resolve(fleet), 1), PlantNode(fleet, 1, from_fleet(fleet, 1))
    period_ns = fleet.period_ns
    controller.keep_pace(period_ns << step, 1.0)
    controller.sent(T0 - 1, (3.0, 0.1))
    wrench = encode(Wrench(1, 0, T0 - 1, 3.0, 0.1, False, (), step))
    plant.receive(T0 - 1, key_expressions.wrench(fleet.fleet.name, 1), wrench)
    told = []
    for k in range((ACTS_PERIODS << step) + 6):
        told.append(decode(plant.tick(T0 + k * period_ns)[0][1]))
    for before in told:
        assert isinstance(before, PlantState)
        for after in told[told.index(before) + 1 :]:
            assert isinstance(after, PlantState)
            assert tuple(controller._pose_at(before, after.time_ns)) == pytest.approx(after[3:8], abs=1e-9)


def test_no_more_multipliers_are_told_than_a_message_holds():
    """All at once: as many edges as there may be, none fully trusted, and all too near."""
    others = range(2, NEIGHBOURS_MAX + 2)
    rows = ", ".join(f"{{ id = {k}, x_m = {k}, y_m = 0 }}" for k in (1, *others))
    places = [[round(3 * cos(tau * k / 64), 3), round(3 * sin(tau * k / 64), 3)] for k in others]
    text = f"""
    robot = [{rows}]
    fleet = {{ name = "star" }}
    avoidance = {{ distance_m = 1.0 }}
    formation = {{ edges = {[[1, k] for k in others]}, offsets = {[[0, 0], *places]}, safe_distance_m = 0.2 }}
    """
    fleet = parse_fleet(text, source="here")
    controller = Controller(fleet, resolve(fleet), 1)
    controller.look(T0)
    for edge, peer in controller.edges:
        x, y = 0.5 * cos(edge.other), 0.5 * sin(edge.other)
        state = HandState(peer.robot, 0, T0, True, 2, x, y, *[0.0] * 9, (), ())
        assert controller.peers.accept(state, T0 + fleet.period_ns) is None
        peer.trust = 0.5
    plant = PlantState(1, 0, T0, *[0.0] * 7, True, True, True, "")
    controller.drive(plant, T0 + fleet.period_ns)
    assert len(controller.coupling.shared()) <= NEIGHBOURS_MAX


PAIR = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 5, y_m = 5 }, { id = 3, x_m = 0, y_m = 5 }]
fleet = { name = "pair" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0], [0, 3]], safe_distance_m = 0.2 }
"""


def given(controller: Controller, robot: int, x: float, *, follows: bool, speed: float = 0.0) -> None:
    """A robot on the x axis is heard at `T0`."""
    state = HandState(robot, 0, T0, follows, 2, x, 0.0, speed, *[0.0] * 8, (), ())
    assert controller.peers.accept(state, T0 + S) is None


def test_navigation_constraint_and_correction_are_what_the_wrench_does():
    """Others predict the robot by their sum: here the safety filter has something to correct."""
    fleet = parse_fleet(PAIR, source="here")
    controller, body = Controller(fleet, resolve(fleet), 1), fleet.robot(1)
    now_ns = T0 + fleet.period_ns
    controller.look(now_ns)
    given(controller, 2, 0.45, follows=True, speed=-0.8)
    plant = PlantState(1, 0, now_ns, *[0.0] * 3, 0.7, 0.3, 0.0, 0.0, True, True, True, "")
    drive = controller.drive(plant, now_ns)
    assert drive.causes
    nx, ny, cx, cy, gx, gy = drive.forces
    assert (gx * gx + gy * gy) ** 0.5 > 0.1
    pose = Pose(*[0.0] * 3, 0.7, 0.3)
    later = advance(
        pose, 0.0, 0.0, body.mass_kg, body.inertia_kgm2, (controller.acting_ns(now_ns) - now_ns) / S
    )
    asked = wrench(nx + cx + gx, ny + cy + gy, later, body.mass_kg, body.inertia_kgm2, body.hand_offset_m)
    assert (drive.force, drive.torque) == pytest.approx(asked)


def test_a_body_on_the_own_way_is_not_driven_through_though_it_was_on_the_same_way():
    """Its way and the own one are one line, and this robot stands on it: the body is further on."""
    fleet = parse_fleet(PAIR, source="here")
    controller = Controller(fleet, resolve(fleet), 1)
    controller.look(T0)
    hand_x = fleet.robot(1).hand_offset_m
    given(controller, 2, hand_x - 0.5, follows=True, speed=0.2)  # on its way to x = 1 it passes this robot
    now_ns = T0 + 10 * S
    controller.look(now_ns)
    plant = PlantState(1, 0, now_ns, *[0.0] * 3, 0.3, 0.0, 0.0, 0.0, True, True, True, "")
    drive = controller.drive(plant, now_ns)
    assert "robot 2" in drive.causes
    assert sum(drive.forces[::2]) < -0.5


@pytest.mark.parametrize("held", [False, True])
def test_in_a_large_fleet_they_are_looked_for_seldom_while_it_need_not_know(held: bool):
    """Before a mission is near, and while it stands for other reasons."""
    looks = []
    for overrides in ((), ("avoidance.beacon_interval_max_s=1.0",)):
        fleet = parse_fleet(PAIR, source="here", overrides=overrides)
        controller = Controller(fleet, resolve(fleet), 1)
        here = hand(Pose(*[0.0] * 5), 0.1)
        controller.look(T0)
        controller.look_round(T0, here, (2,))
        given(controller, 3, 0.5, follows=True)
        now_ns = T0
        while not controller.look_round(now_ns, here, (2,), held=held):
            now_ns += LOOK_PERIOD_NS // 10
        looks.append(now_ns - T0)
    assert looks == [LOOK_PERIOD_NS, REST_PERIOD_NS]


def test_in_a_large_fleet_who_may_go_on_looks_at_once():
    fleet = parse_fleet(PAIR, source="here", overrides=("avoidance.beacon_interval_max_s=1.0",))
    controller = Controller(fleet, resolve(fleet), 1)
    here = hand(Pose(*[0.0] * 5), 0.1)
    controller.look(T0)
    controller.peers.forecast.epoch_ns = T0 - S
    controller.look_round(T0, here, (2,), held=True)
    given(controller, 3, 0.5, follows=True)
    assert not controller.look_round(T0 + LOOK_PERIOD_NS, here, (2,), held=True)
    assert controller.look_round(T0 + LOOK_PERIOD_NS + 1, here, (2,))


def test_those_near_are_looked_for_a_few_times_a_second():
    fleet = parse_fleet(PAIR, source="here")
    controller = Controller(fleet, resolve(fleet), 1)
    here = hand(Pose(*[0.0] * 5), 0.1)
    controller.look(T0)
    assert not controller.look_round(T0, here, (2,))
    given(controller, 3, 0.5, follows=True)
    assert not controller.look_round(T0 + LOOK_PERIOD_NS - 1, here, (2,))
    assert controller.look_round(T0 + LOOK_PERIOD_NS, here, (2,))
    alone = Controller(
        parse_fleet(PAIR, source="here", overrides=["avoidance.enabled=false"]), resolve(fleet), 1
    )
    alone.look(T0)
    given(alone, 3, 0.5, follows=True)
    assert not alone.look_round(T0, here, (2,))


FAR = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 0, y_m = 9 }]
fleet = { name = "far", rate_hz = 20 }
formation = { edges = [[1, 2]], offsets = [[8, 0], [8, 9]], safe_distance_m = 0.3, assign = false }
control = { max_acceleration = 0.8, max_speed_mps = 0.9, c1 = 0.4, c2 = 0.6, wrench_timeout_s = 0.25 }
"""


@pytest.mark.parametrize(("share", "still"), [(1.0, True), (1.0, False), (0.5, False)])
def test_far_from_its_place_a_robot_uses_what_acceleration_it_has(share: float, still: bool):
    """It brakes at 0.9 1/s (F4), and need not come to its speed that slowly, nor be pulled as softly."""
    fleet = parse_fleet(FAR, source="here")
    controller = Controller(fleet, resolve(fleet), 1)
    controller.keep_pace(fleet.period_ns, share)
    assert controller.peers.forecast.speeding == 3.0
    controller.look(T0)
    speed = 0.0 if still else 0.6 * share
    plant = PlantState(1, 0, T0, *[0.0] * 3, speed, 0.0, 0.0, 0.0, True, True, True, "")
    drive = controller.drive(plant, T0)
    asked = sum(drive.forces[::2])
    aimed = 0.9 * share  # m/s
    carried = hand(Pose(0.0, 0.0, 0.0, speed, 0.0), fleet.robot(1).hand_offset_m).vx
    assert drive.forces[0] == pytest.approx(2.0 * 0.6 * (aimed - carried), rel=0.05)
    assert asked == pytest.approx(min(0.8, drive.forces[0]), rel=0.05)
    controller.keep_pace(4 * fleet.period_ns, share)
    assert controller.peers.forecast.speeding == pytest.approx(1.25)  # what 5 Hz carry


@pytest.mark.parametrize("speed", [0.3, 0.0, -0.3])
def test_for_silent_robots_it_brakes_and_is_not_driven_away(speed: float):
    """One that may come nearer expects it on its way: off that way nobody knows of it."""
    fleet = parse_fleet(PAIR.replace("[0, 3]]", "[5, 0]]"), source="here")  # robot 3 drives off, if it does
    controller = Controller(fleet, resolve(fleet), 1)
    controller.look(T0)
    hand_x = fleet.robot(1).hand_offset_m
    given(controller, 3, hand_x + 0.22, follows=False)
    now_ns = T0 + 10 * S
    controller.look(now_ns)
    controller.proximity.look(now_ns, hand(Pose(*[0.0] * 5), hand_x), (2,))
    plant = PlantState(1, 0, now_ns, *[0.0] * 3, speed, 0.0, 0.0, 0.0, True, True, True, "")
    drive = controller.drive(plant, now_ns)
    assert ("robot 3" in drive.causes) is (speed > 0.0)
    if speed > 0.0:
        rate = barrier_rate(fleet)
        assert sum(drive.forces[::2]) <= -0.9 * rate * speed
