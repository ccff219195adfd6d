"""Links under any rules: every message has one fate, whatever the order, and nothing ever breaks."""

from __future__ import annotations

from typing import Any

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.link_emulator import LinkEmulator
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import LOST, TOPICS, Faults, HandState
from handfast.agent.messages.validation import Malformed

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0 }, { id = 3, x_m = 3, y_m = 0 }]
fleet = { name = "three", seed = 11 }
formation = { edges = [[1, 2], [2, 3]], offsets = [[0, 0], [1, 0], [2, 0]], safe_distance_m = 0.2 }
"""
PERIOD = 20_000_000
EPOCH = 1000 * NS_PER_S
END = EPOCH + 10_000 * NS_PER_S
HAND = TOPICS.index("hand")

shares = st.sampled_from(["0%", "1%", "30%", "100%", "20% 50%"])
DRAWN: dict[str, st.SearchStrategy[Any]] = {
    "delay": st.sampled_from(
        ["0s", "15ms", "200ms", "80ms 20ms", "normal 80ms 60ms 25%", "pareto 20ms 30ms", "0ms..300ms"]
    ),
    "loss": st.sampled_from(
        ["0%", "30%", "30% 60%", "100%", "every 3", "gemodel 5% 20% 80% 1%", "state 2% 20% 5% 50% 1%"]
    ),
    "duplicate": shares,
    "corrupt": shares,
    "reorder": st.sampled_from(["10%", "50% 30%", "gap 4", "50% gap 3"]),
    "range": st.sampled_from(["disc 1m", "logdistance 1m retries 2 5ms", "disc 9m speed 340m/s"]),
}
QUEUES: dict[str, st.SearchStrategy[Any]] = {
    "rate": st.sampled_from(["10kbit", "1mbit", "10kbit limit 1", "1mbit limit 7"]),
}
PLACES = st.sampled_from([{}, {"link": "1->2"}, {"link": "*->2"}, {"robot": 1}, {"partition": "1 | 2,3"}])


def rules(effects: dict[str, st.SearchStrategy[Any]]) -> st.SearchStrategy[list[dict[str, Any]]]:
    when = st.sampled_from([{"for": 1.0}, {"at": 0.5, "for": 0.7}, {"for": 0.2, "every": 0.5, "until": 1.5}])
    one = st.builds(
        lambda where, what, at: {**where, **what, **at},
        PLACES,
        st.fixed_dictionaries({}, optional=effects).filter(bool),
        when,
    )
    return st.lists(one, min_size=1, max_size=3)


def fleet(drawn: list[dict[str, Any]]) -> Fleet:
    return parse_fleet(FLEET + tomli_w.dumps({"faults": {"rule": drawn}}), source="here")


def links(drawn: list[dict[str, Any]]) -> LinkEmulator:
    plan = FaultPlan(fleet(drawn))
    plan.begin(EPOCH)
    return LinkEmulator(plan, 2, {"hand": (1, 3)})


def message(number: int) -> HandState:
    return HandState(1, number, EPOCH + number * PERIOD, True, 1, 0.1 * (number % 20), *(0.0,) * 10, (), ())


def fates(to: LinkEmulator, order: list[int]) -> dict[int, list[tuple[int, int]]]:
    """(what, delay us) of each copy by number; nothing where a message came through at once."""
    found: dict[int, list[tuple[int, int]]] = {}
    arrived = 0
    for number in order:
        sent = message(number)
        if to.take("key", encode(sent), HAND, sent, (0.0, 0.0)):
            found[number] = []
    arrivals = to.due(END)
    times: dict[int, list[int]] = {}
    for trace in to.traced(END, flush=True):
        for _, _, number, time_ns, what, delay_us in trace.entries:
            found.setdefault(number, []).append((what, delay_us))
            if not what & LOST:
                arrived += 1
                times.setdefault(number, []).append(time_ns + delay_us * 1000)
    assert len(arrivals) == arrived
    assert to.idle or not to.due(END)
    for arrival in arrivals:
        if arrival.message is None:
            try:
                decode(arrival.payload)
            except Malformed:
                continue
            raise AssertionError("a flipped bit was not found")
    return found


@pytest.mark.slow
@given(rules(DRAWN), st.permutations(range(90)))
@settings(max_examples=120, deadline=None)
def test_every_message_has_one_fate_whatever_the_order(drawn: list[dict[str, Any]], order: list[int]) -> None:
    forward = fates(links(drawn), list(range(90)))
    assert set(forward) == set(range(90))
    assert all(len(copies) <= 2 for copies in forward.values())
    shuffled = fates(links(drawn), order)
    for number, copies in forward.items():
        # What was held is let go when somebody looks, here at the end.
        assert copies == shuffled[number]


@pytest.mark.slow
@given(rules(DRAWN | QUEUES))
@settings(max_examples=120, deadline=None)
def test_queues_lose_no_message_without_saying_so(drawn: list[dict[str, Any]]) -> None:
    found = fates(links(drawn), list(range(120)))
    assert set(found) == set(range(120))


@pytest.mark.slow
@given(rules(DRAWN | QUEUES), st.binary(max_size=30))
@settings(max_examples=80, deadline=None)
def test_whatever_operators_send_a_receiver_goes_on(drawn: list[dict[str, Any]], rubbish: bytes) -> None:
    plan = FaultPlan(parse_fleet(FLEET, source="here"))
    to = LinkEmulator(plan, 2, {"hand": (1, 3)})
    texts = [tomli_w.dumps({"faults": {"rule": drawn}}), rubbish.decode(errors="replace")]
    texts.append(texts[0][: len(texts[0]) // 2])
    for version, text in enumerate(texts, 1):
        plan.take(Faults(version, EPOCH, "ana", EPOCH, 10 * NS_PER_S, text), EPOCH)
        to.refresh()
        for number in range(30):
            sent = message(number)
            to.take("key", encode(sent), HAND, sent, (0.0, 0.0))
    to.due(END)
    to.traced(END, flush=True)
