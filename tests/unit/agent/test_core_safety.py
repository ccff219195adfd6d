"""What a robot never does: drive in a stop, without its operator, into others, obstacles or the fence."""

from __future__ import annotations

from itertools import pairwise

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import law
from handfast.agent.control.hand import Pose
from handfast.agent.control.peers.lateness import STOOD_KEPT_NS
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Beacon, Heartbeat, Stop, Wrench
from handfast.agent.supervision.state_machine import State
from handfast.plant.node import PlantNode
from tests.unit.agent.agent_bench import (
    ALIVE,
    HEARTBEAT,
    OTHER,
    OTHERS_BEACON,
    PERIOD,
    Bench,
    Out,
    brakes,
)
from tests.unit.agent.fleet_bench import STOP, FleetBench, three

# ---------------------------------------------------------------------- stop


@pytest.mark.parametrize("version", [0, 1, 7])
def test_from_the_tick_that_hears_a_stop_on_no_wrench_drives(version: int):
    bench = Bench()
    bench.drive()
    bench.pose = Pose(0.0, 0.0, 0.0, 0.5, 0.1)
    bench.stop(version)
    for out in bench.run(100):
        assert brakes(out)
        assert not out.hand.following
    assert bench.state is State.STOPPING
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    assert all(map(brakes, bench.run(100)))
    assert bench.state is State.STOPPED


@pytest.mark.parametrize("trouble", ["silence", "taken", "unhealthy", "plant gone", "left", "new mission"])
def test_a_stop_lasts_whatever_else_comes_and_goes(trouble: str):
    bench = Bench()
    bench.drive()
    bench.stop(1)
    bench.run(3)
    others = bench.other
    if trouble == "silence":
        bench.other = None
    elif trouble == "taken":
        bench.plant = {"obeying": False, "note": "mode MANUAL"}
    elif trouble == "unhealthy":
        bench.plant = {"healthy": False}
    elif trouble == "plant gone":
        bench.pose = None
    elif trouble == "left":
        bench.agent.present(ALIVE, False)
    else:
        bench.mission(9)
    outs = bench.run(60)
    bench.other, bench.plant, bench.pose = others, {}, Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    bench.agent.present(ALIVE, True)
    outs += bench.run(60)
    assert all(map(brakes, outs))
    assert bench.agent.condition == ("stopped", "stop")
    bench.resume(2)
    bench.run(3)
    assert bench.state is State.RUNNING


def test_status_and_beacon_tell_the_last_order_that_is_known():
    bench = Bench()
    bench.drive()
    bench.stop(4)
    outs = bench.run(12)
    assert bench.last is not None
    assert bench.last.order_version == 4
    assert bench.last.transition in ("stop", "at_rest")
    told = [out.beacon for out in outs if out.beacon is not None]
    assert (told[-1].stop_version, told[-1].resume_version) == (4, -1)
    assert told[-1].mission_version == 1


def wrenches(bench: FleetBench, robot: int, since_ns: int) -> list[Wrench]:
    found = [message for message in bench.wrenches(robot) if isinstance(message, Wrench)]
    return [wrench for wrench in found if wrench.time_ns >= since_ns]


@pytest.mark.parametrize("after_s", [0.06, 0.3, 5.0])
def test_a_robot_that_starts_again_in_a_stop_does_not_drive(after_s: float):
    """Its agent and its plant know nothing: who tells them of the mission tells them of the stop first."""
    bench = FleetBench(three())
    bench.drive()
    bench.say(STOP, Stop(1, bench.now, "here"))
    bench.run(after_s)
    bench.restart(3)
    bench.plants[3] = PlantNode(bench.fleet, 3, bench.bodies[3])
    since_ns = bench.now
    bench.run(3.0)
    assert bench.agents[3].condition == ("stopped", "stop: here")
    assert all(wrench.brake for wrench in wrenches(bench, 3, since_ns))


# ---------------------------------------------------------------------- dead-man's switch


def beat(bench: Bench) -> None:
    bench.give(HEARTBEAT, Heartbeat(bench.now, "Ada"))


def test_without_an_operator_no_drive_begins():
    bench = Bench("supervision.deadman_s=0.4")
    bench.tick()
    bench.mission()
    assert all(map(brakes, bench.run(20)))
    assert bench.state is State.HOLDING
    assert bench.agent.reason == "no operator's heartbeat"
    beat(bench)
    assert not brakes(bench.tick())


# ---------------------------------------------------------------------- others that share no edge

APART = "formation.edges=[]", "trajectory.kind=hold", "formation.offsets=[[0,0],[3,0]]"
THROUGH = "formation.edges=[]", "trajectory.kind=hold", "formation.offsets=[[2,0],[-2,0]]"


