"""What rules do to clocks, ticks, sensors and processes of whole fleets in virtual time."""

from __future__ import annotations

import re

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S, LocalTime
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Event, PlantState, Status
from handfast.agent.node import INBOX_SIZE
from handfast.agent.supervision.state_machine import DRIVING, State
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Simulation
from handfast.plant.node import PlantNode
from tests.hand_trace import Floats, HandTrace

DELTA = (FLEETS / "delta.toml").read_text(encoding="utf-8")
PERIOD_NS = NS_PER_S // 50
STEP_S = 0.02


class Run:
    """One mission of the delta with rules, and everything that was said in it."""

    def __init__(self, *rules: str, duration_s: float = 20.0, overrides: tuple[str, ...] = ()) -> None:
        text = DELTA + "".join(f"\n[[faults.rule]]\n{rule}\n" for rule in rules)
        settings = [f"fleet.duration_s={duration_s}", *overrides]
        self.fleet: Fleet = resolved(parse_fleet(text, source="here", overrides=settings))
        self.log: list[tuple[int, str, bytes]] = []
        self._kept = HandTrace(self.fleet)
        self._started = False
        self.simulation = Simulation(self.fleet, self._sink)

    def _sink(self, time_ns: int, key: str, payload: bytes) -> None:
        self.log.append((time_ns, key, payload))
        self._kept(time_ns, key, payload)

    def drive(self) -> Run:
        self.simulation.run()
        return self

    def until(self, time_s: float) -> Run:
        """Drives up to this fleet time."""
        if not self._started:
            self._started = self.simulation.start(round(self.fleet.fleet.duration_s * NS_PER_S))
            assert self._started
        self.simulation.run_until(self.simulation.epoch_ns + round(time_s * NS_PER_S))
        return self

    def agent(self, robot: int) -> Agent:
        return self.simulation.agents[robot - 1]

    def plant(self, robot: int) -> PlantNode:
        return self.simulation.plants[robot - 1]

    def states(self, robot: int, *, truth: bool = False) -> list[PlantState]:
        wanted = (key_expressions.plant_truth if truth else key_expressions.plant_state)("delta", robot)
        messages = [decode(payload) for _, key, payload in self.log if key == wanted]
        return [message for message in messages if isinstance(message, PlantState)]

    def events(self) -> list[tuple[float, int, str, str, str]]:
        """(fleet time, robot, role, what, rule)"""
        found = []
        for time_ns, key, payload in self.log:
            if key == key_expressions.events("delta"):
                event = decode(payload)
                assert isinstance(event, Event)
                assert event.time_ns == time_ns
                assert event.sequence == len(found)
                at_s = (time_ns - self.simulation.epoch_ns) / NS_PER_S
                found.append((at_s, event.robot, event.role, event.what, event.rule))
        return found

    def distances(self) -> Floats:
        """Length of every edge over true time, every `STEP_S` from the epoch on, (k, m), m."""
        i, j = resolve(self.fleet).edges.T
        between = self.hands()[i] - self.hands()[j]
        return np.hypot(between[:, 0], between[:, 1]).T

    def apart(self) -> float:
        """The closest that any two hands came, m."""
        hands = self.hands()
        i, j = np.triu_indices(len(hands), 1)
        return float(np.hypot(*np.moveaxis(hands[i] - hands[j], 1, 0)).min())

    def hands(self) -> Floats:
        """Hand points of all robots at the same times, (n, 2, k), m; a body whose plant is gone stands."""
        epoch_ns, plan = self.simulation.epoch_ns, FaultPlan(self.fleet)
        times = np.arange(0.0, self.fleet.fleet.duration_s, STEP_S)
        hands = []
        for robot in self.fleet.ids:
            clock = LocalTime(*plan.clock(robot), epoch_ns)
            rows = self._kept.rows.get(key_expressions.plant_truth("delta", robot))
            rows = rows or self._kept.rows[key_expressions.plant_state("delta", robot)]
            stamps = [(clock.true_ns(stamp) - epoch_ns) / NS_PER_S for stamp in rows]
            hands.append([np.interp(times, stamps, axis) for axis in np.array(list(rows.values())).T])
        return np.array(hands)

    def expect_safe(self, final_error_m: float) -> None:
        """No edge ever too short, and every edge right at the end."""
        distances = self.distances()
        assert distances.min() > self.fleet.formation.safe_distance_m
        assert np.abs(distances[-1] - resolve(self.fleet).distances).max() < final_error_m

    def agent_states(self) -> set[State]:
        return {agent.state for agent in self.simulation.agents}


