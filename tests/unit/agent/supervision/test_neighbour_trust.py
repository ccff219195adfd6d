"""A neighbour falls silent, dies, or does not follow: what the robot beside it does, and when."""

from __future__ import annotations

from itertools import pairwise
from math import hypot
from typing import NamedTuple

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.peers import TRUST_GAINED_S, TRUST_LOST_S
from handfast.agent.messages.types import HandState, Stop, Wrench
from handfast.agent.node import Node
from handfast.agent.supervision.neighbour_trust import SLOWEST
from handfast.agent.supervision.state_machine import DRIVING, State
from tests.hand_acceleration import hand_acceleration
from tests.unit.agent.fleet_bench import MISSION, PERIOD, FleetBench, three

HORIZON_S, SLOW_S = 2.0, 1.5  # control.prediction_horizon_s, and three quarters of it
PERIOD_S = PERIOD / NS_PER_S


class Row(NamedTuple):
    """Robot 1 after one step; `seconds` since the silence began, as robot 1 can see it."""

    seconds: float
    state: State
    reason: str
    trust: float
    slower: float
    brakes: bool
    acceleration: tuple[float, float]


def silence(bench: FleetBench, *robots: int) -> None:
    """Robot 1 hears nothing of them any more, nor they of it."""
    lost = {f"few/robot/{robot}/{what}" for robot in robots for what in ("hand", "beacon")}
    own = {"few/robot/1/hand", "few/robot/1/beacon"}
    agents = [bench.agents[robot] for robot in robots]
    bench.cut = lambda key, node: (node is bench.agents[1] and key in lost) or (node in agents and key in own)


def heal(bench: FleetBench) -> None:
    bench.cut = lambda _key, _node: False


def watch(bench: FleetBench, seconds: float) -> list[Row]:
    agent, body = bench.agents[1], bench.fleet.robot(1)
    rows = []
    begun = bench.now
    for _ in range(round(seconds / PERIOD_S)):
        bench.step()
        wrench = bench.wrenches(1)[-1]
        assert isinstance(wrench, Wrench)
        pose = bench.bodies[1].pose
        acceleration = hand_acceleration(
            wrench.force, wrench.torque, pose, body.mass_kg, body.inertia_kgm2, body.hand_offset_m
        )
        rows.append(
            Row(
                (bench.now - begun) / NS_PER_S,
                agent.state,
                agent.reason,
                agent._peers.get(3).trust,
                agent._trust.slower,
                wrench.brake,
                acceleration,
            )
        )
    return rows


def jumps(rows: list[Row]) -> float:
    """The largest change of the command from one tick to the next, m/s^2."""
    return max(
        hypot(b.acceleration[0] - a.acceleration[0], b.acceleration[1] - a.acceleration[1])
        for a, b in pairwise(rows)
    )


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> FleetBench:
    """Three that drive; `request.param`: another setting."""
    made = FleetBench(three(*getattr(request, "param", ())))
    made.drive()
    made.run(8.0)
    return made


# ---------------------------------------------------------------------- silence


@pytest.mark.slow
def test_a_silent_neighbour_is_predicted_then_driven_slower_for_then_given_up(bench: FleetBench):
    silence(bench, 3)
    rows = watch(bench, 4.0)
    at_once = [row for row in rows if row.seconds <= SLOW_S]
    assert {(row.state, row.trust, row.slower) for row in at_once} == {(State.RUNNING, 1.0, 1.0)}
    slow = [row for row in rows if SLOW_S + 2 * PERIOD_S < row.seconds <= HORIZON_S]
    assert {row.state for row in slow} == {State.DEGRADED}
    assert slow[0].reason.startswith("slower: robot 3 (1.")
    shares = [row.slower for row in slow]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.9
    assert SLOWEST <= shares[-1] < SLOWEST + 0.06
    assert {row.trust for row in slow} == {1.0}
    given_up = [row for row in rows if row.seconds > HORIZON_S + 2 * PERIOD_S]
    assert {row.state for row in given_up} == {State.DEGRADED}
    assert given_up[0].reason.startswith("without robot 3 (2.")
    fades = [row.trust for row in given_up if row.trust > 0.0]
    assert all(before - after == pytest.approx(PERIOD_S / TRUST_LOST_S) for before, after in pairwise(fades))
    assert given_up[-1].trust == 0.0
    assert given_up[-1].slower == 1.0
    assert not any(row.brakes for row in rows)


@pytest.mark.slow
def test_a_neighbour_that_comes_back_comes_back_without_a_bump(bench: FleetBench):
    silence(bench, 3)
    rows = watch(bench, 4.0)
    heal(bench)
    back = watch(bench, 3.0)
    assert {row.state for row in back[2:]} == {State.RUNNING}
    gains = [row.trust for row in back if 0.0 < row.trust < 1.0]
    assert all(
        after - before == pytest.approx(PERIOD_S / TRUST_GAINED_S) for before, after in pairwise(gains)
    )
    assert back[-1].trust == 1.0
    # The whole silence, from the last word to full trust: what changes in one tick is little.
    assert jumps(rows + back) < 0.05
    assert jumps(back) < 0.005
    faster = [b.slower - a.slower for a, b in pairwise(rows + back)]
    assert max(faster) <= PERIOD_S / TRUST_GAINED_S + 1e-9  # nor does its speed come back at once


