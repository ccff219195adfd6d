"""Whatever strangers do, what they spend is bounded, and who is known is let through."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from agent.admission.budgets import (
    AGAIN_PER_S,
    FIRST_PER_S,
    KNOWN_BURST,
    WAITING_MAX,
    Budgets,
    Outcome,
    Refused,
    Ticket,
)

HOST = "10.0.0.1"
STRANGERS = 300
STEPS = st.lists(
    st.tuples(
        st.floats(0.0, 2.0),
        st.integers(0, STRANGERS - 1),
        st.sampled_from(("fail", "fail", "fail", "wait", "nobody", "end a waiting one")),
    ),
    max_size=200,
)


@given(STEPS)
def test_strangers_spend_no_more_than_their_budget_and_nothing_of_a_hosts(
    steps: list[tuple[float, int, str]],
) -> None:
    budgets = Budgets()
    budgets.hosts = {HOST}
    now_s, failed = 0.0, 0
    waiting: list[Ticket] = []
    for pause_s, number, what in steps:
        now_s += pause_s / 20.0
        if what == "end a waiting one":
            if waiting:
                failed += waiting[0].charged is not None
                budgets.ended(waiting.pop(0), Outcome.FAILED, now_s)
            continue
        ticket = budgets.opened(f"192.168.{number // 250}.{number % 250}", now_s)
        if isinstance(ticket, Ticket):
            if what == "wait":
                waiting.append(ticket)
            elif budgets.begun(ticket, now_s) is not None:
                budgets.ended(ticket, Outcome.NOBODY, now_s)
            else:
                failed += what == "fail"
                budgets.ended(ticket, Outcome.FAILED if what == "fail" else Outcome.NOBODY, now_s)
        assert len(waiting) <= WAITING_MAX
        assert failed <= (FIRST_PER_S + AGAIN_PER_S) * (now_s + 1.0) + 1e-6
        tickets = [budgets.opened(HOST, now_s) for _ in range(int(KNOWN_BURST))]
        for each in tickets:
            assert isinstance(each, Ticket)
            assert budgets.begun(each, now_s) is None
            budgets.ended(each, Outcome.PROVEN, now_s)


@given(st.integers(1, 30), st.floats(0.0, 1.0), st.sampled_from((1, 4)))
def test_who_comes_for_the_first_time_gets_in_soon(sources: int, phase_s: float, times: int) -> None:
    """While others try again and again and always fail: once each of these had its first turn."""
    budgets, now_s, step_s = Budgets(), phase_s, 0.25
    comes_s = sources / FIRST_PER_S
    for _ in range(int(comes_s / step_s) + 20):
        for number in list(range(sources)) * times:
            ticket = budgets.opened(f"192.168.0.{number}", now_s)
            if isinstance(ticket, Ticket):
                refused = budgets.begun(ticket, now_s)
                budgets.ended(ticket, Outcome.NOBODY if refused else Outcome.FAILED, now_s)
        if now_s - phase_s >= comes_s:
            mine = budgets.opened("10.1.1.1", now_s)
            assert not isinstance(mine, Refused)  # it has never failed
            assert budgets.begun(mine, now_s) is None or now_s - phase_s < comes_s + 1.0
            budgets.ended(mine, Outcome.NOBODY, now_s)
        now_s += step_s
