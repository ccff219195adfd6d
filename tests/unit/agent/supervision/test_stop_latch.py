"""Stop, and leave to drive again: what is left of any messages in any order."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.messages.types import Resume, Stop
from handfast.agent.supervision.orders import StopLatch

ROBOT = 1


class Owner:
    """Counts the leaves that it is given."""

    def __init__(self) -> None:
        self.leaves = 0
        self.latch = StopLatch(ROBOT, self.grant)

    def grant(self) -> None:
        self.leaves += 1

    def take(self, *orders: Stop | Resume) -> list[str | None]:
        return [
            self.latch.accept_stop(each) if isinstance(each, Stop) else self.latch.accept_resume(each)
            for each in orders
        ]


def stop(version: int, reason: str = "") -> Stop:
    return Stop(version, 0, reason)


def resume(version: int, *robots: int) -> Resume:
    return Resume(version, 0, robots)


def test_before_any_order():
    latch = Owner().latch
    assert (latch.stopped, latch.version, latch.latest) == ("", 0, ())


def test_a_stop_holds_until_a_later_leave():
    owner = Owner()
    assert owner.take(stop(0, "somebody in the way")) == [None]  # of version 0, too
    assert owner.latch.stopped == "stop: somebody in the way"
    assert owner.take(resume(1)) == [None]
    assert owner.latch.stopped == ""
    assert owner.take(stop(2)) == [None]
    assert owner.latch.stopped == "stop"
    assert owner.latch.version == 2


def test_of_equal_versions_the_stop_holds():
    for orders in ([stop(5), resume(5)], [resume(5), stop(5)]):
        owner = Owner()
        owner.take(*orders)
        assert owner.latch.stopped


def test_what_is_said_again_is_no_new_order_and_what_is_older_is_refused():
    owner = Owner()
    assert owner.take(stop(3), resume(4)) == [None, None]
    assert owner.take(stop(3), resume(4)) == [None, None]
    assert owner.take(stop(2), resume(3)) == ["out_of_order", "out_of_order"]
    assert owner.leaves == 1
    assert owner.latch.latest == (stop(3), resume(4))


def test_leave_for_others_is_none_for_this_one():
    owner = Owner()
    owner.take(stop(3), resume(4, 2, 7))
    assert owner.latch.stopped
    assert owner.leaves == 0
    assert owner.latch.version == 4  # it is known all the same, and said again
    owner.take(resume(5, 2, ROBOT))
    assert not owner.latch.stopped
    assert owner.leaves == 1


@pytest.mark.parametrize("own", [resume(4), resume(4, ROBOT)])
@pytest.mark.parametrize("others", [4, 5])
def test_a_later_leave_for_others_takes_nothing_away(own: Resume, others: int):
    for orders in ([own, resume(others, 2)], [resume(others, 2), own]):
        owner = Owner()
        owner.take(stop(3), *orders)
        assert not owner.latch.stopped, orders
        assert owner.leaves == 1


VERSIONS = st.integers(0, 6)
STOPS = st.builds(stop, VERSIONS)
GENERAL = st.builds(resume, VERSIONS)
ANY = st.builds(Resume, VERSIONS, st.just(0), st.sampled_from([(), (1,), (2,), (1, 2)]))


@given(st.lists(STOPS | GENERAL, max_size=10), st.data())
def test_only_versions_decide_not_the_order_nor_how_often(orders: list[Stop | Resume], data: st.DataObject):
    one, other = Owner(), Owner()
    one.take(*orders)
    other.take(*data.draw(st.permutations(orders + orders[::2]), label="order"))
    assert other.latch.stopped == one.latch.stopped
    assert other.latch.version == one.latch.version
    assert set(other.latch.latest) == set(one.latch.latest)
    stops = [each.version for each in orders if isinstance(each, Stop)]
    leaves = [each.version for each in orders if isinstance(each, Resume)]
    assert bool(one.latch.stopped) == (bool(stops) and max(stops) >= max(leaves, default=-1))


@given(st.lists(STOPS | ANY, max_size=10), st.data())
def test_with_leaves_for_some_the_own_greatest_decides(orders: list[Stop | Resume], data: st.DataObject):
    owner = Owner()
    owner.take(*data.draw(st.permutations(orders), label="order"))
    stops = [each.version for each in orders if isinstance(each, Stop)]
    own = [e.version for e in orders if isinstance(e, Resume) and (not e.robots or ROBOT in e.robots)]
    assert bool(owner.latch.stopped) == (bool(stops) and max(stops) >= max(own, default=-1))
    assert owner.latch.version == max((each.version for each in orders), default=0)
    assert owner.leaves <= len(set(own))


@given(st.lists(STOPS | GENERAL, max_size=10))
def test_who_is_told_the_latest_knows_as_much_as_who_heard_all(orders: list[Stop | Resume]):
    """What a robot says again is enough for one that has just started."""
    heard_all, started = Owner(), Owner()
    heard_all.take(*orders)
    started.take(*heard_all.latch.latest)
    assert started.latch.stopped == heard_all.latch.stopped
    assert started.latch.version == heard_all.latch.version


def test_what_is_recalled_holds_as_before_and_gives_nothing_back_again():
    before = Owner()
    before.take(stop(3), resume(5), resume(7, 2), stop(6))
    after = Owner()
    for order in before.latch.lasting:
        after.latch.recall(order)
    assert after.leaves == 0
    assert (after.latch.stopped, after.latch.mark) == (before.latch.stopped, before.latch.mark)
    assert after.latch.lasting == before.latch.lasting == (stop(6), resume(7, 2), resume(5))
    assert after.take(resume(5)) == ["out_of_order"]  # relayed again
    assert after.leaves == 0
    after.take(resume(8))
    assert (after.latch.stopped, after.leaves) == ("", 1)


@given(st.lists(st.one_of(
    st.builds(stop, st.integers(0, 9)),
    st.builds(resume, st.integers(0, 9)),
    st.builds(resume, st.integers(0, 9), st.sampled_from([1, 2])),
)))  # fmt: skip
def test_whoever_recalls_what_lasts_is_where_it_was(orders):
    before, after = Owner(), Owner()
    before.take(*orders)
    for order in before.latch.lasting:
        after.latch.recall(order)
    assert after.latch.stopped == before.latch.stopped
    assert after.latch.mark == before.latch.mark
    assert after.latch.version == before.latch.version
    assert len(before.latch.lasting) <= 3


def test_a_stop_from_ahead_of_time_holds_after_all_that_is_known_and_once():
    owner, now_ns, later = Owner(), 1_000_000, 10**15
    owner.take(resume(5_000))  # of a clock that is ahead, too, but can be
    assert owner.latch.accept_ahead(stop(later, "ahead"), now_ns) == "future"
    assert owner.latch.stopped == "stop: ahead"
    assert owner.latch.version == 5_000, "nobody could be told of it"
    assert owner.latch.mark == (-1, 5_000)
    owner.latch.accept_ahead(stop(later, "ahead"), now_ns)
    owner.take(resume(5_000))
    assert owner.latch.stopped == "stop: ahead"
    owner.take(stop(4_000, "older, and said after it"))
    assert owner.latch.stopped == "stop: older, and said after it"
    owner.take(resume(5_002))
    assert not owner.latch.stopped
    owner.latch.accept_ahead(resume(later), now_ns)
    owner.latch.accept_ahead(stop(later, "ahead"), now_ns)
    assert not owner.latch.stopped, "it is said again, by whomever"
    owner.latch.accept_ahead(stop(later + 1, "another"), 2 * later)
    assert owner.latch.stopped == "stop: another"
    owner.take(resume(2 * later // 1_000 - 1))
    assert owner.latch.stopped == "stop: another", "it was given before"
    owner.take(stop(2 * later // 1_000 + 1, "of right clocks"))
    assert owner.latch.stopped == "stop: of right clocks"
    owner.take(resume(2 * later // 1_000 + 2))
    assert not owner.latch.stopped