def near(gap: float, speed: float = 0.0, closing: float = 0.0, *overrides: str) -> Bench:
    """Robot 1's hand at (0.1, 0), the other's `gap` m further east; they share no edge. d_a is 0.5 m.

    Each makes for a place behind the other.
    """
    bench = Bench(*THROUGH, "avoidance.distance_m=0.5", *overrides)
    bench.pose, bench.other = Pose(0.0, 0.0, 0.0, speed, 0.0), (0.1 + gap, 0.0, speed - closing, 0.0)
    bench.drive()
    bench.run(5)
    return bench


@pytest.mark.parametrize("coupling", ["joint", "edge", "penalty"])
@pytest.mark.parametrize("gap", [0.21, 0.3, 0.4, 0.49])
@pytest.mark.parametrize("closing", [-2.0, -0.5, -0.1, 0.0, 0.1, 0.5])
def test_who_shares_no_edge_is_pushed_away_and_never_pulled(coupling: str, gap: float, closing: float):
    """The law alone, before the last filter: constraint forces are told to others."""
    out = near(gap, 0.0, closing, f"control.coupling={coupling}").tick()
    assert out.hand.constraint_x <= 0.0
    assert out.hand.constraint_y == pytest.approx(0.0)
    assert out.hand.degree == len(out.hand.multipliers)
    assert all(robot == 2 and multiplier >= 0.0 for robot, multiplier in out.hand.multipliers)
    if closing >= 0.0:
        assert out.hand.degree == 1
        assert out.hand.constraint_x < 0.0


def test_a_stranger_is_heard_by_its_beacons_until_it_is_close_and_then_closely():
    bench = Bench(*APART)
    bench.other = None
    bench.tick()
    assert OTHER in bench.agent.subscriptions  # near where it starts, until it is heard elsewhere

    def beacon(x: float) -> None:
        told = Beacon(2, 0, bench.now - PERIOD, True, x, *[0.0] * 4, 0, 0, -1, -1)
        bench.give(OTHERS_BEACON, told)

    for x, listens in ((9.0, False), (1.0, True), (9.0, False)):
        for _ in range(10):
            beacon(x)
            bench.tick()
        assert (OTHER in bench.agent.subscriptions) is listens, x


def test_uncertainty_about_a_silent_robot_stops_others_further_away():
    """It stood 0.52 m off when it was last heard, and may have come 0.3 m nearer since: nobody drives on."""
    bench = near(0.52)
    bench.other_follows = False
    assert acceleration(bench.run(2)[-1]) > 0.1
    bench.other = None
    out = bench.run(150)[-1]
    assert out.hand.degree == 0  # what is only supposed does not push
    assert acceleration(out) == pytest.approx(0.0, abs=1e-9)


def acceleration(out: Out) -> float:
    """Of the hand, eastwards, m/s^2."""
    assert out.hand is not None
    return out.hand.navigation_x + out.hand.constraint_x + out.hand.correction_x


def test_the_filter_brakes_who_runs_into_another_and_says_so():
    bench = near(0.35, 1.0, 0.9, "control.coupling=penalty", "control.kp=0.001", "control.kd=0.001")
    out = bench.tick()
    assert out.wrench.force < 0.0
    counters = bench.counters()
    assert counters["filtered.any"] > 0
    assert counters["filtered.robot 2"] > 0


def test_speed_is_kept_whatever_the_law_says():
    bench = Bench("control.max_speed_mps=0.5", "formation.offsets=[[0,0],[1,0]]", "trajectory.kind=hold")
    bench.pose = Pose(-50.0, 0.0, 0.0, 0.6, 0.0)
    assert bench.drive().wrench.force < 0.0
    assert bench.counters()["filtered.speed"] > 0


def test_actuators_are_not_asked_for_more_than_they_have():
    bench = Bench(
        "robot_defaults.max_force_n=2.0", "robot_defaults.max_torque_nm=0.01", "trajectory.kind=hold"
    )
    bench.pose = Pose(-5.0, 3.0, 0.3, 0.0, 0.0)
    for out in (bench.drive(), *bench.run(20)):
        assert abs(out.wrench.force) <= 2.0 + 1e-6
        assert abs(out.wrench.torque) <= 0.01 + 1e-8


# ---------------------------------------------------------------------- obstacles and the geofence


