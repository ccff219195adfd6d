"""Whole fleets in virtual time: they settle, stay apart, and do the same again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.limits import gains_of
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest, load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve, resolved, start_hands
from handfast.agent.formation.trajectory import make_trajectory
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Mission, Outgoing
from handfast.agent.node import Node
from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis import fleet_law
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.sweep.plan import random_fleet
from handfast.plant.node import PlantNode
from tests.hand_trace import Floats, HandTrace, drive, drive_until_settled

STARTS = 30
CHUNK = 6
SETTLING_MAX_S = 40.0
SETTLING_MEDIAN_S = 8.5
CALM_S = 6.0
"""A fleet that has kept its distances for so long has settled: no start left them again."""


def bundled(name: str, *overrides: str, law: str | None = None) -> Fleet:
    return load_fleet(FLEETS / f"{name}.toml", overrides, law)


# ---------------------------------------------------------------------- random starts


def settling_times(law: str, seeds: range) -> list[float]:
    base = bundled("delta", f"fleet.duration_s={SETTLING_MAX_S}", law=law)
    times = []
    for seed in seeds:
        trace = drive_until_settled(random_fleet(base, seed), CALM_S)
        closest = trace.distances().min()
        assert closest > base.formation.safe_distance_m, f"seed {seed}: an edge of {closest:.3f} m"
        settled = trace.settling_time()
        assert settled is not None, f"seed {seed}: not settled after {SETTLING_MAX_S} s"
        times.append(settled)
    return times


@pytest.mark.slow
@pytest.mark.parametrize(
    "first",
    [pytest.param(k, marks=pytest.mark.long if k else ()) for k in range(0, STARTS, CHUNK)],
)
@pytest.mark.parametrize("law", ["joint", "edge"])
def test_random_starts_stay_apart_and_settle(law: str, first: int):
    times = settling_times(law, range(first, first + CHUNK))
    # At least half of every chunk below it: so is the median of all.
    assert np.median(times) < SETTLING_MEDIAN_S, times


# ---------------------------------------------------------------------- what a fleet may be


@pytest.mark.slow
@pytest.mark.parametrize("law", ["joint", "edge"])
def test_delta_settles_on_its_line(law: str):
    trace = drive(resolved(bundled("delta", law=law)))
    assert trace.distances().min() > 0.22
    assert trace.settling_time() is not None
    assert np.abs(trace.distances()[-1] - 1.0).max() < 0.02
    assert trace.tracking_error()[-1].max() < 0.1


@pytest.mark.slow
def test_the_penalty_law_is_safe_whatever_shape_it_comes_to():
    """Its edges compete with navigation: from here it settles after 20 to 55 s or not at all, by the rate."""
    assert drive(resolved(bundled("delta", law="penalty"))).distances().min() > 0.22


@pytest.mark.slow
def test_line_of_ten_settles_on_its_waypoints():
    trace = drive(resolved(bundled("line10", "fleet.duration_s=25")))
    settled = trace.settling_time()
    assert settled is not None
    assert settled < 20.0
    assert trace.distances().min() > 0.22


@pytest.mark.slow
def test_lattice_of_45_settles_on_its_circle():
    trace = drive(resolved(bundled("lattice45", "fleet.duration_s=20")))
    settled = trace.settling_time()
    assert settled is not None
    assert settled < 15.0
    assert trace.distances().min() > 0.22


@pytest.mark.slow
def test_bodies_may_differ():
    fleet = bundled("delta", "trajectory.kind=hold", "fleet.duration_s=25")
    robots = tuple(
        replace(robot, mass_kg=4.0 + 5.0 * k, inertia_kgm2=0.05 * (k + 1), hand_offset_m=0.06 + 0.04 * k)
        for k, robot in enumerate(fleet.robots)
    )
    trace = drive(resolved(replace(fleet, robots=robots)))
    assert trace.settling_time() is not None
    assert np.abs(trace.distances()[-1] - 1.0).max() < 0.01
    assert trace.distances().min() > 0.22


def test_every_edge_may_have_its_own_distance():
    lengths = [0.8, 1.0, 1.2]
    fleet = bundled("delta", "fleet.duration_s=30", "trajectory.kind=hold")
    fleet = replace(
        fleet,
        formation=replace(
            fleet.formation,
            edges=((1, 2), (2, 3), (1, 3)),
            distance_m=tuple(lengths),
            offsets=None,
            assign=True,
        ),
        robots=fleet.robots[:3],
    )
    trace = drive(resolved(fleet))
    assert trace.distances()[-1] == pytest.approx(lengths, abs=0.01)


@pytest.mark.slow
def test_noise_and_lag_and_limits_are_survived():
    fleet = bundled(
        "delta",
        "robot_defaults.position_noise_m=0.003",
        "robot_defaults.heading_noise_rad=0.003",
        "robot_defaults.actuator_lag_s=0.05",
        "robot_defaults.max_force_n=30",
    )
    trace = drive(resolved(fleet))
    assert trace.settling_time() is not None
    assert trace.distances().min() > 0.22


# ---------------------------------------------------------------------- the joint multipliers


def joint_solution(fleet: Fleet, times: Floats) -> Floats:
    """Hands under the exact joint law in continuous time, which no agent could compute, (k, n, 2), m."""
    geometry, control = resolve(fleet), fleet.control
    n, (i, j) = len(geometry.ids), geometry.edges.T
    gains = gains_of(fleet)
    trajectory = make_trajectory(fleet.trajectory)

    def rate(t: float, y: Floats) -> Floats:
        r, v = y.reshape(2, 2, n)
        place, speed, acceleration = np.array(trajectory.at(t)).reshape(3, 2, 1)
        error = r - place - geometry.offsets.T
        fn = fleet_law.navigation_force(acceleration, error, v - speed, control.c1, control.c2)
        e = fleet_law.edges(
            r[:, i] - r[:, j],
            v[:, i] - v[:, j],
            fn[:, i] - fn[:, j],
            geometry.distances,
            fleet.formation.safe_distance_m,
            gains,
        )
        force = fleet_law.forces(e, fleet_law.multipliers_joint(e, i, j, n))
        return np.concatenate([v.ravel(), (fn + fleet_law.total_forces(force, i, j, n)).ravel()])

    start = np.concatenate([start_hands(fleet).T.ravel(), np.zeros(2 * n)])
    solution = solve_ivp(rate, (0.0, times[-1]), start, method="DOP853", rtol=1e-9, atol=1e-11, t_eval=times)
    return solution.y[: 2 * n].T.reshape(len(times), 2, n).transpose(0, 2, 1)


@pytest.mark.slow
def test_agents_find_the_joint_multipliers_together():
    """One sweep a tick with what the neighbours sent: the faster, the nearer to the exact law."""
    errors = []
    for rate_hz in (50, 100, 200):
        settings = (f"fleet.rate_hz={rate_hz}", "fleet.duration_s=10", "avoidance.enabled=false")
        trace = drive(resolved(bundled("delta", *settings)))
        error = trace.hands - joint_solution(trace.fleet, trace.times)
        errors.append(np.hypot(error[..., 0], error[..., 1]))
    largest = [error.max() for error in errors]
    assert largest[0] > 1.8 * largest[1] > 3.24 * largest[2]  # of first order: 2 in the limit
    assert largest[2] < 0.06
    assert errors[2][-1].max() < 0.005


# ---------------------------------------------------------------------- the same again


@pytest.mark.parametrize("noise_m", [0.0, 0.01])
def test_two_runs_give_the_same_bytes(noise_m: float):
    fleet = resolved(bundled("delta", "fleet.duration_s=3", f"robot_defaults.position_noise_m={noise_m}"))
    runs: list[list[tuple[int, str, bytes]]] = []
    for _ in range(2):
        messages: list[tuple[int, str, bytes]] = []

        def keep(time_ns: int, key: str, payload: bytes, messages: list = messages) -> None:
            messages.append((time_ns, key, payload))

        Simulation(fleet, keep).run()
        runs.append(messages)
    assert len(runs[0]) > 3 * 50 * 6 * 3
    assert runs[0] == runs[1]


# ---------------------------------------------------------------------- robots that fall silent


class Freezable:
    """A node that can be frozen, as SIGSTOP freezes its process: it hears nothing and says nothing."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.frozen = False
        self._tick = node.tick
        self._receive = node.receive
        node.tick = self.tick  # type: ignore[method-assign]
        node.receive = self.receive  # type: ignore[method-assign]

    def tick(self, now_ns: int) -> list[Outgoing]:
        return [] if self.frozen else self._tick(now_ns)

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        if not self.frozen:
            self._receive(now_ns, key, payload)


