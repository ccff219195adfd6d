"""Several plants in one process: each does as it would in one of its own."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ticks import Ticks
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Mission, Outgoing, PlantState, Resume, Stop, Wrench
from handfast.agent.node import INBOX_SIZE
from handfast.plant.node import PlantNode
from handfast.plant.pool import PlantPool, PoolTicks
from handfast.plant.unicycle import from_fleet

FLEET = """
robot = [
    { id = 1, x_m = 0, y_m = 0 },
    { id = 2, x_m = 2, y_m = 0, position_noise_m = 0.01 },
    { id = 5, x_m = 0, y_m = 2 },
]
fleet = { name = "three", rate_hz = 50, seed = 3 }
formation = { edges = [[1, 2], [2, 5]], distance_m = 1.0, safe_distance_m = 0.2 }
control = { wrench_timeout_s = 0.1 }
faults = { rule = [%s] }
"""
T0 = 1000 * NS_PER_S
PERIOD = 20_000_000
MS = 1_000_000
LATE = '{ tick_jitter = "15ms", robot = 2 }'
LOSS = '{ topic = "wrench", loss = "40%", delay = 0.05 }'


def fleet(rules: str = "") -> Fleet:
    return parse_fleet(FLEET % rules, source="here")


def plants(made: Fleet) -> list[PlantNode]:
    return [PlantNode(made, robot, from_fleet(made, robot)) for robot in made.ids]


def messages(made: Fleet, now_ns: int, sequence: int) -> list[Outgoing]:
    """What is said before the tick at `now_ns`: other forces to each, and orders of all kinds."""
    name, found = made.fleet.name, []
    for robot in made.ids:
        wrench = Wrench(robot, sequence, now_ns - PERIOD, 0.1 * robot, 0.01 * sequence, False)
        found.append((key_expressions.wrench(name, robot), encode(wrench)))
    if sequence == 3:
        mission = Mission(1, now_ns, now_ns + PERIOD, 100 * NS_PER_S, digest(made))
        found.append((key_expressions.mission(name), encode(mission)))
    if sequence == 40:
        found.append((key_expressions.stop(name), encode(Stop(now_ns // 1000, now_ns, "dinner"))))
    if sequence == 60:
        resume = encode(Resume(now_ns // 1000, now_ns, ()))
        found.append((key_expressions.relayed(name, 2), resume))
    return found


def alone(made: Fleet, ticks: int) -> list[Outgoing]:
    """What plants publish, each in a process of its own."""
    found = []
    for node in plants(made):
        due, told = Ticks(node, T0), 0
        while due.due_ns <= T0 + ticks * PERIOD:
            now_ns = due.due_ns
            while told * PERIOD + T0 + PERIOD <= now_ns:
                told += 1
                for key, payload in messages(made, T0 + told * PERIOD, told):
                    if key in node.subscriptions:
                        node.receive(now_ns, key, payload)
            tick_ns, _, _ = due.take(now_ns)
            found += node.tick(tick_ns)
            due.plan(tick_ns)
    return found


def together(made: Fleet, ticks: int) -> list[Outgoing]:
    """The same, all in one pool."""
    nodes = plants(made)
    pool = PlantPool(nodes, [lambda _: None] * len(nodes))
    due, told, found = PoolTicks(pool, T0), 0, list[Outgoing]()
    while due.due_ns <= T0 + ticks * PERIOD:
        now_ns = due.due_ns
        while told * PERIOD + T0 + PERIOD <= now_ns:
            told += 1
            for key, payload in messages(made, T0 + told * PERIOD, told):
                assert key in pool.subscriptions
                pool.receive(now_ns, key, payload)
        tick_ns, _, _ = due.take(now_ns)
        found += pool.tick(tick_ns)
        due.plan(tick_ns)
    return found


@pytest.mark.parametrize("rules", ["", LATE, LOSS, f"{LATE}, {LOSS}"])
def test_each_publishes_to_the_bit_what_it_would_alone(rules: str) -> None:
    """Also where the ticks of one come late, and where messages of another are lost."""
    made = fleet(rules)
    apart, shared = alone(made, 80), together(made, 80)
    assert sorted(shared) == sorted(apart)
    assert len(shared) > 3 * 75
    states = [state for _, payload in shared if isinstance(state := decode(payload), PlantState)]
    assert {(state.robot, state.driving) for state in states} == {
        (robot, driving) for robot in (1, 2, 5) for driving in (True, False)
    }, "each drives, and stands while it is told to"
    assert {state.robot for state in states if state.driving and state.time_ns > T0 + 62 * PERIOD} == {2}, (
        "what an agent relays is for its own plant"
    )


def test_a_message_of_another_robot_reaches_nobody() -> None:
    made = fleet()
    nodes = plants(made)[:2]
    pool = PlantPool(nodes, [lambda _: None] * 2)
    pool.receive(T0, key_expressions.wrench("three", 5), b"nonsense")
    due = PoolTicks(pool, T0)
    due.take(due.due_ns)
    pool.tick(due.due_ns)
    assert not pool.rejected
    pool.receive(T0, key_expressions.wrench("three", 2), b"nonsense")
    pool.receive(T0, key_expressions.stop("three"), b"nonsense")
    due.plan(due.due_ns)
    due.take(due.due_ns)
    pool.tick(due.due_ns)
    assert pool.rejected == {"checksum": 3}, "one wrench, and a stop that each of the two took"


def test_what_is_kept_is_what_all_have_taken_and_each_is_given_it_again() -> None:
    made = fleet()
    nodes, name = plants(made), made.fleet.name
    pool = PlantPool(nodes, [lambda _: None] * 3)
    assert pool.lasting == ()
    due = PoolTicks(pool, T0)

    def tick(pool: PlantPool = pool, due: PoolTicks = due) -> tuple[bytes, ...]:
        due.take(due.due_ns)
        pool.tick(due.due_ns)
        due.plan(due.due_ns)
        return pool.lasting

    stop = encode(Stop(T0 // 1000, T0, "dinner"))
    pool.receive(T0, key_expressions.relayed(name, 1), stop)
    assert tick() == (), "only one has it"
    pool.receive(T0, key_expressions.stop(name), stop)
    assert tick() == (stop,)
    assert tick() is pool.lasting, "nothing new, nothing to write"

    again = PlantPool(plants(made), [lambda _: None] * 3)
    again.recall(T0, pool.lasting)
    assert tick(again, PoolTicks(again, T0)) == (stop,)
    assert all("dinner" in each.node.condition[1] for each in again.pooled)


def test_of_a_flood_the_newest_are_kept_and_of_one_key_alone() -> None:
    made = fleet()
    (node,) = plants(made)[:1]
    pool = PlantPool([node], [lambda _: None])
    name = made.fleet.name
    pool.receive(T0, key_expressions.stop(name), encode(Stop(T0 // 1000, T0, "dinner")))
    for _ in range(3 * INBOX_SIZE):
        pool.receive(T0, key_expressions.wrench(name, 1), b"nonsense")
    due = PoolTicks(pool, T0)
    due.take(due.due_ns)
    pool.tick(due.due_ns)
    assert pool.rejected == {"checksum": INBOX_SIZE}
    assert "dinner" in node.condition[1]


def test_one_that_is_late_is_told_so_and_skips_its_own_ticks() -> None:
    made = fleet()
    nodes = plants(made)
    pool = PlantPool(nodes, [lambda _: None] * 3)
    due = PoolTicks(pool, T0)
    tick_ns, missed, late_ns = due.take(T0 + 3 * PERIOD + 7 * MS)
    assert (tick_ns, missed, late_ns) == (T0 + 3 * PERIOD, 2, 2 * PERIOD + 7 * MS)
    pool.tick(tick_ns)
    due.plan(tick_ns)
    assert due.due_ns == T0 + 4 * PERIOD


def test_each_writes_its_own_log_and_ends_when_it_stands() -> None:
    made = fleet()
    nodes = plants(made)
    logs: list[list[str]] = [[], [], []]
    pool = PlantPool(nodes, [log.append for log in logs])
    due, name = PoolTicks(pool, T0), made.fleet.name

    def step(*driven: int) -> None:
        for robot in driven:
            wrench = Wrench(robot, 1, due.due_ns, 20.0, 0.0, False)
            pool.receive(due.due_ns, key_expressions.wrench(name, robot), encode(wrench))
        tick_ns, _, _ = due.take(due.due_ns)
        pool.tick(tick_ns)
        due.plan(tick_ns)

    step()
    for _ in range(60):
        step(2)
    assert [[line.partition(":")[0] for line in log] for log in logs] == [
        ["braking"], ["braking", "driving"], ["braking"],
    ]  # fmt: skip
    pool.end()
    step()
    assert not pool.done, "one still moves"
    for _ in range(100):
        step()
    assert pool.done
    assert logs[1][-1] == "braking: the plant was told to end"
