"""The draws of impairments have the statistics they promise, on 100,000 messages each.

Every draw is fixed: these tests cannot fail by bad luck. Bounds are four standard errors, or p > 0.001.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from typing import Any

import numpy as np
import pytest
from scipy import stats

from handfast.agent.common import random_streams
from handfast.agent.impairments import loss_models
from handfast.agent.impairments.delay_distributions import SHAPES
from handfast.agent.impairments.impairments import Corrupt, Delay, Duplicate, Loss, Range, Reorder

COUNT = 100_000
FIRST = 2**20  # sequence numbers that a run has
P_MIN = 1e-3
ERRORS = 4.0
SEQUENCES = range(FIRST, FIRST + COUNT)
STREAM = random_streams.stream(7, "link", 1, 2, "hand", "something")


def delays(text: str, stream: int = STREAM) -> np.ndarray:
    delay = Delay.parse(text)
    return np.array([delay.sample(stream, n) for n in SEQUENCES])


def losses(text: str, stream: int = STREAM) -> np.ndarray:
    loss = Loss.parse(text)
    return np.array([loss.lost(stream, n) for n in SEQUENCES])


def batch_error(sample: np.ndarray) -> float:
    """Standard error of the mean of correlated values, by the means of 200 batches."""
    means = np.array([batch.mean() for batch in np.array_split(sample.astype(float), 200)])
    return float(means.std(ddof=1) / sqrt(len(means)))


def lag_correlation(sample: np.ndarray, lag: int = 1) -> tuple[float, float]:
    """Correlation with the value `lag` later, and its standard error (delta method for the ratio)."""
    centred = sample - sample.mean()
    before, after = centred[:-lag], centred[lag:]
    measured = float((before * after).mean() / centred.var())
    residual = before * after - measured * (before**2 + after**2) / 2
    return measured, batch_error(residual) / float(centred.var())


def run_lengths(flags: np.ndarray) -> np.ndarray:
    """Lengths of the runs of True, without those at the ends, which are cut."""
    edges = np.flatnonzero(np.diff(flags.astype(int)))
    lengths = np.diff(edges)
    return lengths[0 if flags[edges[0] + 1] else 1 :: 2]


def geometric_pvalue(lengths: np.ndarray, p: float) -> float:
    """Chi-squared test of lengths 1, 2, ... against P(n) = p (1 - p)^(n - 1); classes of 20 or more."""
    last = 1
    while len(lengths) * (1 - p) ** last >= 20:
        last += 1
    observed = [int((lengths == n).sum()) for n in range(1, last)] + [int((lengths >= last).sum())]
    expected = [len(lengths) * p * (1 - p) ** (n - 1) for n in range(1, last)]
    expected.append(len(lengths) * (1 - p) ** (last - 1))
    return float(stats.chisquare(observed, expected).pvalue)


# --- delays -----------------------------------------------------------------------------------


def paretonormal_cdf() -> Callable[[np.ndarray], np.ndarray]:
    """By its quantiles, a quarter of the normal's and three quarters of the Pareto's, turned round."""
    u = np.concatenate([np.linspace(1e-6, 0.98, 200_001), 1 - np.geomspace(0.02, 1e-9, 50_000)[1:]])
    pareto = np.minimum(((1 - u) ** (-1 / 3) - 1.5) * 4 / 3, 4.0)
    x = 0.25 * np.clip(stats.norm.ppf(u), -4, 4) + 0.75 * pareto
    return lambda values: np.interp(values, x, u)


def truncated(cdf: Callable[[np.ndarray], np.ndarray], end: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: cdf(values) / cdf(np.array(end))


CDF: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "uniform": lambda x: (x + 1) / 2,
    "normal": stats.norm.cdf,
    "pareto": lambda x: 1 - (1.5 + 0.75 * x) ** -3.0,
    "paretonormal": paretonormal_cdf(),
}


@pytest.mark.parametrize(("correlation", "thin"), [(0, 1), (25, 12), (90, 150)])
@pytest.mark.parametrize("name", list(CDF))
def test_delays_have_their_distribution_with_or_without_correlation(name: str, correlation: int, thin: int):
    """Kolmogorov-Smirnov on values so far apart that they are independent; the cut tail is counted."""
    x = (delays(f"{name} 10s 1s {correlation}%") - 10.0)[::thin]
    whole = x[x < 3.999] if name != "paretonormal" else x
    end = 3.999 if name == "pareto" else np.inf
    cdf = truncated(CDF[name], end) if name == "pareto" else CDF[name]
    assert stats.kstest(whole, cdf).pvalue > P_MIN
    if name == "pareto":
        share = 1 / 91.125  # of (1.5 + 0.75 x)^-3 beyond 4
        assert abs((x >= 3.999).sum() - len(x) * share) < ERRORS * sqrt(len(x) * share)
    assert x.max() <= (1.0 if name == "uniform" else 4.0) + 1e-9


@pytest.mark.parametrize("name", ["pareto", "paretonormal"])
def test_shapes_are_netems_tables(name: str):
    """iproute2, netem/pareto.c and paretonormal.c: 4096 quantiles in units of 1/8192."""
    u = np.arange(0, 16384, 4) / 16384
    pareto = np.rint(np.minimum(((1 - u) ** (-1 / 3.0) - 1.5) * (4 / 3) * 8192, 32767))
    normal = np.rint(np.clip(stats.norm.ppf(u + 0.5 / 16384), -4, 4) * 8192)
    table = pareto if name == "pareto" else np.trunc((normal + 3 * pareto) / 4)
    ours = np.array([SHAPES[name](float(stats.norm.isf(1 - v))) for v in u[1:]]) * 8192
    # Where the normal table jumps, in its far tails, by what one of its steps is.
    step = np.abs(np.gradient(table[1:]))
    assert np.all(np.abs(ours - table[1:]) <= 1.0 + step)
    assert np.median(np.abs(ours - table[1:])) < 1.0


@pytest.mark.parametrize("correlation", [0.0, 0.25, 0.9])
@pytest.mark.parametrize("name", list(CDF))
def test_successive_delays_are_correlated_as_asked(name: str, correlation: float):
    measured, error = lag_correlation(delays(f"{name} 10s 1s {correlation}"))
    assert abs(measured - correlation) < ERRORS * error
    assert error < 0.01


# --- events with a probability ----------------------------------------------------------------


def flags_of(event: Any, stream: int = STREAM) -> np.ndarray:
    if isinstance(event, Loss):
        return np.array([event.lost(stream, n) for n in SEQUENCES])
    if isinstance(event, Corrupt):
        return np.array([event.bit(stream, n, 300) >= 0 for n in SEQUENCES])
    return np.array([event.happens(stream, n) for n in SEQUENCES])


@pytest.mark.parametrize("kind", [Loss, Duplicate, Corrupt, Reorder])
@pytest.mark.parametrize("probability", [0.001, 0.01, 0.3, 0.5, 0.99])
def test_events_happen_as_often_as_asked(kind: Any, probability: float):
    count = int(flags_of(kind.parse(probability)).sum())
    low, high = stats.binom.interval(1 - 1e-4, COUNT, probability)
    assert low <= count <= high


@pytest.mark.parametrize("kind", [Loss, Duplicate, Corrupt, Reorder])
@pytest.mark.parametrize(("probability", "correlation"), [(0.3, 0.25), (0.05, 0.9), (0.5, 0.5)])
def test_correlated_events_have_rate_and_correlation(kind: Any, probability: float, correlation: float):
    flags = flags_of(kind.parse(f"{probability:.0%} {correlation:.0%}"))
    error = sqrt(probability * (1 - probability) / COUNT * (1 + correlation) / (1 - correlation))
    assert abs(flags.mean() - probability) < ERRORS * error
    measured, error = lag_correlation(flags.astype(float))
    assert abs(measured - correlation) < ERRORS * error
    assert error < 0.01


@pytest.mark.parametrize("text", ["30%", "30% 60%"])
def test_flipped_bits_are_anywhere_in_the_message(text: str):
    size = 40
    corrupt = Corrupt.parse(text)
    bits = np.array([corrupt.bit(STREAM, n, size) for n in SEQUENCES])
    found = bits[bits >= 0]
    counts = np.bincount(found, minlength=8 * size)
    assert len(counts) == 8 * size
    assert stats.chisquare(counts).pvalue > P_MIN


# --- bursts of loss ---------------------------------------------------------------------------


@pytest.mark.parametrize(("p", "r"), [(0.01, 0.1), (0.05, 0.5), (0.2, 0.3)])
def test_bursts_of_gilbert_elliott_are_geometric(p: float, r: float):
    flags = losses(f"gemodel {p} {r}")
    rate = p / (p + r)
    assert Loss.parse(f"gemodel {p} {r}").rate == pytest.approx(rate)
    error = sqrt(rate * (1 - rate) / COUNT * (2 - p - r) / (p + r))
    assert abs(flags.mean() - rate) < ERRORS * error
    bursts, gaps = run_lengths(flags), run_lengths(~flags)
    assert abs(bursts.mean() - 1 / r) < ERRORS * sqrt(1 - r) / r / sqrt(len(bursts))
    assert abs(gaps.mean() - 1 / p) < ERRORS * sqrt(1 - p) / p / sqrt(len(gaps))
    assert geometric_pvalue(bursts, r) > P_MIN
    assert geometric_pvalue(gaps, p) > P_MIN


@pytest.mark.parametrize(
    "numbers",
    [
        (0.05, 0.2, 0.3, 0.4, 0.02),
        (0.01, 0.1, 0.0, 1.0, 0.0),
        (0.1, 0.3, 0.6, 0.2, 0.3),
        (0.3, 0.3, 0.5, 0.9, 0.6),
    ],
)
def test_four_states_have_the_statistics_of_their_matrix(numbers: tuple[float, ...]):
    p13, p31, p32, p23, p14 = numbers
    matrix = np.array(
        [[1 - p13 - p14, 0, p13, p14], [0, 1 - p23, p23, 0], [p31, p32, 1 - p31 - p32, 0], [1, 0, 0, 0]]
    )
    system = np.vstack([matrix.T - np.eye(4), np.ones(4)])
    shares = np.linalg.lstsq(system, np.array([0, 0, 0, 0, 1.0]), rcond=None)[0]
    loss = Loss.parse("state " + " ".join(map(str, numbers)))
    flags = losses(str(loss))
    rate = shares[2] + shares[3]
    assert loss.rate == pytest.approx(rate)
    assert abs(flags.mean() - rate) < ERRORS * batch_error(flags)
    begins = shares[:2] @ matrix[:2, 2:].sum(axis=1)  # a loss after none
    bursts = run_lengths(flags)
    assert abs(bursts.mean() - rate / begins) < ERRORS * batch_error(bursts)
    # Length of a burst: by the lost states alone, begun as bursts begin.
    start = (shares[:2] @ matrix[:2, 2:]) / begins
    for length in (1, 2, 3, 5):
        expected = start @ np.linalg.matrix_power(matrix[2:, 2:], length - 1) @ matrix[2:, :2].sum(axis=1)
        error = sqrt(max(expected * (1 - expected), 1e-6) / len(bursts))
        assert abs((bursts == length).mean() - expected) < ERRORS * error


@pytest.mark.parametrize("count", [1, 3, 7])
def test_every_n_th_is_exact(count: int):
    flags = losses(f"every {count}")
    assert list(np.flatnonzero(flags) + FIRST) == [n for n in SEQUENCES if (n + 1) % count == 0]
    assert Loss.parse(f"every {count}").rate == pytest.approx(1 / count)


def test_each_state_follows_from_the_one_before_though_found_alone():
    rows: tuple[loss_models.Row, ...] = (
        ((2, 0.05), (3, 0.02), (0, 1.0)),
        ((2, 0.4), (1, 1.0)),
        ((2, 0.5), (1, 0.3), (0, 1.0)),
        ((0, 1.0),),
    )
    found = loss_models.chain(rows, (0.25, 0.25, 0.25, 0.25))  # no share matters to a chain that forgets
    states = []
    for n in SEQUENCES[:3000]:
        loss_models._last.clear()
        states.append(found.state(STREAM, n))
    for n, before, after in zip(SEQUENCES[1:3000], states, states[1:], strict=False):
        ends = np.cumsum([probability for _, probability in rows[before]])
        assert after == rows[before][int(np.argmax(random_streams.uniform(STREAM, 4 * n) < ends))][0], n
    assert set(states) == {0, 1, 2, 3}


# --- links and purposes -----------------------------------------------------------------------


@pytest.mark.slow
def test_links_and_purposes_are_independent():
    others = [
        random_streams.stream(7, "link", 2, 1, "hand", "something"),
        random_streams.stream(7, "link", 1, 2, "state", "something"),
        random_streams.stream(7, "link", 1, 2, "hand", "other"),
        random_streams.stream(8, "link", 1, 2, "hand", "something"),
    ]
    delayed, lost = delays("normal 1s 100ms 50%"), losses("30% 25%")
    for other in others:
        correlation = np.corrcoef(delayed, delays("normal 1s 100ms 50%", other))[0, 1]
        # Two AR(1) processes of c = 0.5: (1 + c^2) / (1 - c^2) times the variance.
        assert abs(correlation) < ERRORS * sqrt(5 / 3 / COUNT)
        correlation = np.corrcoef(lost, losses("30% 25%", other))[0, 1]
        assert abs(correlation) < ERRORS * sqrt(1.14 / COUNT)
        correlation = np.corrcoef(delayed, losses("30% 25%", other))[0, 1]
        assert abs(correlation) < ERRORS * sqrt(1.3 / COUNT)


# --- range --------------------------------------------------------------------------


@pytest.mark.parametrize(("distance", "failing"), [(10.0, 0.5), (12.0, None), (7.0, None), (30.0, None)])
def test_tries_fail_by_the_path_loss(distance: float, failing: float | None):
    channel = Range.parse("logdistance 10m exponent 3 shadowing 6dB")
    expected = stats.norm.cdf(10 * 3 * np.log10(distance / 10) / 6) if failing is None else failing
    lost = sum(channel.attempt(STREAM, n, distance) is None for n in SEQUENCES)
    assert abs(lost - COUNT * expected) < ERRORS * sqrt(COUNT * expected * (1 - expected)) + 1


def test_retries_take_time_and_save_messages():
    channel = Range.parse("logdistance 10m retries 3 5ms speed 1500m/s")
    found = [channel.attempt(STREAM, n, 10.0) for n in SEQUENCES]
    tries = np.array([-1 if d is None else round((d - 10.0 / 1500.0) / 5e-3) for d in found])
    counts = [int((tries == k).sum()) for k in (0, 1, 2, 3, -1)]
    assert stats.chisquare(counts, COUNT * np.array([1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 16])).pvalue > P_MIN
    assert abs(lag_correlation((tries == -1).astype(float))[0]) < ERRORS / sqrt(COUNT)
