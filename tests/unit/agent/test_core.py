"""The agent, driven by hand: what one robot does with every message that it may get."""

from __future__ import annotations

from math import hypot

import msgpack
import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose, hand
from handfast.agent.control.own_hand import LAST_PLACE_NS
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import FleetError
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import VERSION
from handfast.agent.messages.types import (
    Ask,
    Beacon,
    Heartbeat,
    Mission,
    PlantState,
    Resume,
    Stop,
)
from handfast.agent.supervision.state_machine import State
from handfast.plant.backend import Command
from handfast.plant.unicycle import from_fleet
from tests.hand_acceleration import hand_acceleration
from tests.unit.agent.agent_bench import (
    ASK,
    BEACON,
    HAND,
    HEARTBEAT,
    LISTEN_TICKS,
    MISSION,
    OTHER,
    OTHERS_TOLD,
    PERIOD,
    PLANT,
    RESUME,
    START,
    STATUS,
    STOP,
    TOLD,
    WRENCH,
    Bench,
    brakes,
    fleet,
)
from tests.wire import sealed

# ---------------------------------------------------------------------- keys


def test_keys_are_those_of_its_neighbours_and_its_own_plant():
    agent = Bench().agent
    assert set(agent.subscriptions) == {
        PLANT, OTHER, MISSION, STOP, RESUME, HEARTBEAT, ASK, "two/faults", "two/robot/*/beacon",
        "two/robot/*/told",
    }  # fmt: skip
    # Who catches up must not drive first: before the own plant's state, without which nothing drives.
    assert agent.subscriptions[:4] == (STOP, RESUME, "two/robot/*/told", PLANT)
    assert set(agent.publications) == {
        HAND, WRENCH, STATUS, BEACON, TOLD, "two/robot/1/links", "two/robot/1/faults",
    }  # fmt: skip
    assert agent.watched == ("two/alive/robot/*/agent",)
    assert agent.alive_keys == (key_expressions.alive("two", 1, "agent"),)
    assert (agent.period_ns, agent.phase_ns) == (PERIOD, PERIOD // 2)


def test_unknown_robot():
    with pytest.raises(FleetError, match="no robot 3"):
        Agent(fleet(), 3)


# ---------------------------------------------------------------------- from waiting to stopped


def test_a_neighbour_of_another_version_is_named_as_such():
    bench = Bench()
    bench.other = None
    bench.agent.receive(bench.now, OTHER, sealed(msgpack.packb([VERSION + 1, 0, 2])))
    bench.tick()
    why = f"another handfast: version {VERSION + 1}, this program speaks {VERSION}"
    assert bench.agent.condition == ("waiting", f"silent neighbours: robot 2 ({why})")
    bench.other = (1.5, 0.2, 0.0, 0.0)  # it was upgraded
    bench.tick()
    assert bench.agent.condition[0] == "ready"


def test_the_life_of_a_robot():
    bench = Bench()
    bench.pose = bench.other = None
    out = bench.tick()
    assert bench.agent.condition == ("waiting", "for its plant")
    assert brakes(out)
    assert out.hand is None  # it does not know where it is
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    out = bench.tick()
    assert bench.agent.condition == ("waiting", "silent neighbours: robot 2")
    assert out.hand is not None
    assert not out.hand.following
    bench.other = (1.5, 0.2, 0.0, 0.0)
    bench.tick()
    assert bench.agent.condition == ("ready", "for a mission")
    bench.listen()
    epoch = bench.now + 3 * PERIOD + PERIOD // 2
    bench.mission(epoch_ns=epoch, duration_s=1.0)
    out = bench.tick()
    assert bench.agent.condition == ("ready", "for the epoch")
    assert brakes(out)
    assert out.hand.following  # it will stand until the epoch and follow from then on
    # The wrench of the last tick before the epoch is the one that acts at the epoch.
    while bench.now + PERIOD // 2 < epoch:
        assert brakes(bench.tick())
        assert bench.state is State.READY
    out = bench.tick()
    assert bench.agent.condition == ("running", "")
    assert not brakes(out)
    assert out.hand.following
    assert [robot for robot, _ in out.hand.multipliers] == [2]
    while bench.now < epoch + NS_PER_S:
        assert not brakes(bench.tick())
    bench.pose = Pose(0.0, 0.0, 0.0, 0.3, 0.0)
    out = bench.tick()
    assert bench.agent.condition == ("stopping", "the mission is over")
    assert brakes(out)
    assert not out.hand.following
    assert out.hand.multipliers == ()
    assert out.hand[9:13] == (0.0, 0.0, 0.0, 0.0)
    bench.run(20)
    assert bench.state is State.STOPPING  # it still moves
    bench.pose = Pose(0.0, 0.0, 0.0, 0.01, 0.0)
    bench.tick()
    assert bench.agent.condition == ("stopped", "the mission is over")
    assert all(brakes(out) for out in bench.run(20))


def test_sequence_numbers_count_every_message_of_a_kind():
    bench = Bench()
    bench.drive()
    outs = bench.run(40)
    for name in ("wrench", "hand", "status"):
        numbers = [message.sequence for out in outs if (message := getattr(out, name)) is not None]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert [out.wrench.time_ns for out in outs] == [out.hand.time_ns for out in outs]


def test_there_is_a_wrench_in_every_tick_of_every_state():
    """The plant's watchdog lives on them."""
    bench = Bench()
    seen = set()
    bench.pose = None
    bench.tick()
    seen.add(bench.state)
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    bench.drive()
    for change in ("run", "silence", "stop", "fault"):
        if change == "silence":
            bench.other = None
        elif change == "stop":
            bench.other = (1.5, 0.2, 0.0, 0.0)
            bench.give(STOP, Stop(1, bench.now, "now"))
        elif change == "fault":
            bench.pose = None
        for _ in range(40):
            now = bench.now
            out = bench.tick()
            seen.add(bench.state)
            assert out.wrench.time_ns == now
            assert out.wrench.robot == 1
        if change == "run":
            assert bench.state is State.RUNNING
    assert seen >= {State.WAITING, State.RUNNING, State.HOLDING, State.STOPPED}


# ---------------------------------------------------------------------- plant and neighbours fail


def test_stale_plant_is_a_fault_within_its_timeout_and_back():
    bench = Bench()
    bench.drive()
    bench.run(5)
    bench.pose, silent_since = None, bench.now - PERIOD - PERIOD // 2
    outs = []
    while bench.state is State.RUNNING:
        outs.append(bench.tick())
    assert bench.agent.condition == ("fault", "plant silent for 0.11 s")
    assert (bench.now - PERIOD) - silent_since <= 100_000_000 + PERIOD
    assert brakes(outs[-1])
    assert not outs[-1].hand.following  # others learn at once that it brakes
    assert not any(map(brakes, outs[:-1]))
    outs = bench.run(10)
    assert bench.state is State.FAULT
    assert all(out.hand is not None and not out.hand.following for out in outs)
    bench.run(LAST_PLACE_NS // PERIOD)
    out = bench.tick()
    assert (out.hand, out.beacon) == (None, None)  # it no longer knows where it is
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    bench.tick()
    assert bench.state is State.WAITING
    assert not brakes(bench.tick())
    assert bench.agent.condition == ("running", "")


def test_one_that_lost_its_plant_tells_how_far_it_may_be_from_where_it_says():
    """It may have stopped when its plant was heard last, or have driven on until it was missed."""
    bench = Bench()
    bench.drive()
    speed = 1.0
    bench.pose = Pose(0.0, 0.0, 0.0, speed, 0.0)
    assert bench.tick().hand.doubt == 0.0
    bench.pose = None
    while bench.state is not State.FAULT:
        out = bench.tick()
    outs = [out, *bench.run(30)]
    nearest = bench.fleet.robot(1).hand_offset_m
    for out in outs:
        assert out.hand.x - out.hand.doubt == pytest.approx(nearest, abs=1e-6)
    farthest = outs[-1].hand.x + outs[-1].hand.doubt
    drove_on = speed * 0.1  # control.plant_timeout_s, here
    assert nearest + drove_on < farthest < nearest + drove_on + speed * (0.2 + PERIOD / NS_PER_S) + 0.05
    bench.pose = Pose(0.1, 0.0, 0.0, 0.0, 0.0)
    assert bench.tick().hand.doubt == 0.0


@pytest.mark.parametrize("horizon", ["0", "0.001", "0.02", "0.039"])
def test_horizon_of_less_than_two_periods_drives_or_is_refused(horizon: str):
    """A neighbour's state is a period old when it is used: no horizon may be a robot that never starts."""
    try:
        bench = Bench(f"control.prediction_horizon_s={horizon}")
    except FleetError as error:
        refusal = str(error)
    else:
        bench.drive()
        assert not any(map(brakes, bench.run(20)))
        return
    assert "prediction_horizon_s" in refusal


# ---------------------------------------------------------------------- missions and stops


def test_mission_for_another_fleet_file_is_refused_and_says_so():
    bench = Bench()
    bench.tick()
    bench.give(MISSION, Mission(1, bench.now, bench.now, NS_PER_S, "0123456789abcdef0123"))
    bench.run(5)
    assert bench.state is State.READY
    mine = digest(bench.fleet)
    assert bench.agent.reason == (
        f"the mission is for another fleet file: its digest is 0123456789abcdef, this agent's is {mine}"
    )
    counters = bench.counters()
    assert counters["rejected.digest"] == counters["rejected"] == 1
    assert bench.last.mission_version == 0
    assert bench.last.digest == (mine,)
    bench.mission()
    bench.run(5)
    assert bench.state is State.RUNNING
    assert bench.agent.reason == ""
    bench.give(MISSION, Mission(9, bench.now, bench.now, NS_PER_S, "another"))
    bench.run(5)
    assert bench.agent.condition == ("running", "")


def test_older_and_repeated_missions_are_ignored():
    bench = Bench()
    bench.listen()
    epoch_ns = bench.now + 2 * PERIOD
    bench.mission(5, epoch_ns)
    bench.run(4)
    assert bench.state is State.RUNNING
    bench.mission(5, epoch_ns)
    bench.run(2)
    assert bench.state is State.RUNNING
    for version in (4, 0):
        bench.mission(version, epoch_ns=START - NS_PER_S, duration_s=0.001)  # long over
        bench.tick()
        assert bench.state is State.RUNNING
    assert bench.counters()["rejected"] == 0
    assert bench.last.mission_version == 5


def test_a_later_mission_that_has_not_begun_is_waited_for():
    """Neighbours take a robot to stand until the epoch of its mission."""
    bench = Bench()
    bench.drive()
    bench.mission(2, epoch_ns=bench.now + NS_PER_S)
    for out in bench.run(40):
        assert brakes(out)
    bench.run(15)
    assert bench.state is State.RUNNING


def test_stop_stops_and_only_a_later_leave_starts_again():
    bench = Bench()
    bench.drive()
    bench.pose = Pose(0.0, 0.0, 0.0, 0.3, 0.0)
    bench.stop(1, "somebody in the way")
    assert brakes(bench.tick())
    assert bench.agent.condition == ("stopping", "stop: somebody in the way")
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    bench.tick()
    assert bench.agent.condition == ("stopped", "stop: somebody in the way")
    bench.mission(9)
    bench.resume(1)
    bench.resume(2, 2)  # for the other robot
    assert all(map(brakes, bench.run(10)))
    assert bench.agent.condition == ("stopped", "stop: somebody in the way")
    bench.resume(3)
    assert brakes(bench.tick())
    assert not brakes(bench.tick())
    assert bench.agent.condition == ("running", "")


def test_a_robot_that_starts_in_the_middle_of_a_mission_joins_it():
    bench = Bench()
    bench.mission(epoch_ns=START - 10 * NS_PER_S)
    for out in bench.run(LISTEN_TICKS - 1):
        assert brakes(out)
        assert bench.agent.condition == ("waiting", "hears who is near")  # there may be somebody in its way
    assert not brakes(bench.tick())
    assert bench.state is State.RUNNING


# ---------------------------------------------------------------------- ending


def test_ending_brakes_and_is_done_at_rest():
    bench = Bench()
    bench.drive()
    assert not bench.agent.done
    bench.pose = Pose(0.0, 0.0, 0.0, 0.5, 0.0)
    bench.agent.end()
    assert brakes(bench.tick())
    assert bench.agent.condition == ("stopping", "the agent was told to end")
    assert not bench.agent.done
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.5)
    bench.run(3)
    assert not bench.agent.done
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    bench.tick()
    assert bench.agent.done
    bench.mission(9)
    assert all(map(brakes, bench.run(5)))


# ---------------------------------------------------------------------- the law as the agent applies it


@pytest.mark.parametrize(("heading", "avoidance"), [(-0.6435, True), (0.3, False)])
def test_acceleration_is_clipped_in_its_direction(heading: float, avoidance: bool):
    """With the safety filter a body that is not on its course turns as slowly as it may accelerate, (F9)."""
    pose = Pose(-40.0, 30.0, heading, 0.0, 0.0)

    def asked(limit: float) -> tuple[float, float]:
        gains = "control.c1=0.1", "control.c2=1.2"  # the speed limit does not follow the acceleration's
        enabled = f"avoidance.enabled={str(avoidance).lower()}"
        bench = Bench(f"control.max_acceleration={limit}", enabled, *gains)
        bench.pose = pose
        wrench = bench.drive().wrench
        return hand_acceleration(wrench.force, wrench.torque, pose, 10.0, 0.13, 0.1)

    wanted = asked(1000.0)
    size = hypot(*wanted)
    assert 0.5 < size < 100.0
    for share in (0.1, 0.9):
        assert asked(share * size) == pytest.approx(np.multiply(wanted, share))
    assert asked(1.001 * size) == pytest.approx(wanted)


def test_hand_state_is_where_the_hand_is_now():
    bench = Bench()
    bench.pose = Pose(0.2, -0.1, 0.7, 0.5, 0.4)
    out = bench.drive()
    after = Pose(0.2 + 0.005 * np.cos(0.702), -0.1 + 0.005 * np.sin(0.702), 0.704, 0.5, 0.4)
    assert out.hand[5:9] == pytest.approx(tuple(hand(after, 0.1)), abs=1e-8)


@pytest.mark.parametrize("coupling", ["joint", "edge", "penalty"])
@pytest.mark.parametrize("gap", [0.25, 0.2001, 0.2, 0.15, 0.05])
def test_a_pair_about_the_safe_distance_is_driven_apart_and_is_no_fault(coupling: str, gap: float):
    """Noise or a push may put it there: however large the force, what is asked of the plant is clipped."""
    bench = Bench(f"control.coupling={coupling}")
    bench.pose, bench.other = Pose(0.3, 0.0, 0.0, 0.0, 0.0), (0.4 + gap, 0.0, -0.5, 0.0)
    bench.drive()
    outs = bench.run(5)
    assert bench.agent.condition == ("running", "")
    assert all(out.wrench.force < 0.0 for out in outs)
    assert not any(map(brakes, outs))


@pytest.mark.parametrize("late", [1, 2, 3])
def test_a_late_plant_state_is_carried_on_with_the_wrenches_that_were_sent(late: int):
    """The agent knows what acts on its body, also when the plant's word is some ticks old."""
    bench = Bench("control.k2=5")
    bench.pose = None
    body = from_fleet(bench.fleet, 1)
    command: Command | None = None
    forces = []
    bench.mission(epoch_ns=bench.now - PERIOD // 2)
    for tick in range(120):
        stamp = bench.now - PERIOD // 2
        reading = body.step(stamp, command)
        if tick < 120 - late:
            state = (*reading.pose, reading.force, reading.torque)
            bench.give(PLANT, PlantState(1, tick, stamp, *state, command is not None, True, True, ""))
        # The neighbour jumps to and fro, so that no wrench is like the one before it.
        bench.other = (1.5, 0.5, 0.0, 0.0) if tick % 2 else (0.6, -0.1, 0.0, 0.0)
        out = bench.tick()
        command = None if out.wrench.brake else Command(out.wrench.force, out.wrench.torque)
        forces.append(out.wrench.force)
    assert bench.state is State.RUNNING
    assert np.abs(np.diff(forces[-5:])).min() > 0.4
    # Half a period after its last step, with what it was given there.
    truth = body.step(stamp + PERIOD // 2, None).pose
    assert out.hand.time_ns == stamp + PERIOD // 2
    assert out.hand[5:9] == pytest.approx(tuple(hand(truth, 0.1)), abs=1e-6)


# ---------------------------------------------------------------------- orders of others


def test_orders_are_taken_from_every_robot_of_the_fleet_on_its_own_key_and_from_no_other():
    bench = Bench()
    bench.drive()
    now = bench.now
    for key in ("two/robot/9/told", "two/robot/2/hand", "two/robot/2/told/more", "three/robot/2/told"):
        for message in (Stop(5, now, ""), Resume(5, now, ()), Mission(9, now, now, 1, digest(bench.fleet))):
            bench.give(key, message)
    for message in (Heartbeat(now, "x"), Ask(now, "x"), Beacon(2, 0, now, True, *[0.0] * 5, 9, 0, 9, -1)):
        bench.give(OTHERS_TOLD, message)
    assert bench.tick().told == []
    assert bench.state is State.RUNNING
    assert dict(bench.agent.rejected) == {"wrong_key": 15}
    bench.give(OTHERS_TOLD, Stop(5, now, "told"))
    bench.tick()
    assert bench.agent.condition == ("stopping", "stop: told")
    bench.give(TOLD, Stop(6, now, "its own, come back"))
    assert bench.tick().told == []
    assert bench.counters()["rejected"] == 15