EVERYTHING = (
    "tick_jitter = 0.005",
    "robot = 2\nclock_skew = '50ms 100ppm'",
    "robot = 3\nclock_skew = -0.03",
    "jump_m = 0.1",
    "topic = 'state'\nloss = '10%'",
    "delay = '80ms 20ms'\nloss = '10%'",
    "robot = 4\nat = 2\nrestart = 'both'",
    "robot = 5\nat = 3\nfor = 0.5\npause = 'agent'",
    "robot = 6\nat = 4\nfor = 0.5\nkill = 'plant'",
)


@pytest.mark.slow
def test_all_kinds_of_faults_at_once_give_the_same_bytes_again():
    one, two = (Run(*EVERYTHING, duration_s=6.0).drive() for _ in range(2))
    assert one.log == two.log
    assert len(one.events()) == 8
    assert one.agent_states() == {State.STOPPED}


# ---------------------------------------------------------------------- the start


def missions(run: Run, key: str = key_expressions.mission("delta")) -> list[int]:
    """When the mission was said on `key`, ms of fleet time: by the operator unless given."""
    return [round((time_ns - run.simulation.epoch_ns) / 1e6) for time_ns, k, _ in run.log if k == key]


def test_a_fleet_that_is_ready_at_once_drives_as_soon_as_it_has_listened():
    run = Run().until(1.0)
    assert run.simulation.epoch_ns == 21 * PERIOD_NS  # of which agents listen for who is near for 20
    assert len(missions(run)) == 1
    assert run.agent_states() == {State.RUNNING}
    assert min(state.time_ns for state in run.states(1) if state.driving) == run.simulation.epoch_ns


@pytest.mark.slow
def test_a_fleet_that_is_never_ready_is_told_of_with_the_robots_and_why():
    run = Run("link = '2->1'\nloss = '100%'").drive()
    assert run.simulation.reasons == [
        "Not ready within 60 s: robot 1 (silent neighbours: robot 2), "
        "robot 2 (silent neighbours: robot 1 (does not hear this one))."
    ]
    assert missions(run) == []
    assert run.simulation.now_ns == 60 * NS_PER_S


# ---------------------------------------------------------------------- clocks


@pytest.mark.parametrize("skew_s", [0.1, -0.1])
def test_a_clock_that_is_100_ms_off_costs_little(skew_s: float):
    run = Run(f"robot = 3\nclock_skew = {skew_s}").drive()
    run.expect_safe(0.02)
    # Its messages say what its clock shows, on its own grid.
    start_ns = min(state.time_ns for state in run.states(1))
    first = run.states(3)[0]
    assert (first.time_ns - start_ns - round(skew_s * NS_PER_S)) % PERIOD_NS == 0
    assert min(decode(payload)[2] for _, key, payload in run.log if key.endswith("/hand")) >= 0


