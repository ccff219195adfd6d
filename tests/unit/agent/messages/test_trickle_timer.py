"""When what others know already is said again."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.messages.trickle_timer import TrickleTimer

LEAST, MOST = 200, 1600


def said_at(timer: TrickleTimer, until: int, changes: tuple[int, ...] = (), step: int = 100) -> list[int]:
    times = []
    for now in range(0, until, step):
        if now in changes:
            timer.changed()
        if timer.is_due(now):
            timer.said(now)
            times.append(now)
    return times


def test_intervals_double_up_to_the_longest() -> None:
    assert said_at(TrickleTimer(LEAST, MOST), 6500) == [0, 200, 600, 1400, 3000, 4600, 6200]


def test_a_change_is_said_at_once_and_soon_again() -> None:
    assert said_at(TrickleTimer(LEAST, MOST), 5000, (2000,)) == [0, 200, 600, 1400, 2000, 2200, 2600, 3400]


def test_never_sooner_than_the_shortest_interval() -> None:
    assert said_at(TrickleTimer(LEAST, MOST), 900, tuple(range(0, 900, 100))) == [0, 200, 400, 600, 800]


def test_each_has_its_share_of_the_intervals_until_they_are_as_long_as_they_get() -> None:
    assert said_at(TrickleTimer(LEAST, MOST, (0.5, 0.25)), 5000) == [0, 200, 600, 1200, 1600, 3200, 4800]
    assert said_at(TrickleTimer(LEAST, MOST, (1.0, 0.01)), 5000) == [0, 200, 600, 1400, 1600, 3200, 4800]
    again = [0, 200, 600, 1200, 1600, 2000, 2200, 2600, 3200, 3600]
    assert said_at(TrickleTimer(LEAST, MOST, (0.5, 0.25)), 5000, (2000,)) == again


def test_of_some_changes_it_is_not_said_again_so_soon() -> None:
    timer = TrickleTimer(LEAST, MOST)
    said_at(timer, 3100)
    timer.changed(800)
    assert timer.is_due(3200)
    assert (timer.said(3200), timer.said(4000)) == (800, MOST)
    timer.changed()
    timer.changed(800)
    assert timer.said(5600) == LEAST, "what is more urgent decides"


@given(
    st.lists(st.integers(0, 20_000)),
    st.sampled_from([10, 50, 70, 100]),
    st.tuples(*[st.floats(0.0, 1.0, exclude_min=True)] * 2),
)
def test_what_was_promised_is_kept(changes: list[int], step: int, shares: tuple[float, float]) -> None:
    timer = TrickleTimer(LEAST, MOST, shares)
    promised = last = None
    for now in range(0, 20_000, step):
        if any(now - step < change <= now for change in changes):
            timer.changed()
        if timer.is_due(now):
            if promised is not None and last is not None:
                assert LEAST <= now - last < promised + step
            promised, last = timer.said(now), now
            assert LEAST <= promised <= MOST
    assert promised is not None


def test_who_asks_at_other_times_is_told_to_say_it_sooner_rather_than_late() -> None:
    for step in (LEAST, 2 * LEAST, 3 * LEAST // 2):
        timer, last, promised = TrickleTimer(LEAST, MOST), None, 0
        for now in range(0, 20_000, step):
            if timer.is_due(now, step):
                assert last is None or now - last <= max(promised, step)
                last, promised = now, timer.said(now)
        assert promised == MOST
