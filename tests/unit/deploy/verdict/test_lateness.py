"""What injected faults explain of how late an agent was, and what they do not."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest

from handfast.agent.fleet.fault_rules import FaultsSection, Rule
from handfast.agent.messages.types import Status
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.lateness import Late, Made, made_late, unexplained
from tests.unit.deploy.judged_run import PAIR, recorded
from tests.unit.deploy.silent_run import ALL, FROM_S, UNTIL_S, paused, silent
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, messages

PERIOD_S = PAIR.period_ns / 1e9


def counting(**per_s: float) -> Recording:
    """A run in which agents count so much more each second."""
    sent = []
    for received_ns, key, message in messages(PAIR, in_formation(PAIR)):
        if type(message) is Status:
            t = (message.time_ns - EPOCH_NS) / 1e9
            names = {name.replace("__", "."): round(each * t) for name, each in per_s.items()}
            message = message._replace(counters=tuple(names.items()))
        sent.append((received_ns, key, message))
    return recorded(PAIR, sent, "run")


def test_all_is_its_own_where_nothing_was_done_to_it() -> None:
    recording = counting(overruns=10, overload__asked_ms=500)
    last_s = float(recording.robots[1].status.t[-1])
    found = unexplained(recording, 1, ())
    assert found == pytest.approx((10 * last_s, 500 * last_s), abs=1)


def test_a_rule_explains_what_it_can_have_caused_and_no_more() -> None:
    recording = counting(overruns=20)
    all_of_it = unexplained(recording, 1, ()).skipped
    made = Made(0.0, 0.5, late_s=2 * PERIOD_S, share=0.1)
    assert made.skips(PERIOD_S) == pytest.approx(0.1 * 0.5 / PERIOD_S * 2)
    assert unexplained(recording, 1, [made]).skipped == all_of_it - 5
    assert unexplained(recording, 1, [Made(0.0, 0.5, late_s=0.9 * PERIOD_S)]).skipped == all_of_it
    assert unexplained(recording, 1, [Made(0.0, 0.5)]).skipped == 0, "it wakes for 3 s"
    assert unexplained(recording, 1, [Made(50.0, 51.0)]).skipped == all_of_it


def test_a_lower_rate_is_explained_until_it_is_not_asked_for_any_more() -> None:
    recording = counting(overload__asked_ms=900)
    assert unexplained(recording, 1, [Made(-5.0, -2.9)]) == Late(0, 0)
    assert unexplained(recording, 1, [Made(-5.0, -2.9, late_s=0.5 * PERIOD_S)]).asked_ms > 0


@pytest.mark.parametrize(
    ("made", "stands"),
    [
        (Made(1.0, 2.0), True),
        (Made(0.0, 1.0), False),
        (Made(2.0, 3.0), False),
        (Made(1.0, 2.0, late_s=0.5), True),
        (Made(1.0, 2.0, late_s=0.4), False),
    ],
)
def test_who_is_made_late_stands_for_two_late_ticks_at_most(made: Made, stands: bool) -> None:
    assert made.makes_stand(1.0, 2.0) is stands


def test_rules_make_their_own_robots_late_while_they_hold() -> None:
    rules = (
        Rule(tick_jitter=0.01, tick_jitter_share=0.2, robot=(1,), at=0.5, duration=0.4),
        Rule(delay=0.1),
    )
    recording = replace(silent(ALL, ()), events=paused(2, "agent"))
    recording = replace(recording, fleet=replace(recording.fleet, faults=FaultsSection(rules=rules)))
    assert made_late(recording, 1) == [Made(0.5, 0.9, 0.01, 0.2)]
    assert made_late(recording, 2) == [Made(pytest.approx(FROM_S), pytest.approx(UNTIL_S), inf)]