def test_a_robot_starts_by_its_own_clock():
    run = Run("robot = 3\nclock_skew = 0.1").until(0.5)
    began = {
        robot: min(s.time_ns for s in run.states(robot) if s.driving) - run.simulation.epoch_ns
        for robot in (1, 3)
    }
    assert began == {1: 0, 3: 0}
    arrivals = {
        robot: next(
            time_ns - run.simulation.epoch_ns
            for time_ns, key, payload in run.log
            if key == key_expressions.plant_state("delta", robot) and decode(payload)[10]
        )
        for robot in (1, 3)
    }
    assert arrivals == {1: 100_000, 3: 100_000 - NS_PER_S // 10}  # in true time 0.1 s before the others


@pytest.mark.slow
@pytest.mark.parametrize(("skew_s", "refusing"), [(0.3, {1, 2, 5, 6}), (-0.3, {3})])
def test_a_clock_that_is_300_ms_off_keeps_the_fleet_from_starting(skew_s: float, refusing: set[int]):
    """Those who refuse what seems to be of the future wait, and those whom they therefore do not hear."""
    run = Run(f"robot = 3\nclock_skew = {skew_s}").drive()
    (reason,) = run.simulation.reasons
    waiting = re.findall(r"robot (\d+) \(silent neighbours: (.*?)\)(?=, robot \d+ \(silent|\.$)", reason)
    assert {int(robot) for robot, because in waiting if "ahead" in because} == refusing
    assert {int(robot) for robot, _ in waiting} == {1, 2, 3, 5, 6}
    assert "its clock is 0.28 s ahead" in reason
    assert all(not state.driving for robot in run.fleet.ids for state in run.states(robot))


def test_a_clock_that_drifts_parts_from_the_epoch_on():
    run = Run("robot = 3\nclock_skew = '0s 1000ppm'").drive()
    run.expect_safe(0.05)
    epoch_ns = run.simulation.epoch_ns
    ahead_us = {}
    for time_ns, key, payload in run.log:
        if key == key_expressions.plant_state("delta", 3):
            true_ns = time_ns - 100_000
            ahead_us[(true_ns - epoch_ns) / NS_PER_S] = (decode(payload)[2] - true_ns) / 1e3
    times, ahead = np.array(sorted(ahead_us.items())).T
    assert ahead == pytest.approx(1e3 * np.maximum(times, 0.0), abs=0.002)
    assert times[-1] > 19.9
    # Its plant and its agent share a clock: no wrench is ever late.
    end_ns = epoch_ns + 20 * NS_PER_S
    assert all(state.driving for state in run.states(3) if epoch_ns <= state.time_ns < end_ns)


# ---------------------------------------------------------------------- ticks and sensors


def test_jitter_beyond_the_period_skips_ticks():
    run = Run("robot = 2\ntick_jitter = 0.1").drive()
    run.expect_safe(0.01)
    times = {robot: np.array([state.time_ns for state in run.states(robot)]) for robot in (1, 2)}
    assert set(np.diff(times[1])) == {PERIOD_NS}
    assert len(times[1]) - len(times[2]) > 400


@pytest.mark.slow
def test_measurements_that_are_lost_are_bridged():
    clean, holed = Run().drive(), Run("topic = 'state'\nloss = '30%'").drive()
    # What the plant was told is known: a state that is missing is worked out, but for rounding.
    assert np.abs(holed.distances() - clean.distances()).max() < 1e-6


def test_sensors_that_fail_for_long_are_a_fault_that_ends():
    run = Run('robot = 2\nat = 5\nfor = 1\ntopic = "state"\nloss = "100%"').until(5.5)
    assert run.agent(2).state is State.FAULT
    assert "plant silent" in run.agent(2).reason
    run.until(6.5)
    assert run.agent_states() == {State.RUNNING}


# ---------------------------------------------------------------------- processes


def test_an_agent_that_starts_again_drives_again():
    run = Run("name = 'crash'\nrobot = 3\nat = 5\nrestart = 'agent'").until(4.99)
    before = run.agent(3)
    run.until(5.0)
    assert run.agent(3) is not before
    run.until(5.1)
    assert run.agent(3).condition == ("waiting", "hears who is near")
    assert run.plant(3).condition[0] == "braking"
    run.until(5.5)
    assert run.agent(3).state is State.RUNNING  # it has recalled the mission, and its neighbours drive by it
    run.until(8.0)
    assert run.agent_states() == {State.RUNNING}
    run.until(20.0)
    assert run.events() == [(5.0, 3, "agent", "kill", "crash"), (5.0, 3, "agent", "start", "crash")]
    run.expect_safe(0.01)
    assert missions(run)[-1] == 5500
    told = [
        time_ms
        for robot in (1, 2, 4, 5, 6)
        for time_ms in missions(run, key_expressions.relayed("delta", robot))
        if time_ms > 0
    ]
    assert told == []  # nobody had to


def test_what_is_killed_says_and_hears_nothing_until_it_starts_again():
    run = Run("robot = 3\nat = 5\nfor = 1\nkill = 'both'").until(5.99)
    epoch_ns = run.simulation.epoch_ns
    late = [key for time_ns, key, _ in run.log if time_ns > epoch_ns + 5 * NS_PER_S + 200_000]
    assert late
    assert not [key for key in late if key.startswith("delta/robot/3/")]
    run.until(6.015)
    # At its first tick it has its plant's state; what was sent to it while it was down is gone.
    assert run.agent(3).condition == ("waiting", "silent neighbours: robot 1, robot 2, robot 5, robot 6")
    run.until(7.0)
    assert run.agent(3).state is State.RUNNING
    run.until(20.0)
    run.expect_safe(0.01)


def test_a_robot_that_is_killed_for_good_is_driven_on_without_and_nobody_hits_it():
    run = Run("robot = 2\nat = 5\nkill = 'both'").until(6.0)
    for robot in (1, 3, 4, 5):
        assert run.agent(robot).condition == ("degraded", "without robot 2 (no connection to its agent)")
    assert run.agent(6).state is State.RUNNING
    run.until(19.9)
    for robot in (1, 3, 4, 5, 6):
        assert run.agent(robot).state in DRIVING
    assert run.apart() > run.fleet.formation.safe_distance_m
    run.until(21.0)
    assert [event[3] for event in run.events()] == ["kill", "kill"]
    assert run.simulation.stopped


def test_a_paused_agent_skips_its_ticks_and_goes_on_with_the_newest():
    run = Run("robot = 3\nat = 5.003\nfor = 2\npause = 'agent'", duration_s=25.0).until(7.002)
    agent = run.agent(3)
    ticks = len([1 for _, key, _ in run.log if key == key_expressions.wrench("delta", 3)])
    assert run.plant(3).condition == ("braking", "no fresh wrench for 2.01 s")
    run.until(7.004)
    assert len([1 for _, key, _ in run.log if key == key_expressions.wrench("delta", 3)]) == ticks + 1
    wrench = next(
        decode(payload) for _, key, payload in reversed(run.log) if key == key_expressions.wrench("delta", 3)
    )
    # It woke between two deadlines: its tick is the last of those that it slept through.
    assert wrench[2] == run.simulation.epoch_ns + round(6.99 * NS_PER_S)
    run.until(25.0)
    assert run.agent(3) is agent
    run.expect_safe(0.01)
    status = next(
        decode(payload) for _, key, payload in reversed(run.log) if key == key_expressions.status("delta", 3)
    )
    assert isinstance(status, Status)
    counters = dict(status.counters)
    assert counters["overruns"] == 99
    # Of the 101 messages of each neighbour, and of one that is near, the newest were kept.
    assert counters["lost"] == 5 * (101 - INBOX_SIZE)


def test_a_body_whose_plant_is_paused_brakes_by_itself():
    run = Run("robot = 3\nat = 5\nfor = 1\npause = 'plant'").until(6.0)
    before, after = (state for state in run.states(3)[-2:])
    assert after.time_ns - before.time_ns == 51 * PERIOD_NS
    assert abs(before.speed) > 0.05
    assert abs(after.speed) < 1e-3
    run.until(20.0)
    run.expect_safe(0.01)