def at(simulation: Simulation, seconds: float) -> int:
    return simulation.epoch_ns + round(seconds * NS_PER_S)


def agent_of(simulation: Simulation, robot: int) -> Agent:
    return next(agent for agent in simulation.agents if agent.robot == robot)


def plant_of(simulation: Simulation, robot: int) -> PlantNode:
    return next(plant for plant in simulation.plants if plant.robot == robot)


def running_delta(*overrides: str) -> tuple[Simulation, HandTrace]:
    fleet = resolved(bundled("delta", "control.prediction_horizon_s=1.0", *overrides))
    kept = HandTrace(fleet)
    simulation = Simulation(fleet, kept)
    simulation.start(60 * NS_PER_S)
    simulation.run_until(at(simulation, 5.0))
    assert {agent.state for agent in simulation.agents} == {State.RUNNING}
    return simulation, kept


@pytest.mark.slow
@pytest.mark.patches
def test_neighbours_of_a_frozen_agent_drive_on_without_it_and_take_it_back():
    simulation, kept = running_delta()
    agent = Freezable(agent_of(simulation, 1))  # its neighbours are 2 and 3
    agent.frozen = True
    simulation.run_until(at(simulation, 5.4))
    assert agent_of(simulation, 2).state is State.RUNNING  # carried on by prediction
    simulation.run_until(at(simulation, 5.9))
    assert agent_of(simulation, 2).condition == ("degraded", "slower: robot 1 (0.9 s)")
    simulation.run_until(at(simulation, 6.1))
    for robot in (2, 3):
        assert agent_of(simulation, robot).condition == ("degraded", "without robot 1 (1.1 s)")
    for robot in (4, 5, 6):
        assert agent_of(simulation, robot).state is State.RUNNING  # 2 and 3 still tell where they are
    assert plant_of(simulation, 1).condition[0] == "braking"
    simulation.run_until(at(simulation, 8.0))
    agent.frozen = False
    simulation.run_until(at(simulation, 9.0))
    assert {agent.state for agent in simulation.agents} == {State.RUNNING}
    simulation.run_until(at(simulation, 40.0))
    trace = kept.trace(simulation.epoch_ns, 40.0)
    assert trace.settling_time() is not None
    assert trace.distances().min() > 0.22


