"""Links that fail: what becomes of each message, when it comes, and what is said about it."""

from __future__ import annotations

from itertools import pairwise

import pytest

from handfast.agent.common import random_streams
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.link_emulator import LinkEmulator
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import (
    CORRUPTED,
    DUPLICATED,
    LOST,
    OVERFLOW,
    RANGE,
    REORDERED,
    TOPICS,
    TRACE_MAX,
    HandState,
    LinkTrace,
)
from handfast.agent.messages.validation import Malformed

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0 }, { id = 3, x_m = 3, y_m = 0 }]
fleet = { name = "three", seed = 11 }
formation = { edges = [[1, 2], [2, 3]], offsets = [[0, 0], [1, 0], [2, 0]], safe_distance_m = 0.2 }
"""
PERIOD = 20_000_000
EPOCH = 1000 * NS_PER_S
HAND = TOPICS.index("hand")
MS = 1_000_000


def fleet(faults: str = "", *overrides: str) -> Fleet:
    return parse_fleet(FLEET + faults, source="here", overrides=overrides)


def links(faults: str = "", *overrides: str, begun: bool = True) -> LinkEmulator:
    """The links to robot 2."""
    plan = FaultPlan(fleet(faults, *overrides))
    if begun:
        plan.begin(EPOCH)
    return LinkEmulator(plan, 2, {"hand": (1, 3), "state": (2,)})


def message(number: int, robot: int = 1, x: float = 0.0) -> HandState:
    return HandState(robot, number, EPOCH + number * PERIOD, True, 1, x, *(0.0,) * 10, (), ())


def send(to: LinkEmulator, sent: HandState, own: tuple[float, float] | None = None) -> bool:
    return to.take(f"three/robot/{sent.robot}/hand", encode(sent), HAND, sent, own)


def entries(to: LinkEmulator) -> list[tuple[int, ...]]:
    traces = to.traced(EPOCH) + to.traced(EPOCH + 10_000 * NS_PER_S)
    assert all(type(decode(encode(trace))) is LinkTrace for trace in traces)
    return [entry for trace in traces for entry in trace.entries]


def fates(
    to: LinkEmulator, numbers: range, robot: int = 1, *, arriving: bool = False
) -> dict[int, list[tuple[int, int]]]:
    """(what, delay in us) of each copy of each message, by its number."""
    for number in numbers:
        assert not send(to, message(number, robot))
        if arriving:
            to.due(EPOCH + number * PERIOD)
    found: dict[int, list[tuple[int, int]]] = {}
    for source, _, number, _, what, delay_us in entries(to):
        if source == robot:
            found.setdefault(number, []).append((what, delay_us))
    return found


# --- nothing to do ----------------------------------------------------------------------------


def test_without_faults_nothing_befalls_a_message() -> None:
    to = links()
    assert to.idle
    assert send(to, message(0))
    assert to.due(EPOCH) == []
    assert entries(to) == []


def test_only_the_link_of_a_rule_is_touched() -> None:
    to = links('[[faults.rule]]\nlink = "1->2"\nloss = "100%"\n')
    assert not to.idle
    assert not send(to, message(0, robot=1))
    assert send(to, message(0, robot=3))
    assert [entry[:5] for entry in entries(to)] == [(1, HAND, 0, EPOCH, LOST)]


@pytest.mark.parametrize(
    "faults",
    [
        "",
        'loss = "10%"',
        '[[faults.rule]]\nlink = "1->2"\nloss = "10%"',
        '[[faults.rule]]\nlink = "1->2"\ntopic = "all"\ndelay = "20ms"',
        '[[faults.rule]]\nrobot = 2\ntopic = "all"\nloss = "10%"',
        "[[faults.rule]]\nrobot = 1\njump_m = 0.1",
    ],
)
def test_only_links_with_rules_are_made(faults: str) -> None:
    """Of a large fleet each agent has hundreds, and a live rule comes to all of them at once."""
    plan = FaultPlan(fleet(f"[faults]\n{faults}"))
    sources = {"hand": [1, 3], "beacon": [1, 3], "wrench": [2], "state": [2]}
    made = LinkEmulator(plan, 2, sources)
    ruled = {
        (topic, source)
        for topic, robots in sources.items()
        for source in robots
        if not plan.rules_of_link(source, 2, topic).idle
    }
    assert {(TOPICS[topic], source) for topic, source in made._links} == ruled
    assert {
        (topic, source)
        for topic, robots in sources.items()
        for source in robots
        if plan.is_ruled(source, 2, topic)
    } == ruled


def test_defaults_are_for_links_between_agents_alone() -> None:
    to = links("", "faults.loss=100%")
    state = message(0, robot=2)
    assert to.take("key", encode(state), TOPICS.index("state"), state)
    assert not send(to, message(0, robot=3))


# --- delay ------------------------------------------------------------------------------------


def test_a_delayed_message_comes_when_its_time_has_come() -> None:
    to = links("", "faults.delay=50ms")
    sent = message(0)
    assert not send(to, sent)
    assert to.due(EPOCH + 50 * MS - 1) == []
    (arrival,) = to.due(EPOCH + 50 * MS)
    assert arrival.message is sent
    assert arrival.key == "three/robot/1/hand"
    assert to.due(EPOCH + 60 * MS) == []


def test_a_delay_counts_from_the_stamp_whenever_the_message_really_came() -> None:
    to = links("", "faults.delay=50ms")
    send(to, message(0))
    late = message(1)
    to.due(EPOCH + 500 * MS)
    send(to, late)
    assert [arrival.message for arrival in to.due(EPOCH + 500 * MS)] == [late]


def test_ten_thousand_waiting_messages_come_in_the_order_of_their_times_and_no_more_wait() -> None:
    to = links("", "faults.delay=normal 100s 10s")
    for number in range(12_000):
        send(to, message(number))
    found = entries(to)
    lost = [entry for entry in found if entry[4] & OVERFLOW]
    assert len(found) == 12_000
    assert len(lost) == 2_000
    assert all(entry[4] == LOST | OVERFLOW and entry[5] == -1 for entry in lost)
    due = {entry[2]: entry[3] + entry[5] * 1000 for entry in found if not entry[4] & LOST}
    arrivals = to.due(EPOCH + 10_000 * NS_PER_S)
    times = [due[arrival.message.sequence] for arrival in arrivals if arrival.message is not None]
    assert len(times) == 10_000
    assert all(earlier <= later + 1000 for earlier, later in pairwise(times))
    assert times != sorted(due)  # the jitter did change the order of sending


def test_a_ramp_grows_over_its_time() -> None:
    to = links('[[faults.rule]]\nat = 0\nfor = 2\ndelay = "0ms..500ms"\n')
    found = fates(to, range(100))
    delays = [found[number][0][1] for number in range(100)]
    assert delays == [pytest.approx(5000 * number, abs=1) for number in range(100)]


# --- loss and the rest ------------------------------------------------------------------------


def test_what_is_lost_is_a_function_of_the_seed_the_link_and_the_number() -> None:
    found = fates(links("", "faults.loss=30%"), range(2000))
    lost = {number for number, copies in found.items() if copies[0][0] & LOST}
    stream = random_streams.stream(11, "link", 1, 2, "hand", "loss")
    assert lost == {number for number in range(2000) if random_streams.uniform(stream, 4 * number) < 0.3}


def test_a_duplicate_comes_as_well_with_a_delay_of_its_own() -> None:
    to = links("", "faults.duplicate=100%", "faults.delay=uniform 100ms 50ms")
    found = fates(to, range(50))
    assert all([what for what, _ in copies] == [0, DUPLICATED] for copies in found.values())
    assert sum(first == second for (_, first), (_, second) in found.values()) < 3
    assert len(to.due(EPOCH + 100 * NS_PER_S)) == 100


def test_a_corrupted_message_is_found_by_the_codec() -> None:
    to = links("", "faults.corrupt=100%")
    found = fates(to, range(200))
    assert all(copies == [(CORRUPTED, 0)] for copies in found.values())
    for arrival in to.due(EPOCH + 100 * NS_PER_S):
        assert arrival.message is None
        with pytest.raises(Malformed):
            decode(arrival.payload)


def test_chosen_messages_overtake() -> None:
    to = links("", "faults.delay=100ms", "faults.reorder=25%")
    found = fates(to, range(400))
    overtaking = [number for number, copies in found.items() if copies[0][0] & REORDERED]
    assert 60 < len(overtaking) < 140
    assert all(copies[0] in ((0, 100_000), (REORDERED, 0)) for copies in found.values())


def test_a_limited_rate_makes_messages_queue() -> None:
    size = len(encode(message(0)))
    to = links("", f"faults.rate={8 * size * 25}bit limit 10")  # half of what is sent
    found = fates(to, range(60), arriving=True)
    first = [found[number][0][1] for number in range(8)]
    assert first == [pytest.approx(40_000 + 20_000 * number, rel=0.02) for number in range(8)]
    late = [copies[0] for number, copies in found.items() if number > 30]
    assert 0.35 < sum(what & OVERFLOW > 0 for what, _ in late) / len(late) < 0.65
    assert max(delay for _, delay in late) < 11 * 41_000


def test_out_of_range_is_out_of_hearing() -> None:
    to = links("", "faults.range=disc 5m")
    send(to, message(0, x=4.9), (0.0, 0.0))
    send(to, message(1, x=5.1), (0.0, 0.0))
    send(to, message(2, x=99.0), None)
    assert [entry[4] for entry in entries(to)] == [0, LOST | RANGE, 0]


# --- independence -----------------------------------------------------------------------------


def test_messages_in_any_order_have_the_same_fate() -> None:
    settings = ("faults.loss=gemodel 5% 20%", "faults.delay=normal 80ms 20ms 50%", "faults.duplicate=5% 20%")
    forward = fates(links("", *settings), range(300))
    backward = links("", *settings)
    for number in reversed(range(300)):
        send(backward, message(number))
    found: dict[int, list[tuple[int, int]]] = {}
    for _, _, number, _, what, delay_us in entries(backward):
        found.setdefault(number, []).append((what, delay_us))
    assert found == forward


def test_seed_and_link_make_a_difference() -> None:
    def lost(robot: int = 1, *overrides: str) -> set[int]:
        found = fates(links("", "faults.loss=30%", *overrides), range(300), robot)
        return {number for number, copies in found.items() if copies[0][0] & LOST}

    assert lost() != lost(3)
    assert lost() != lost(1, "faults.seed=12")
    assert lost() == lost(1, "fleet.seed=5", "faults.seed=11")


# --- when -------------------------------------------------------------------------------------


def when(rule: str, *, begun: bool = True) -> list[float]:
    """Times (s) at which messages of 10 s are lost."""
    to = links(f'[[faults.rule]]\nlink = "1->2"\nloss = "100%"\n{rule}', begun=begun)
    return [number / 50 for number in range(500) if not send(to, message(number))]


def test_a_rule_holds_from_its_start_up_to_its_end() -> None:
    times = when("at = 2\nfor = 3\n")
    assert times[0] == 2.0
    assert times[-1] == 4.98
    assert len(times) == 150
    assert when("at = 2\nfor = 3\n", begun=False) == []


def test_for_each_effect_the_first_rule_wins() -> None:
    to = links(
        "[faults]\ndelay = 0.1\nduplicate = 1\n"
        '[[faults.rule]]\nname = "a"\nlink = "1->2"\nat = 1\ndelay = 0.2\n'
        '[[faults.rule]]\nname = "b"\nlink = "*->2"\ndelay = 0.3\nloss = 0\n'
    )
    found = fates(to, range(100))
    assert found[10] == [(0, 300_000), (DUPLICATED, 300_000)]
    assert found[60] == [(0, 200_000), (DUPLICATED, 200_000)]
    assert fates(to, range(100), robot=3)[60][0] == (0, 300_000)


def test_an_injected_clock_error_changes_no_delay() -> None:
    clocks = (
        '[[faults.rule]]\nrobot = 1\nclock_skew = "100ms"\n[[faults.rule]]\nrobot = 2\nclock_skew = "-1s"\n'
    )
    to = links(clocks, "faults.delay=50ms")
    sent = message(0)  # stamped 0 by a clock that is 1.1 s ahead of the receiver's
    send(to, sent)
    assert to.due(EPOCH - 1100 * MS + 49 * MS) == []
    assert len(to.due(EPOCH - 1100 * MS + 50 * MS)) == 1
    assert [entry[4:] for entry in entries(to)] == [(0, 50_000)]


# --- what is said -----------------------------------------------------------------------------


def test_the_trace_comes_in_portions_and_in_time() -> None:
    to = links("", "faults.loss=50%")
    send(to, message(0))
    assert to.traced(EPOCH) == []
    (trace,) = to.traced(EPOCH + NS_PER_S // 5)
    assert (trace.robot, trace.sequence, trace.time_ns) == (2, 0, EPOCH + NS_PER_S // 5)
    for number in range(1, 301):
        send(to, message(number))
    portions = to.traced(EPOCH + NS_PER_S)
    assert [len(portion.entries) for portion in portions] == [TRACE_MAX, TRACE_MAX, 300 - 2 * TRACE_MAX]
    assert [portion.sequence for portion in portions] == [1, 2, 3]


def test_links_are_idle_again_when_all_is_over() -> None:
    to = links('[[faults.rule]]\nlink = "1->2"\ndelay = "1s"\n')
    send(to, message(0))
    to.plan._timed = ()
    to.plan.changes += 1
    to.refresh()
    assert not to.idle  # a message waits still
    assert len(to.due(EPOCH + NS_PER_S)) == 1
    assert len(entries(to)) == 1
    assert to.idle
