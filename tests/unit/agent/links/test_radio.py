"""A radio of limited rate: what waits how long, what is dropped, what goes past the queue."""

from __future__ import annotations

from collections import Counter

import pytest

from agent.common.time import NS_PER_S
from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from agent.links.radio import AT_ONCE, DROPPED, Radio, RateQueue
from agent.links.wire_size import acknowledged_bytes, carried_bytes, joined_bytes
from agent.messages import key_expressions

NOW = 1000 * NS_PER_S
PERIOD = 100_000_000
HAND, BEACON, TOLD, WRENCH, STATUS = (
    make("four", 1)
    for make in (
        key_expressions.hand,
        key_expressions.beacon,
        key_expressions.relayed,
        key_expressions.wrench,
        key_expressions.status,
    )
)


def fleet(*more: str) -> Fleet:
    text = """
    fleet = { name = "four", rate_hz = 10 }
    formation = { edges = [[1, 2], [1, 3]], distance_m = 1, safe_distance_m = 0.2 }
    robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1, y_m = 0 }, { id = 3, x_m = 0, y_m = 1 },
             { id = 4, x_m = 1, y_m = 1 }]
    network = { budget = "80 kbit/s", emulate_budget = true }
    """
    return parse_fleet(text, source="here", overrides=more)


def radio(*more: str) -> Radio[str]:
    return Radio(fleet(*more), 1)


# --- a queue --------------------------------------------------------------------------------------


def test_a_message_leaves_after_those_before_it() -> None:
    queue = RateQueue(8e3, NS_PER_S, 1)  # a byte a millisecond
    assert queue.leaves_ns(NOW, 100) == NOW + 100_000_000
    assert queue.leaves_ns(NOW, 50) == NOW + 150_000_000
    assert queue.leaves_ns(NOW + 140_000_000, 10) == NOW + 160_000_000
    assert queue.leaves_ns(NOW + NS_PER_S, 10) == NOW + NS_PER_S + 10_000_000, (
        "an idle radio saves nothing up"
    )


