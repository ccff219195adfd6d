"""Budgets: known sources have their own, unknown ones share, and who failed waits."""

from __future__ import annotations

from agent.admission.budgets import (
    AGAIN_PER_S,
    BACKOFF_MAX_S,
    BACKOFF_S,
    FIRST_PER_S,
    KNOWN_BURST,
    PROVEN_MAX,
    SOURCES_MAX,
    WAITING_MAX,
    WAITING_OF_ONE_MAX,
    Budgets,
    Outcome,
    Refused,
    Ticket,
    unknown_source,
)

HOST, OTHER = "10.0.0.1", "10.0.0.2"


def let_through(budgets: Budgets, address: str, now_s: float) -> Ticket | Refused:
    """A connection that begins its handshake at once."""
    ticket = budgets.opened(address, now_s)
    if isinstance(ticket, Refused):
        return ticket
    why = budgets.begun(ticket, now_s)
    if why is None:
        return ticket
    budgets.ended(ticket, Outcome.NOBODY, now_s)
    return why


def fails(budgets: Budgets, address: str, now_s: float) -> Refused | None:
    """One that fails at once; why it was not let through, if it was not."""
    ticket = let_through(budgets, address, now_s)
    if isinstance(ticket, Refused):
        return ticket
    budgets.ended(ticket, Outcome.FAILED, now_s)
    return None


def proves(budgets: Budgets, address: str, now_s: float = 0.0) -> None:
    ticket = let_through(budgets, address, now_s)
    assert isinstance(ticket, Ticket)
    budgets.ended(ticket, Outcome.PROVEN, now_s)


def stranger(number: int) -> str:
    return f"192.168.{number // 256}.{number % 256}"


def test_all_that_nobody_knows_share_one_budget():
    budgets = Budgets()
    said = [fails(budgets, stranger(number), 10.0) for number in range(50)]
    assert said.count(None) == FIRST_PER_S
    assert set(said[int(FIRST_PER_S) :]) == {Refused.BUDGET}
    assert fails(budgets, stranger(99), 10.0 + 1.01 / FIRST_PER_S) is None


def test_who_failed_takes_nothing_from_who_comes_for_the_first_time():
    budgets = Budgets()
    for number in range(10):
        assert fails(budgets, stranger(number), float(number)) is None
    said = [fails(budgets, stranger(number), 100.0) for number in range(10)]
    assert said.count(None) == AGAIN_PER_S
    assert fails(budgets, OTHER, 100.0) is None


def test_a_host_of_the_fleet_does_not_suffer_from_strangers():
    budgets = Budgets()
    budgets.hosts = {HOST}
    for number in range(1000):
        fails(budgets, stranger(number), 0.0)
    for _ in range(1000):
        proves(budgets, HOST)


def test_who_has_proven_himself_is_known_from_then_on():
    budgets = Budgets()
    proves(budgets, OTHER)
    assert budgets.is_known(OTHER)
    assert budgets.proven == (OTHER,)
    for number in range(1000):
        fails(budgets, stranger(number), 0.0)
    proves(budgets, OTHER)
    again = Budgets(budgets.proven)
    assert again.is_known(OTHER)


def test_the_budget_of_a_known_one_is_spent_by_failures_alone():
    budgets = Budgets([HOST])
    assert [fails(budgets, HOST, 0.0) for _ in range(int(KNOWN_BURST))] == [None] * int(KNOWN_BURST)
    assert fails(budgets, HOST, 0.0) is Refused.BUDGET
    assert fails(budgets, HOST, 1.0) is None


def test_who_failed_waits_longer_each_time():
    budgets = Budgets()
    now_s, wait_s = 100.0, BACKOFF_S
    for _ in range(10):
        assert fails(budgets, OTHER, now_s) is None
        assert let_through(budgets, OTHER, now_s + 0.99 * wait_s) is Refused.BACKOFF
        now_s += wait_s
        wait_s = min(BACKOFF_MAX_S, 2.0 * wait_s)
    assert wait_s == BACKOFF_MAX_S
    proves(budgets, OTHER, now_s)
    assert fails(budgets, OTHER, now_s) is None  # it is known now, and begins anew


def test_nobody_to_answer_is_nobodys_fault():
    budgets = Budgets()
    for _ in range(100):
        ticket = let_through(budgets, OTHER, 0.0)
        assert isinstance(ticket, Ticket)
        budgets.ended(ticket, Outcome.NOBODY, 0.0)


def test_those_that_say_nothing_are_few():
    budgets = Budgets()
    assert [isinstance(budgets.opened(OTHER, 0.0), Ticket) for _ in range(WAITING_OF_ONE_MAX + 2)].count(
        True
    ) == WAITING_OF_ONE_MAX
    tickets = [budgets.opened(stranger(number), 0.0) for number in range(2 * WAITING_MAX)]
    there = [ticket for ticket in tickets if isinstance(ticket, Ticket)]
    assert len(there) == WAITING_MAX - WAITING_OF_ONE_MAX
    budgets.ended(there[0], Outcome.FAILED, 0.0)
    assert isinstance(budgets.opened("10.9.9.9", 0.0), Ticket)
    budgets.hosts = {HOST}
    assert isinstance(budgets.opened(HOST, 0.0), Ticket)


def test_what_is_remembered_is_bounded():
    budgets = Budgets(stranger(number) for number in range(2 * PROVEN_MAX))
    assert budgets.proven == tuple(stranger(number) for number in range(PROVEN_MAX, 2 * PROVEN_MAX))
    for number in range(SOURCES_MAX + 100):
        budgets.opened(stranger(number), 0.0)
    assert len(budgets._sources) == SOURCES_MAX


def test_unknown_sources_are_told_apart_by_what_they_cannot_choose():
    assert unknown_source("192.168.1.2") == unknown_source("::ffff:192.168.1.2") == "192.168.1.2"
    assert unknown_source("2001:db8:1:2:3::4") == unknown_source("2001:db8:1:2::") == "2001:db8:1:2::"
    assert unknown_source("2001:db8:1:3::4") != unknown_source("2001:db8:1:2::4")
    assert unknown_source("fe80::1%eth0") == "fe80::"
    assert unknown_source("x") == "x"


def test_a_known_ipv6_address_is_known_as_a_whole():
    budgets = Budgets()
    budgets.hosts = {"2001:db8::1"}
    assert budgets.is_known("2001:db8::1")
    assert not budgets.is_known("2001:db8::2")
