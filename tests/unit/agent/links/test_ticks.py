"""When a node ticks: the grid, late ticks, skipped ticks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from handfast.agent.common.time import NS_PER_S
from handfast.agent.core import Agent
from handfast.agent.fleet.hosts import CROWD
from handfast.agent.fleet.loading import digest, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ticks import Ticks, agent_slot_ns, plant_slot_ns
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Faults, Mission
from handfast.agent.node import Node
from handfast.plant.node import PlantNode
from handfast.plant.unicycle import from_fleet

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 2, y_m = 0 }]
fleet = { name = "two", rate_hz = 50, seed = %d }
formation = { edges = [[1, 2]], distance_m = 1.0, safe_distance_m = 0.2 }
faults = { rule = [%s] }
"""

T0 = 1000 * NS_PER_S

PERIOD = 20_000_000

MS = 1_000_000


def fleet(rules: str = "", seed: int = 0) -> Fleet:
    return parse_fleet(FLEET % (seed, rules), source="here")


def plant(made: Fleet, robot: int = 1) -> PlantNode:
    return PlantNode(made, robot, from_fleet(made, robot))


def told(node: Node, count: int, now_ns: int = T0) -> list[int]:
    """What successive ticks are told that all begin on time."""
    ticks = Ticks(node, now_ns)
    times = []
    for _ in range(count):
        time_ns, missed, _ = ticks.take(ticks.due_ns)
        assert missed == 0
        times.append(time_ns)
        ticks.plan(time_ns)
    return times