@pytest.mark.patches
def test_frozen_plant_is_a_fault_of_its_agent_and_a_thaw_ends_it():
    simulation, _ = running_delta()
    plant = Freezable(plant_of(simulation, 4))
    plant.frozen = True
    simulation.run_until(at(simulation, 5.4))
    assert agent_of(simulation, 4).state is State.FAULT
    assert agent_of(simulation, 4).reason.startswith("plant silent for")
    plant.frozen = False
    simulation.run_until(at(simulation, 6.5))
    assert {agent.state for agent in simulation.agents} == {State.RUNNING}


def test_mission_ends_with_every_robot_stopped_at_rest():
    fleet = resolved(bundled("delta", "fleet.duration_s=4"))
    kept = HandTrace(fleet)
    simulation = Simulation(fleet, kept)
    simulation.run()
    assert simulation.stopped
    assert {agent.reason for agent in simulation.agents} == {"the mission is over"}
    assert simulation.now_ns < at(simulation, 4.0) + NS_PER_S


@pytest.mark.slow
def test_new_mission_while_driving_leaves_the_formation_together():
    """All have it within a tick, and its epoch lies ahead: they wait for it, and start anew."""
    fleet = resolved(bundled("delta"))
    kept = HandTrace(fleet)
    simulation = Simulation(fleet, kept)
    simulation.start(60 * NS_PER_S)
    simulation.run_until(at(simulation, 15.0))
    mission = Mission(2, simulation.now_ns, at(simulation, 18.0), 60 * NS_PER_S, digest(fleet))
    simulation.publish(key_expressions.mission("delta"), encode(mission))
    simulation.run_until(at(simulation, 30.0))
    assert {agent.state for agent in simulation.agents} == {State.RUNNING}
    trace = kept.trace(simulation.epoch_ns, 30.0)
    late = trace.distances()[trace.times >= 14.0]
    assert late.min() > 0.9
    assert late.max() < 1.1