@pytest.mark.slow
def test_whom_it_may_not_have_heard_for_it_stood_itself_it_does_not_blame(bench: FleetBench):
    silence(bench, 2, 3, 4)
    watch(bench, HORIZON_S - 0.1)
    bench.agents[1].late(bench.now, NS_PER_S)
    stood = watch(bench, 0.9)
    held = [row for row in stood if row.state is State.HOLDING]
    assert all(row.brakes for row in held)  # it cannot know
    assert {row.reason for row in held} == {"overloaded: this machine ran late by 1 s"}
    assert len(held) > 30
    assert not bench.agents[1]._peers.given_up(bench.now)
    row = watch(bench, 0.4)[-1]  # by now it would have heard them
    assert row.reason.startswith("hears none of its neighbours: robot 2 (3.")
    heal(bench)
    assert watch(bench, 0.1)[-1].state is State.RUNNING


@pytest.mark.slow
def test_who_hears_no_neighbour_holds_and_goes_on(bench: FleetBench):
    silence(bench, 2, 3, 4)
    rows = watch(bench, HORIZON_S + 0.2)
    assert rows[-1].state is State.HOLDING
    assert rows[-1].brakes
    assert rows[-1].reason.startswith("hears none of its neighbours: robot 2 (2.")
    held = [row.seconds for row in rows if row.brakes]
    assert held[0] == pytest.approx(HORIZON_S, abs=3 * PERIOD_S)
    heal(bench)
    back = watch(bench, 2.5)
    assert back[-1].state is State.RUNNING
    assert next(row.trust for row in back if not row.brakes) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("bench", [("avoidance.beacon_interval_max_s=1.0",)], indirect=True)
def test_of_many_who_holds_finds_out_who_is_near_before_it_goes_on(bench: FleetBench):
    controller = bench.agents[1]._controller
    silence(bench, 2, 3, 4)
    assert not controller.rests
    held = watch(bench, HORIZON_S + 2.0)
    assert held[-1].state is State.HOLDING
    assert controller.rests
    heal(bench)
    back = watch(bench, 4.0)
    reasons = [row.reason for row in back]
    assert "finds out who may be near" in reasons
    last = len(reasons) - 1 - reasons[::-1].index("finds out who may be near")
    assert all(row.brakes for row in back[: last + 1])
    assert back[-1].state is State.RUNNING
    assert not controller.rests


@pytest.mark.slow
def test_who_held_does_not_go_on_by_a_mission_that_those_it_hears_have_left(bench: FleetBench):
    """Before it drives it has what they go by, whatever that says of its own place."""
    silence(bench, 2, 3, 4)
    assert watch(bench, 5.0)[-1].state is State.HOLDING
    agent, cut = bench.agents[1], bench.cut
    mission = agent._situation.mission
    assert mission is not None

    def lacks(key: str, node: Node) -> bool:
        return node is agent and (key == MISSION or key.endswith("/told"))

    bench.cut = lambda key, node: cut(key, node) or lacks(key, node)
    later = mission._replace(version=mission.version + 1, time_ns=bench.now)
    bench.say(MISSION, later)
    watch(bench, 0.5)
    bench.cut = lacks
    rows = watch(bench, 3.0)
    assert {(row.state, row.reason) for row in rows[50:]} == {
        (State.HOLDING, f"waits for mission {later.version}, which robot 2 has")
    }
    heal(bench)
    assert watch(bench, 3.0)[-1].state in DRIVING


def test_where_silence_holds_one_silent_neighbour_is_enough():
    bench = FleetBench(three("supervision.silence=hold"))
    bench.drive()
    silence(bench, 3)
    rows = watch(bench, HORIZON_S + 0.2)
    assert rows[-1].state is State.HOLDING
    assert rows[-1].reason.startswith("hears not all of its neighbours: robot 3 (2.")
    heal(bench)
    assert watch(bench, 0.1)[-1].state is State.RUNNING


def test_silence_does_not_start_a_drive():
    """All neighbours are needed to begin; one that is there carries a robot that comes back into a drive."""
    bench = FleetBench(three())
    silence(bench, 3)
    bench.run(0.3)
    assert bench.agents[1].condition == ("waiting", "silent neighbours: robot 3")
    bench.say("few/mission", bench.mission())
    bench.run(0.3)
    assert bench.state(1) is State.DEGRADED


# -------------------------------------------------------------------- not connected, or not following


