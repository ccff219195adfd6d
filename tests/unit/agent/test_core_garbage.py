"""The agent, driven by hand: messages that are none, and numbers that no robot has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.loading import digest
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import (
    FUTURE_NS_MAX,
    Ask,
    Beacon,
    HandState,
    Heartbeat,
    Mission,
    PlantState,
    Resume,
    Stop,
    Wrench,
)
from handfast.agent.supervision.state_machine import State
from tests.unit.agent.agent_bench import (
    HAND,
    HEARTBEAT,
    MISSION,
    OTHER,
    OTHERS_BEACON,
    PERIOD,
    PLANT,
    RESUME,
    STATUS,
    STOP,
    WRENCH,
    Bench,
    brakes,
    fleet,
)
from tests.wire import sealed

# ---------------------------------------------------------------------- garbage


def garbage(bench: Bench) -> list[tuple[str, bytes]]:
    """What may come in one tick and must change nothing, with the reason it is counted under."""
    now, mine = bench.now, digest(bench.fleet)
    hand_state = HandState(2, 10**6, now - PERIOD // 4, True, 1, *[3.0] * 11, ((1, 9.0),), ())
    plant = PlantState(1, 10**6, now - PERIOD // 4, *[3.0] * 7, True, True, True, "")
    every = (PLANT, OTHER, MISSION, STOP, HAND, WRENCH, STATUS, "two/robot/9/hand", "", "two/**")
    junk = (b"", b"\x00", b"\xff" * 20_000, b"\x91\x01", b"junk" * 20, sealed(b"junk"))
    out = [(key, each) for key in every for each in junk]
    out += [
        (PLANT, encode(hand_state)),
        (OTHER, encode(plant)),
        (MISSION, encode(plant)),
        (STOP, encode(plant)),
    ]
    out += [(key, encode(plant._replace(robot=2))) for key in every]
    out += [(OTHER, encode(hand_state._replace(robot=robot))) for robot in (1, 3, 9999)]
    out += [(key, encode(Wrench(1, 0, now, 1.0, 1.0, False))) for key in every]
    for stamp in (now + FUTURE_NS_MAX + 1, now - 50 * PERIOD, 0):
        out += [(OTHER, encode(hand_state._replace(time_ns=stamp)))]
        out += [(PLANT, encode(plant._replace(time_ns=stamp, healthy=False)))]
    for value in (float("nan"), float("inf")):
        out += [(OTHER, encode(hand_state._replace(x=value))), (PLANT, encode(plant._replace(speed=value)))]
    out += [(OTHER, encode(hand_state)[:-1]), (OTHER, encode(hand_state) + b"\x00")]
    out += [
        (MISSION, encode(Mission(99, now, now, 1, "not mine"))),
        (PLANT, encode(Mission(99, now, 0, 1, mine))),
    ]
    out += [(MISSION, encode(Stop(99, now, ""))), (STOP, encode(Mission(99, now, 0, 1, mine)))]
    out += [(MISSION, encode(Mission(99, now, now, NS_PER_S, mine, robots=((7, 0.0, 0.0),))))]
    out += [(MISSION, encode(Mission(99, now, now, NS_PER_S, mine, edges=((1, 2, 0.1),))))]
    beacon = Beacon(2, 0, now - PERIOD // 4, True, 3.0, 3.0, *[0.0] * 3, 99, 0, 99, -1)
    out += [(OTHERS_BEACON, encode(beacon._replace(robot=3))), (OTHER, encode(beacon))]
    out += [(OTHERS_BEACON, encode(beacon._replace(time_ns=now + FUTURE_NS_MAX + 1)))]
    out += [(STOP, encode(Resume(99, now, ()))), (RESUME, encode(Stop(99, now, "")))]
    out += [(STOP, encode(Heartbeat(now, "x"))), (HEARTBEAT, encode(Ask(now, "x")))]
    return out


def test_garbage_on_every_key_changes_nothing_and_is_counted():
    clean, dirty = Bench(), Bench()
    given = counted = 0
    for bench in (clean, dirty):
        bench.drive()
    assert clean.now == dirty.now
    for tick in range(60):
        for bench in (clean, dirty):
            bench.pose = Pose(0.01 * tick, 0.0, 0.02 * tick, 0.1, 0.05)
            bench.other = (1.5 - 0.01 * tick, 0.2, -0.1, 0.0)
        junk = garbage(dirty)
        given += len(junk)
        one, other = clean.tick(), dirty.tick(*junk)
        assert dirty.state is State.RUNNING
        assert [pair for pair in one.raw if pair[0] != STATUS] == [
            pair for pair in other.raw if pair[0] != STATUS
        ]
        assert (one.status is None) == (other.status is None)
        if one.status is not None:
            assert other.status.digest in ((), (digest(dirty.fleet),))  # it has refused one for another
            assert one.status._replace(counters=()) == other.status._replace(counters=(), digest=())
    before = clean.counters()
    after = dirty.counters()
    counted = after["rejected"]
    assert counted == given
    assert before["rejected"] == 0
    reasons = {name: count for name, count in after.items() if name.startswith("rejected.")}
    assert sum(reasons.values()) == counted
    assert {name.partition(".")[2] for name in reasons} == {
        "checksum", "malformed", "oversized", "not_finite", "wrong_key", "future", "out_of_order", "digest",
        "version", "mission",
    }  # fmt: skip
    assert after["corrupted"] > 0
    assert after["received"] == before["received"]


# ---------------------------------------------------------------------- numbers that fail


EXTREMES = [1e6, 9e14, -9e14, 1e155, 1e300, -1.7e308]


@pytest.mark.parametrize("value", EXTREMES)
@pytest.mark.parametrize("name", PlantState._fields[3:10])
@pytest.mark.parametrize("when", ["before", "while driving"])
def test_absurd_plant_states_never_reach_the_wire_nor_end_the_agent(name: str, value: float, when: str):
    """`Bench.tick` decodes all that is sent, and finds it finite."""
    bench = Bench()
    if when == "while driving":
        bench.drive()
    bench.plant = {name: value}
    with np.errstate(all="ignore"):
        if when == "before":
            bench.tick()
            bench.mission()
        for _ in range(10):
            out = bench.tick()
            if bench.state is not State.RUNNING:
                assert brakes(out)
    if bench.state is State.FAULT:
        assert bench.agent.reason


@pytest.mark.parametrize("value", EXTREMES)
@pytest.mark.parametrize("name", HandState._fields[5:16])
@pytest.mark.parametrize("coupling", ["joint", "edge", "penalty"])
def test_absurd_neighbours_never_reach_the_wire_nor_end_the_agent(name: str, value: float, coupling: str):
    bench = Bench(f"control.coupling={coupling}")
    bench.drive()
    with np.errstate(all="ignore"):
        for tick in range(6):
            stamp = bench.now - PERIOD // 2
            absurd = HandState(2, 10**6 + tick, stamp, True, 1, *[0.0] * 11, ((1, 0.0),), ())._replace(
                **{name: value}
            )
            out = bench.tick((OTHER, encode(absurd)))
            if bench.state is not State.RUNNING:
                assert brakes(out)


def test_numbers_that_fail_are_a_fault_for_good():
    made = fleet()
    robots = tuple(replace(robot, mass_kg=1.7e308) for robot in made.robots)  # no file may say so
    bench = Bench(made=replace(made, robots=robots))
    bench.pose = Pose(50.0, 50.0, 0.3, 0.0, 0.0)
    assert brakes(bench.drive())  # the tick in which they fail brakes
    assert brakes(bench.tick())
    assert bench.state is State.FAULT  # the next says so
    assert bench.agent.reason.startswith("the law gave force")
    bench.pose = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    outs = bench.run(20)
    bench.mission(5)
    outs += bench.run(5)
    assert bench.state is State.FAULT
    assert all(map(brakes, outs))
    assert not any(out.hand.following for out in outs)
