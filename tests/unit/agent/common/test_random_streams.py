"""Random draws as pure functions: their distributions, and the independence of streams."""

from __future__ import annotations

import inspect
from math import sqrt

import numpy as np
import pytest
from scipy import stats

from handfast.agent.common import random_streams

COUNT = 100_000
# Every draw is fixed: these tests cannot fail by bad luck, and p-values were looked at once.
P_MIN = 1e-3
UNIFORM_KNOWN = float.fromhex("0x1.1d1d1e4035cf2p-1")  # the first draw of robot 1's x


def uniforms(*key: int | str, count: int = COUNT) -> np.ndarray:
    stream = random_streams.stream(*key)
    return np.array([random_streams.uniform(stream, k) for k in range(count)])


def normals(*key: int | str, count: int = COUNT) -> np.ndarray:
    stream = random_streams.stream(*key)
    return np.array([random_streams.normal(stream, k) for k in range(count)])


@pytest.mark.parametrize("key", [(0,), (1, "plant", 3, "x"), (2**63 - 1, "loss")])
def test_uniform_draws_are_uniform(key: tuple[int | str, ...]):
    sample = uniforms(*key)
    assert sample.min() >= 0.0
    assert sample.max() < 1.0
    assert stats.kstest(sample, "uniform").pvalue > P_MIN
    # The low bits as well: what is left of a thousandth.
    assert stats.kstest(sample * 1000 % 1.0, "uniform").pvalue > P_MIN


@pytest.mark.parametrize("key", [(0,), (1, "plant", 3, "x"), (7, "plant", 12, "yaw rate")])
def test_normal_draws_are_normal(key: tuple[int | str, ...]):
    sample = normals(*key)
    assert stats.kstest(sample, "norm").pvalue > P_MIN
    assert abs(sample.mean()) < 4.0 / sqrt(COUNT)
    assert sample.std() == pytest.approx(1.0, abs=4.0 / sqrt(2 * COUNT))
    assert np.isfinite(sample).all()


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((0, "plant", 1, "x"), (0, "plant", 1, "y")),
        ((0, "plant", 1, "x"), (0, "plant", 2, "x")),
        ((0, "plant", 1, "x"), (1, "plant", 1, "x")),
        ((0, "loss", 1, 2), (0, "loss", 2, 1)),
        ((1,), (2,)),
    ],
)
def test_streams_are_independent(one: tuple[int | str, ...], other: tuple[int | str, ...]):
    a, b = normals(*one), normals(*other)
    assert abs(np.corrcoef(a, b)[0, 1]) < 4.5 / sqrt(COUNT)
    assert abs(np.corrcoef(a[1:], b[:-1])[0, 1]) < 4.5 / sqrt(COUNT)
    assert abs(np.corrcoef(a * a, b * b)[0, 1]) < 4.5 / sqrt(COUNT)


def test_bits_are_splitmix64():
    """Its published first outputs for the seed 1234567 (Rosetta Code, `java.util.SplittableRandom`)."""
    assert [random_streams.bits(1234567, k) for k in range(5)] == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]


def test_draws_are_pure_and_know_no_order():
    stream = random_streams.stream(4, "x")
    forward = [random_streams.normal(stream, k) for k in range(50)]
    random_streams.uniform(random_streams.stream("other"), 3)
    backward = [random_streams.normal(stream, k) for k in reversed(range(50))]
    assert forward == backward[::-1]
    assert random_streams.stream(4, "x") == stream


def test_streams_are_the_same_in_every_run_and_on_every_machine():
    assert random_streams.stream(0, "plant", 1, "x") == random_streams.stream(0, "plant", 1, "x")
    assert random_streams.uniform(random_streams.stream(0, "plant", 1, "x"), 0) == UNIFORM_KNOWN
    assert random_streams.stream(0) != random_streams.stream("0")


def test_keys_that_read_alike_are_different_streams():
    keys: list[tuple[int | str, ...]] = [
        (1, 23),
        (12, 3),
        (123,),
        ("1", 23),
        (1, "23"),
        ("12", "3"),
        ("123",),
    ]
    assert len({random_streams.stream(*key) for key in keys}) == len(keys)


@pytest.mark.patches
def test_module_keeps_no_state():
    assert not [
        name
        for name, value in vars(random_streams).items()
        if not name.startswith("__") and isinstance(value, (list, dict, set))
    ]
    assert "global " not in inspect.getsource(random_streams)