def test_ticks_lie_on_the_grid():
    made = fleet()
    assert told(plant(made), 3) == [T0 + k * PERIOD for k in (1, 2, 3)]
    assert told(Agent(made, 1), 3) == [T0 + k * PERIOD + PERIOD // 2 for k in (0, 1, 2)]


def test_deadlines_that_have_passed_are_skipped_and_counted():
    ticks = Ticks(plant(fleet()), T0)
    time_ns, missed, _ = ticks.take(T0 + 4 * PERIOD + 5)
    assert (time_ns, missed) == (T0 + 4 * PERIOD, 3)
    ticks.plan(time_ns)
    assert ticks.due_ns == T0 + 5 * PERIOD


JITTER = "{ robot = 1, tick_jitter = 0.005 }"


def test_late_ticks_are_uniform_up_to_the_rules_limit():
    for node in (plant(fleet(JITTER)), Agent(fleet(JITTER), 1)):
        late = np.array([(time_ns - node.phase_ns) % PERIOD for time_ns in told(node, 3000)])
        assert late.max() < 5 * MS
        assert stats.kstest(late / (5 * MS), "uniform").pvalue > 1e-3


def test_of_late_ticks_there_may_be_a_share_and_which_they_are_differs_by_process():
    rule = '{ robot = [1, 2], tick_jitter = "5ms 20%" }'
    chosen = []
    for node in (plant(fleet(rule)), plant(fleet(rule), 2), Agent(fleet(rule), 1)):
        late = np.array([(time_ns - node.phase_ns) % PERIOD for time_ns in told(node, 3000)])
        assert np.mean(late > 0) == pytest.approx(0.2, abs=0.03)
        assert stats.kstest(late[late > 0] / (5 * MS), "uniform").pvalue > 1e-3
        chosen.append(late > 0)
    assert not np.array_equal(chosen[0], chosen[1])
    assert not np.array_equal(chosen[0], chosen[2])


def test_live_rules_make_ticks_late_from_when_they_come():
    node = plant(fleet())
    ticks = Ticks(node, T0)
    rules = "[[faults.rule]]\nrobot = 1\ntick_jitter = 0.005"
    node.receive(T0 + PERIOD, "two/faults", encode(Faults(1, T0, "ana@lab:1", T0, 0, rules)))
    assert ticks.due_ns == T0 + PERIOD
    ticks.plan(T0 + PERIOD)
    assert 0 < ticks.due_ns - (T0 + 2 * PERIOD) < 5 * MS


def test_a_run_and_its_simulation_draw_the_same_whenever_they_are():
    late = []
    for epoch_ns in (T0, 5 * PERIOD):
        made = fleet("{ robot = 1, at = 0, tick_jitter = 0.005 }")
        node = plant(made)
        mission = Mission(1, epoch_ns, epoch_ns, 60 * NS_PER_S, digest(made))
        node.receive(epoch_ns, "two/mission", encode(mission))
        late.append([time_ns - epoch_ns for time_ns in told(node, 50, epoch_ns)])
    assert late[0] == late[1]
    assert late[0] != [(k + 1) * PERIOD for k in range(50)]


def test_jitter_longer_than_the_period_skips_ticks_and_keeps_their_order():
    node = plant(fleet("{ robot = 1, tick_jitter = 0.1 }"))
    ticks = Ticks(node, T0)
    times, skipped = [T0], 0
    for _ in range(300):
        time_ns, missed, _ = ticks.take(ticks.due_ns)
        times.append(time_ns)
        skipped += missed
        ticks.plan(time_ns)
    rounds = np.array(times) // PERIOD
    assert np.all(np.diff(rounds) >= 1)
    assert skipped == rounds[-1] - rounds[0] - 300
    assert skipped > 300


def test_how_late_a_tick_is_counts_from_its_deadline_or_by_what_was_skipped():
    ticks = Ticks(plant(fleet()), T0)
    assert ticks.take(T0 + PERIOD + 7)[2] == 7
    assert ticks.take(T0 + 4 * PERIOD + 5)[2] == 3 * PERIOD + 5
    late = Ticks(plant(fleet("{ robot = 1, tick_jitter = 0.2 }")), T0)
    time_ns, missed, late_ns = late.take(late.due_ns)
    assert late_ns == missed * PERIOD > 0  # on purpose: it begins when it was to
    assert time_ns == late.due_ns


def test_a_node_may_have_another_period_after_each_tick():
    agent = Agent(fleet(), 1)
    ticks = Ticks(agent, T0)
    stamps = []
    for period_ns in (PERIOD, 4 * PERIOD, 4 * PERIOD, PERIOD, PERIOD):
        time_ns, missed, _ = ticks.take(ticks.due_ns)
        assert missed == 0
        stamps.append((time_ns - T0 - PERIOD // 2) // PERIOD)
        agent.period_ns = period_ns
        ticks.plan(time_ns)
    assert stamps == [0, 1, 4, 8, 9]  # all of a fleet in the same rounds


def many(count: int, hosts: int = 0, rate_hz: float = 10.0) -> Fleet:
    def host(k: int) -> str:
        return f', host = "h{k % hosts}"' if hosts else ""

    rows = ", ".join(f"{{ id = {k}, x_m = {k}, y_m = 0{host(k)} }}" for k in range(1, count + 1))
    sections = "".join(f'[host.h{k}]\naddress = "10.0.0.{k + 1}"\n' for k in range(hosts))
    return parse_fleet(
        f"robot = [{rows}]\n"
        f'fleet = {{ name = "many", rate_hz = {rate_hz} }}\n'
        f"formation = {{ edges = [{', '.join(f'[{k}, {k + 1}]' for k in range(1, count))}], "
        "distance_m = 1.0, safe_distance_m = 0.2 }\n"
        "control = { plant_timeout_s = 1.0, wrench_timeout_s = 1.0 }\n" + sections,
        source="here",
    )


def test_where_many_share_a_machine_each_agent_has_its_slot_and_plants_wake_after_the_last() -> None:
    made = many(CROWD + 6)
    slots = [agent_slot_ns(made, robot) for robot in made.ids]
    assert slots[0] == 0
    assert len(set(slots)) == len(slots)
    period = made.period_ns
    assert max(slots) < period // 2 < period // 2 + plant_slot_ns(made, 1)
    assert {plant_slot_ns(made, robot) for robot in made.ids} == {period // 4}


def test_a_tick_in_its_slot_is_on_time_and_has_the_time_of_its_round() -> None:
    slot = 7 * MS
    ticks = Ticks(plant(fleet()), T0, slot)
    assert ticks.due_ns == T0 + PERIOD + slot
    assert ticks.take(ticks.due_ns) == (T0 + PERIOD, 0, 0)
    assert ticks.take(ticks.due_ns + 3 * MS) == (T0 + PERIOD, 0, 3 * MS)
    assert ticks.take(ticks.due_ns + 2 * PERIOD + MS) == (T0 + 3 * PERIOD, 2, 2 * PERIOD + MS)
    ticks.plan(T0 + 3 * PERIOD)
    assert ticks.due_ns == T0 + 4 * PERIOD + slot
