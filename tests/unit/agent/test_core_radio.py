"""An agent whose radio carries little: what is its own business is not touched, and an order is not kept."""

from __future__ import annotations

from agent.messages.types import HandState, Stop
from agent.supervision.state_machine import State
from tests.unit.agent.agent_bench import HAND, OTHER, OTHERS_TOLD, PERIOD, WRENCH, Bench

LITTLE = ("network.budget=45000", "network.emulate_budget=true")  # a hand state takes two periods


def test_its_wrench_comes_first_in_every_tick_and_its_hand_states_late() -> None:
    bench = Bench(*LITTLE)
    bench.drive()
    ages = []
    for _ in range(100):
        out = bench.tick()
        assert out.raw[0][0] == WRENCH
        assert out.wrench.time_ns == bench.now - PERIOD
        if out.hand is not None:
            ages.append(bench.now - PERIOD - out.hand.time_ns)
    assert 30 < len(ages) < 70
    assert all(PERIOD < age < 0.7e9 for age in ages)
    assert bench.last is not None
    counters = dict(bench.last.counters)
    assert counters["radio.dropped.said"] > 10
    assert bench.last.time_ns > bench.now - 0.3e9, "it tells the operator all the same"


def test_one_with_a_radio_that_carries_all_says_what_one_without_says() -> None:
    plain, ample = Bench(), Bench("network.budget=1000000", "network.emulate_budget=true")
    for bench in (plain, ample):
        bench.drive()
    for _ in range(60):
        one, other = plain.tick(), ample.tick()
        assert (one.hand, one.beacon, one.wrench) == (other.hand, other.beacon, other.wrench)
    assert plain.last is not None
    assert ample.last is not None
    assert not any("radio" in name for name, _ in plain.last.counters)
    assert dict(ample.last.counters)["radio.dropped.heard"] == 0


def test_a_stop_that_another_relays_is_obeyed_at_once_and_relayed_at_once() -> None:
    bench = Bench(*LITTLE)
    bench.drive()
    bench.run(60)
    bench.give(OTHERS_TOLD, Stop(7, bench.now, "enough"))
    out = bench.tick()
    assert bench.state in (State.STOPPING, State.STOPPED)
    assert [type(order) for order in out.told] == [Stop]


def test_a_late_hand_state_of_its_neighbour_is_taken_when_it_has_come() -> None:
    bench = Bench(*LITTLE)
    bench.drive()
    bench.other = None
    bench.run(30)
    bench.give(OTHER, HandState.placed(2, 5000, bench.now - PERIOD, True, 1, (1.5, 0.2, 0.0, 0.0)))
    (out, *rest) = bench.run(15)
    statuses = [each.status for each in (out, *rest) if each.status is not None]
    (neighbour,) = statuses[-1].neighbours
    assert neighbour.age_us < 0.4e6, "it was heard again"
    assert HAND in {key for each in rest for key, _ in each.raw}