def tell(bench: FleetBench, robot: int, here: bool) -> None:
    for other, agent in bench.agents.items():
        if other != robot:
            agent.present(f"few/alive/robot/{robot}/agent", here)


@pytest.mark.slow
def test_a_neighbour_to_whose_agent_the_connection_is_lost_is_given_up_at_once(bench: FleetBench):
    """Long before its silence would say so."""
    silence(bench, 3)
    tell(bench, 3, False)
    rows = watch(bench, 1.0)
    assert rows[0].state is State.DEGRADED
    assert rows[0].reason == "without robot 3 (no connection to its agent)"
    assert rows[round(TRUST_LOST_S / PERIOD_S)].trust == 0.0
    heal(bench)
    tell(bench, 3, True)
    back = watch(bench, 2.0)
    assert back[-1].state is State.RUNNING
    assert back[-1].trust == 1.0


@pytest.mark.slow
def test_a_token_alone_brings_nobody_back(bench: FleetBench):
    silence(bench, 3)
    tell(bench, 3, False)
    watch(bench, 0.2)
    tell(bench, 3, True)
    assert watch(bench, 0.5)[-1].state is State.DEGRADED


@pytest.mark.slow
def test_when_all_connections_are_lost_the_robot_holds(bench: FleetBench):
    for robot in (2, 3, 4):
        tell(bench, robot, False)
    assert watch(bench, 0.04)[-1].state is State.HOLDING


@pytest.mark.slow
def test_a_neighbour_that_does_not_follow_loses_its_edge_but_not_its_room(bench: FleetBench):
    bench.say("few/stop", Stop(1, bench.now, ""), [bench.agents[3], bench.plants[3]])
    bench.cut = lambda key, _node: key == "few/robot/3/told"
    rows = watch(bench, 1.0)
    assert rows[-1].state is State.DEGRADED
    assert rows[-1].reason == "without robot 3 (does not follow)"
    assert rows[-1].trust == 0.0
    assert 3 in {peer.robot for _, peer in bench.agents[1]._controller.edges}


def test_who_stands_on_a_machine_that_runs_late_is_said_to(bench: FleetBench):
    """It may stand for that, and then it is no fault of its body's."""
    bench.say("few/stop", Stop(1, bench.now, ""), [bench.agents[3], bench.plants[3]])
    bench.cut = lambda key, _node: key in ("few/robot/3/told", "few/robot/3/beacon")
    bench.agents[1]._overload.heard(3, 1, bench.now, NS_PER_S)
    assert watch(bench, 1.0)[-1].reason.endswith("without robot 3 (does not follow, its machine runs late)")


def test_before_the_drive_a_neighbour_that_stands_ready_is_trusted_at_once():
    """At the epoch edges have their whole force: there is nothing to come back from."""
    bench = FleetBench(three())
    bench.run(0.5)
    bench.say("few/mission", bench.mission())
    rows = watch(bench, 0.3)
    assert next(row.trust for row in rows if row.state is State.RUNNING) == 1.0


def test_a_neighbour_with_a_wrong_clock_is_named():
    bench = FleetBench(three())
    bench.run(0.2)
    agent = bench.agents[1]
    for _ in range(120):
        bench.cut = lambda key, node: node is agent and key == "few/robot/3/hand"
        bench.step()
        stamp = bench.now + NS_PER_S
        state = HandState(3, 0, stamp, True, 0, *[0.0] * 11, (), ())
        bench.say("few/robot/3/hand", state, [])
        agent._peers.accept(state, bench.now)
    bench.step()
    assert agent.condition == ("waiting", "silent neighbours: robot 3 (its clock is 1.00 s ahead)")


# ---------------------------------------------------------------------- event-sent hand states

EVENT = ('control.send="event"',)


@pytest.mark.slow
@pytest.mark.parametrize("bench", [EVENT], indirect=True)
def test_silence_that_was_promised_is_none_and_a_dead_neighbour_is_given_up_as_soon(bench: FleetBench):
    before = len(bench.sayings("few/robot/3/hand"))
    rows = watch(bench, 10.0)
    assert {(row.state, row.trust, row.slower) for row in rows} == {(State.RUNNING, 1.0, 1.0)}
    assert len(bench.sayings("few/robot/3/hand")) - before <= 0.15 * len(rows)
    silence(bench, 3)
    rows = watch(bench, 4.0)
    slow = [row for row in rows if row.state is State.DEGRADED]
    beacon_s = bench.fleet.beacon_rounds * PERIOD_S
    assert SLOW_S - beacon_s <= slow[0].seconds <= SLOW_S + 2 * PERIOD_S
    given_up = next(row.seconds for row in rows if row.reason.startswith("without robot 3"))
    assert HORIZON_S - beacon_s <= given_up <= HORIZON_S + 3 * PERIOD_S
    heal(bench)
    assert {row.state for row in watch(bench, 3.0)[60:]} == {State.RUNNING}