def test_up_to_half_of_the_longest_wait_nothing_is_dropped_and_nothing_waits_longer() -> None:
    queue = RateQueue(8e3, NS_PER_S, 1)
    waits: list[tuple[int, bool]] = []
    free_ns = NOW
    for _ in range(2000):
        waits.append((free_ns - NOW, (left_ns := queue.leaves_ns(NOW, 1)) is None))
        free_ns = free_ns if left_ns is None else left_ns
    assert not any(dropped for wait, dropped in waits if wait <= NS_PER_S // 2)
    assert max(wait for wait, dropped in waits if not dropped) < NS_PER_S
    middle = [dropped for wait, dropped in waits if 0.7e9 < wait <= 0.8e9]
    assert 0.3 < sum(middle) / len(middle) < 0.7, "half way there half of them"


def test_in_a_steady_overload_no_message_of_a_round_is_starved() -> None:
    queue = RateQueue(8e3, NS_PER_S, 1)
    came: Counter[int] = Counter()
    for turn in range(1000):
        for which in range(10):  # twice what it carries
            came[which] += queue.leaves_ns(NOW + turn * PERIOD, 20) is not None
    assert sum(came.values()) == pytest.approx(5000, rel=0.02)
    assert min(came.values()) > 0.6 * max(came.values()), came


def test_what_waits_for_nobody_takes_its_time_all_the_same() -> None:
    queue = RateQueue(8e3, NS_PER_S, 1)
    for _ in range(5):
        queue.occupy(NOW, 1000)
    assert queue.leaves_ns(NOW, 10) is None, "the queue is full"
    assert queue.leaves_ns(NOW + 5 * NS_PER_S, 10) == NOW + 5 * NS_PER_S + 10_000_000


# --- what a robot says ----------------------------------------------------------------------------


def test_what_leaves_before_the_next_tick_leaves_at_once() -> None:
    said = [(WRENCH, b"w"), (HAND, bytes(200)), (STATUS, bytes(300)), (BEACON, bytes(100))]
    # 2 hand states and 3 beacons, 2 of these along with them: 7.6 kbit, in 95 ms at 80 kbit/s.
    assert radio().send(NOW, said, 2) == [said[0], said[2], said[1], said[3]]


def test_what_does_not_waits_in_its_order() -> None:
    slow = radio("network.budget=40000")
    first, second = (HAND, bytes(200)), (BEACON, bytes(100))
    # 2 x 264 bytes take 106 ms, more than a period; the beacon, 374 bytes, 75 ms more.
    assert slow.send(NOW, [(WRENCH, b""), first, second], 2) == [(WRENCH, b"")]
    assert slow.send(NOW + PERIOD, [(WRENCH, b"2")], 2) == [(WRENCH, b"2"), first, second]
    assert slow.send(NOW + 2 * PERIOD, [], 2) == []


def test_a_copy_for_every_listener_goes_up_in_a_mesh_and_one_to_a_router() -> None:
    def left_ns(*more: str) -> int:
        """When the radio is free again after a hand state and a beacon."""
        there = radio(*more)
        there.send(NOW, [(HAND, bytes(200)), (BEACON, bytes(100))], 2)
        return there._up.occupy(NOW, 0) - NOW

    byte_ns = 100_000
    mesh = 2 * carried_bytes(200, False) + carried_bytes(100, False) + 2 * joined_bytes(100)
    assert left_ns() == pytest.approx(mesh * byte_ns, abs=2)
    routed = carried_bytes(200, False) + joined_bytes(100)
    assert left_ns('network.topology="routed"') == pytest.approx(routed * byte_ns, abs=2)


def test_an_order_goes_past_the_queue_and_lengthens_it() -> None:
    slow = radio("network.budget=1000")
    orders = [(TOLD, bytes(60))] * 20
    assert slow.send(NOW, [(HAND, bytes(200)), *orders], 2) == orders
    assert slow.send(NOW + PERIOD, [(HAND, bytes(200)), orders[0]], 2) == [orders[0]]
    assert slow.counted() == {"radio.dropped.said": 1, "radio.dropped.heard": 0}


# --- what it hears --------------------------------------------------------------------------------


def test_what_comes_within_the_budget_is_taken_at_once() -> None:
    there = radio()
    for turn in range(50):
        for source in (2, 3, 4):  # 3 x 264 bytes take 79 ms of 100
            assert there.hear(NOW + turn * PERIOD, source, bytes(200), "hand") == AT_ONCE
        assert there.heard(NOW + turn * PERIOD) == []


def test_what_does_not_comes_when_it_has_been_received_in_its_order() -> None:
    there = radio("network.budget=40000")
    due = [there.hear(NOW, source, bytes(200), str(source)) for source in (2, 3, 4)]
    # Of each 52.8 ms; what came since the last tick may have come right after it.
    assert due == [AT_ONCE, NOW + 5_600_000, NOW + 58_400_000]
    assert there.heard(NOW) == []
    assert there.hear(NOW + PERIOD, 2, bytes(200), "next") == NOW + 58_400_000 + 52_800_000
    assert there.heard(NOW + PERIOD) == ["3", "4"]
    assert there.heard(NOW + 2 * PERIOD) == ["next"]


def test_what_is_received_in_time_does_not_overtake_what_has_waited() -> None:
    there = radio("network.budget=40000")
    assert there.hear(NOW, 2, bytes(200), "2") == AT_ONCE
    assert there.hear(NOW, 3, bytes(200), "3") > NOW
    assert there.heard(NOW) == []
    assert there.hear(NOW + PERIOD, 2, bytes(200), "next") == NOW + 58_400_000
    assert there.heard(NOW + PERIOD) == ["3", "next"]


def test_a_message_with_another_of_its_sender_has_no_headers_of_its_own() -> None:
    there = radio()
    there.hear(NOW, 2, bytes(200), "hand")
    there.hear(NOW, 2, bytes(100), "beacon")
    byte_ns = 100_000
    wanted = carried_bytes(200, False) + joined_bytes(100)
    assert there._down.occupy(0, 0) - (NOW - PERIOD) == pytest.approx(wanted * byte_ns, abs=2)
    there.heard(NOW)
    there.hear(NOW + PERIOD, 2, bytes(100), "beacon")
    assert there._down.occupy(0, 0) - NOW == pytest.approx(carried_bytes(100, False) * byte_ns, abs=2)


def test_what_is_acknowledged_goes_the_other_way() -> None:
    there = radio()
    there.hear(NOW + PERIOD, 2, bytes(200), "hand")
    assert there._up.occupy(0, 0) - NOW == pytest.approx(acknowledged_bytes(200, False) * 100_000, abs=2)
    there.send(NOW + PERIOD, [(HAND, bytes(200))], 2)
    wanted = 2 * acknowledged_bytes(200, False) * 100_000
    assert there._down.occupy(0, 0) - (NOW + PERIOD) == pytest.approx(wanted, abs=2)


def test_orders_that_are_heard_keep_others_waiting() -> None:
    there = radio()
    there.hear_order(NOW, 2, bytes(1000))
    assert there.hear(NOW, 3, bytes(200), "hand") > NOW
    assert there.heard(NOW + PERIOD) == ["hand"]


def test_what_is_dropped_is_counted() -> None:
    there = radio("network.budget=1000", "network.budget_queue_s=0.5")
    fates = [there.hear(NOW, 2, bytes(200), "hand") for _ in range(10)]
    assert fates[0] > NOW
    assert set(fates[1:]) == {DROPPED}
    assert there.counted()["radio.dropped.heard"] == 9
