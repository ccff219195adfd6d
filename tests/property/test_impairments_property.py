"""Impairments survive writing; every draw is a pure function, whatever was drawn before or beside it."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.common import random_streams
from handfast.agent.common.quantities import UNITS, quantity, text
from handfast.agent.impairments import delay_distributions, loss_models
from handfast.agent.impairments.impairments import (
    Corrupt,
    Delay,
    Duplicate,
    Loss,
    Range,
    Rate,
    Reorder,
    interpolate,
    parse_ramp,
)

CLASSES: tuple[Any, ...] = (Delay, Loss, Duplicate, Corrupt, Reorder, Rate, Range)

ratios = st.floats(0, 1)
correlations = st.floats(0, 1, exclude_max=True)
times = st.floats(0, 3600)
streams = st.integers(0, 2**64 - 1)


@st.composite
def four_states(draw: st.DrawFn) -> Loss:
    p13, p31, p23 = draw(ratios), draw(ratios), draw(ratios)
    p14, p32 = draw(st.floats(0, 1 - p13)), draw(st.floats(0, 1 - p31))
    return Loss("state", (p13, p31, p32, p23, p14))


delays = st.one_of(
    st.builds(Delay, st.just("constant"), times),
    st.builds(Delay, st.sampled_from(list(delay_distributions.SHAPES)), times, times, correlations),
)
losses = st.one_of(
    st.builds(lambda *n: Loss("random", n), ratios, correlations),
    st.builds(lambda *n: Loss("gemodel", n), ratios, ratios, ratios, ratios),
    four_states(),
    st.builds(lambda n: Loss("every", every=n), st.integers(1, 10**6)),
)
chances = st.one_of(
    st.builds(Duplicate, ratios, correlations),
    st.builds(Corrupt, ratios, correlations),
    st.builds(Reorder, ratios, correlations, st.integers(1, 1000)),
)
ranges = st.one_of(
    st.builds(Range, st.just("disc"), st.floats(1e-3, 1e6), speed_mps=st.none() | st.floats(1, 3e8)),
    st.builds(
        Range, st.just("logdistance"), st.floats(1e-3, 1e6), st.floats(1, 10), st.floats(0.1, 100),
        st.integers(0, 15), st.floats(0, 60), st.none() | st.floats(1, 3e8),
    ),
)  # fmt: skip
impairments = st.one_of(delays, losses, chances, st.builds(Rate, st.floats(1, 1e12)), ranges)


def fate(impairment: Any, stream: int, sequence: int) -> object:
    """Whatever is drawn for one message."""
    if isinstance(impairment, Delay):
        return impairment.sample(stream, sequence)
    if isinstance(impairment, Loss):
        return impairment.lost(stream, sequence)
    if isinstance(impairment, Corrupt):
        return impairment.bit(stream, sequence, 300)
    if isinstance(impairment, (Duplicate, Reorder)):
        return impairment.happens(stream, sequence)
    if isinstance(impairment, Range):
        return impairment.attempt(stream, sequence, 1.1 * impairment.distance_m)
    return None


def forget() -> None:
    """As a process that has just begun."""
    loss_models._last.clear()
    delay_distributions.score.cache_clear()


@given(impairments)
def test_impairments_survive_writing(impairment: Any):
    written = str(impairment)
    assert type(impairment).parse(written) == impairment
    assert str(type(impairment).parse(written)) == written


@given(st.sampled_from(sorted(UNITS)), st.floats(-1e12, 1e12))
def test_quantities_survive_writing(unit: str, value: float):
    assert quantity(text(value + 0.0, unit), unit) == value


@given(
    st.sampled_from(CLASSES),
    st.one_of(
        st.text(max_size=40),
        st.lists(
            st.sampled_from(
                ["30%", "120%", "80ms", "-1s", "5", "0", "1e400", "nan", "normal", "gemodel", "state",
                 "every", "gap", "disc", "logdistance", "retries", "speed", "10m", ".."]
            ),
            max_size=7,
        ).map(" ".join),
        st.floats(),
        st.integers(),
        st.none(),
        st.booleans(),
        st.lists(st.integers(), max_size=2),
    ),
)  # fmt: skip
def test_whatever_is_given_is_read_or_refused_in_one_line(kind: Any, raw: object):
    try:
        value = parse_ramp(kind, raw)
    except ValueError as error:
        refused = str(error)
    else:
        refused = ""
    if refused:
        assert refused.isprintable()
        assert len(refused) < 500
        return
    for one in value if isinstance(value, tuple) else (value,):
        assert kind.parse(str(one)) == one
        fate(one, 1, 2**20)


@settings(max_examples=60, deadline=None)
@given(impairments, streams, st.integers(0, 2**40), st.randoms(use_true_random=False))
def test_draws_know_no_order(impairment: Any, stream: int, first: int, order: random.Random):
    """In order, shuffled, with gaps, and each one alone in a new process: bit for bit the same."""
    sequences = list(range(first, first + 30))
    forget()
    in_order = {n: fate(impairment, stream, n) for n in sequences}
    order.shuffle(sequences)
    assert {n: fate(impairment, stream, n) for n in sequences} == in_order
    forget()
    assert {n: fate(impairment, stream, n) for n in sequences} == in_order
    for n in sequences[:3]:
        forget()
        assert fate(impairment, stream, n) == in_order[n]


@settings(max_examples=40, deadline=None)
@given(impairments, st.lists(impairments, min_size=1, max_size=3), streams, st.booleans())
def test_draws_know_no_others(impairment: Any, others: list[Any], stream: int, shared: bool):
    """Other links and purposes, and other settings on the same stream, change no draw."""
    sequences = range(2**20, 2**20 + 30)
    forget()
    alone = [fate(impairment, stream, n) for n in sequences]
    forget()
    beside = []
    for n in sequences:
        for k, other in enumerate(others):
            fate(other, stream if shared else random_streams.stream(stream, k), n)
        beside.append(fate(impairment, stream, n))
    assert beside == alone


@given(delays | losses | chances, st.floats(0, 1))
def test_a_ramp_to_itself_stands_still(impairment: Any, fraction: float):
    assert interpolate(impairment, impairment, fraction) == impairment


@settings(deadline=None)
@given(st.tuples(losses, losses), st.floats(0, 1), streams)
def test_every_point_of_a_ramp_is_a_model(ends: tuple[Loss, Loss], fraction: float, stream: int):
    a, b = ends
    if a.kind != b.kind or a.every != b.every:
        with pytest.raises(ValueError):
            interpolate(a, b, fraction)
        return
    between = interpolate(a, b, fraction)
    assert 0.0 <= between.rate <= 1.0 + 1e-12
    assert between.lost(stream, 2**20) in (True, False)
    assert all(min(x, y) <= z <= max(x, y) or abs(x - z) < 1e-15
               for x, y, z in zip(a.numbers, b.numbers, between.numbers, strict=True))  # fmt: skip


@settings(deadline=None)
@given(delays, streams, st.integers(0, 2**53))
def test_delays_are_bounded(delay: Delay, stream: int, sequence: int):
    """Four jitters from the mean at most, and never negative."""
    sample = delay.sample(stream, sequence)
    assert max(0.0, delay.mean - 4.001 * delay.jitter) <= sample <= delay.mean + 4.001 * delay.jitter
