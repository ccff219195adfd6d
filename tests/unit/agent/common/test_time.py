"""What a clock shows that is wrong on purpose."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_S, LocalTime

EPOCH = 1_700_000_000 * NS_PER_S

MS = 1_000_000


def test_a_right_clock_shows_the_time():
    for local in (LocalTime(), LocalTime(epoch_ns=EPOCH)):
        assert local.local_ns(EPOCH + 5) == local.true_ns(EPOCH + 5) == EPOCH + 5


def test_a_skewed_clock_is_ahead_by_as_much_all_the_time():
    local = LocalTime(-300 * MS)
    for true_ns in (NS_PER_S, EPOCH):
        assert local.local_ns(true_ns) == true_ns - 300 * MS
        assert local.true_ns(true_ns - 300 * MS) == true_ns


def test_drift_counts_from_the_epoch():
    local = LocalTime(100 * MS, 50e-6, EPOCH)
    for since_s, ahead_ns in ((-10, 0), (0, 0), (1, 50_000), (100, 5 * MS)):
        true_ns = EPOCH + since_s * NS_PER_S
        assert local.local_ns(true_ns) == true_ns + 100 * MS + ahead_ns
    slow = LocalTime(0, -0.01, EPOCH)
    assert slow.local_ns(EPOCH + 10 * NS_PER_S) == EPOCH + 9_900_000_000


def test_nothing_drifts_while_the_epoch_is_not_known():
    assert LocalTime(7, 0.01).local_ns(EPOCH) == EPOCH + 7


@given(
    skew_ns=st.integers(-3600 * NS_PER_S, 3600 * NS_PER_S),
    drift=st.floats(-0.01, 0.01),
    since_ns=st.integers(-3600 * NS_PER_S, 10 * 86_400 * NS_PER_S),
)
def test_true_time_is_the_first_at_which_the_clock_shows_it(skew_ns: int, drift: float, since_ns: int):
    local = LocalTime(skew_ns, drift, EPOCH)
    shown_ns = EPOCH + since_ns
    true_ns = local.true_ns(shown_ns)
    assert local.local_ns(true_ns - 1) < shown_ns <= local.local_ns(true_ns)


@given(drift=st.floats(-0.01, 0.01), since_ns=st.integers(-10, 10 * 86_400 * NS_PER_S))
def test_a_drifting_clock_never_goes_back(drift: float, since_ns: int):
    local = LocalTime(0, drift, EPOCH)
    assert local.local_ns(EPOCH + since_ns + 1) >= local.local_ns(EPOCH + since_ns)