def alone(text: str, x: float = 0.0, speed: float = 0.0) -> Bench:
    """Robot 1 at x, on its way to (3, 0) along the x axis; its neighbour is beside its place."""
    made: Fleet = parse_fleet(
        f"""
        robot = [{{ id = 1, x_m = 0, y_m = 0 }}, {{ id = 2, x_m = 3, y_m = 3 }}]
        fleet = {{ name = "two", rate_hz = 50 }}
        formation = {{ edges = [], offsets = [[3, 0], [3, 3]], safe_distance_m = 0.2 }}
        {text}
        """,
        source="here",
    )
    bench = Bench(made=made)
    bench.other = (3.0, 3.0, 0.0, 0.0)
    bench.pose = Pose(x, 0.0, 0.0, speed, 0.0)
    bench.drive()
    return bench


SHED = 'obstacle = [{ name = "shed", centre_m = [1.5, 0.0], radius_m = 0.5 }]'
FENCE = "geofence = { points_m = [[-5, -5], [1, -5], [1, 5], [-5, 5]] }"


@pytest.mark.parametrize("text", [SHED, FENCE], ids=["shed", "fence"])
def test_an_obstacle_and_the_fence_push_and_never_pull(text: str):
    for x in (0.5, 0.65, 0.75, 0.85):
        bench = alone(text, x)
        out = bench.run(10)[-1]
        assert out.hand.constraint_x <= 0.0, x
        assert out.hand.constraint_y == pytest.approx(0.0, abs=1e-9)
        assert out.hand.multipliers == ()  # nobody shares them
    assert out.hand.degree == 1
    assert out.hand.constraint_x < 0.0


@pytest.mark.parametrize(("text", "cause"), [(SHED, "shed"), (FENCE, "geofence")])
def test_who_runs_into_an_obstacle_or_the_fence_is_braked(text: str, cause: str):
    bench = alone(text, 0.45, 1.5)
    assert bench.tick().wrench.force < 0.0
    assert bench.counters()[f"filtered.{cause}"] > 0


def test_near_the_fence_a_robot_says_so_and_outside_it_holds():
    bench = alone(FENCE, -1.0)
    assert bench.state is State.RUNNING
    bench.pose = Pose(0.6, 0.0, 0.0, 0.0, 0.0)
    assert not brakes(bench.tick())
    assert bench.agent.condition == ("degraded", "0.30 m from the geofence")
    bench.pose = Pose(1.1, 0.0, 0.0, 0.0, 0.0)
    assert brakes(bench.tick())
    assert bench.agent.condition == ("holding", "0.20 m outside the geofence")
    bench.pose = Pose(-1.0, 0.0, 0.0, 0.0, 0.0)
    bench.tick()
    assert bench.state is State.RUNNING


# ---------------------------------------------------------------------- silence and numbers


def test_beacons_come_a_few_times_a_second_in_every_state_and_robots_take_turns():
    bench = Bench()
    states = set()
    told = []
    for phase in ("drive", "stop"):
        bench.drive() if phase == "drive" else bench.stop(1)
        for _ in range(50):
            out = bench.tick()
            states.add(bench.state)
            told += [out.beacon] * (out.beacon is not None)
    assert {State.RUNNING, State.STOPPED} <= states
    steps = {b.time_ns - a.time_ns for a, b in pairwise(told)}
    assert steps == {NS_PER_S // 5}
    assert told[0].following
    assert not told[-1].following


@pytest.mark.parametrize("silent", [False, True])
def test_numbers_that_fail_are_a_fault_in_every_driving_state(silent: bool):
    bench = FleetBench(three())
    bench.drive()
    if silent:
        bench.cut = lambda key, node: key == "few/robot/3/hand" and node is bench.agents[1]
        bench.run(3.0)
        assert bench.state(1) is State.DEGRADED
    bench.agents[1]._controller._assembly._gains = law.Gains(float("nan"), 1.0, 1.0)
    bench.step()
    assert isinstance(wrench := bench.wrenches(1)[-1], Wrench)
    assert wrench.brake
    bench.run(1.0)
    assert bench.state(1) is State.FAULT
    assert bench.agents[1].reason.startswith("the law gave force")
    assert bench.state(2) is State.DEGRADED  # it does not follow any more


def test_a_robot_that_does_not_know_where_it_is_does_not_say_that_it_drives():
    bench = Bench()
    bench.drive()
    bench.plant = {"x": 1e15}
    out = bench.run(3)[-1]
    assert brakes(out)
    assert out.beacon is None
    assert bench.state is State.FAULT
    assert bench.agent.reason


@pytest.mark.parametrize(("late_ns", "kept"), [(99_000_000, False), (100_000_000, True)])
def test_who_stood_for_long_forgives_no_link_for_a_while(late_ns: int, kept: bool):
    bench = Bench()
    bench.drive()
    bench.now += 10 * PERIOD
    bench.agent.late(bench.now, late_ns)
    assert bench.agent._peers.stood_until_ns == (bench.now + STOOD_KEPT_NS if kept else 0)
