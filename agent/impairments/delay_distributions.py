"""Distributions of a delay about its mean, and correlated draws from them (PURE).

A draw is a standard normal number z, the *score*, which the distribution's quantile function maps to x; the
delay is then mean + jitter x. Correlation acts on the scores, so that every x has exactly its distribution
whatever the correlation. (netem averages its previous uniform number and a fresh one, which narrows the
distribution: at the correlation c to sqrt((1 - c) / (1 + c)) of the jitter asked for.)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from math import erf, erfc, exp, pi, sin, sqrt

from handfast.agent.common.random_streams import normal

_ROOT_HALF = sqrt(0.5)
_CUT = 4.0  # netem's tables hold 16-bit numbers of 1/8192 jitter: they end at four jitters
_INDEPENDENT = 1e-9  # a correlation that is none
_TERMS = 40


# --- shapes: x as a function of the score -----------------------------------------------------


def _uniform(z: float) -> float:
    return erf(z * _ROOT_HALF)


def _normal(z: float) -> float:
    return min(max(z, -_CUT), _CUT)


def _pareto(z: float) -> float:
    above = 0.5 * erfc(z * _ROOT_HALF)  # not 1 - Phi(z), which is coarse in the tail that matters
    return float(min((4.0 / 3.0) * (above ** (-1.0 / 3.0) - 1.5), _CUT))


def _paretonormal(z: float) -> float:
    return 0.25 * _normal(z) + 0.75 * _pareto(z)


SHAPES: dict[str, Callable[[float], float]] = {
    "uniform": _uniform,
    "normal": _normal,
    "pareto": _pareto,
    "paretonormal": _paretonormal,
}
"""x for a standard normal score, by name, as netem has them (iproute2, netem/*.c, from NIST Net):

- uniform: between -1 and 1;
- normal: standard normal;
- pareto: 4/3 (u^(-1/3) - 3/2) of a uniform u, a Pareto distribution with a = 3 moved to mean 0;
- paretonormal: a quarter of normal and three quarters of pareto at the same quantile.

All but uniform end at four jitters, as netem's tables do. That cuts the last 1.1 % of pareto, whose mean so
lies 0.033 jitters below 0 (paretonormal: 0.025), and 0.006 % of normal.
"""


# --- correlated scores ------------------------------------------------------------------------


@lru_cache(maxsize=1 << 14)
def score(stream: int, sequence: int, correlation: float) -> float:
    """A standard normal number, whose correlation with the one `n` further is c^n (0 <= c < 1).

    The sequence is an AR(1) process, z_n = c z_{n-1} + sqrt(1 - c^2) e_n, but not drawn in that order:
    numbers so far apart that they are independent come first, and the one halfway between two known ones is
    drawn given both (the process is Gaussian and Markov: Levy's construction). So a number is a pure function
    of its arguments that needs a few dozen draws, not all before it; in order, the cache makes it one draw.
    """
    own = normal(stream, sequence)
    bridges = _bridges(correlation)
    lowest = sequence & -sequence
    level = lowest.bit_length() - 1
    if sequence == 0 or level >= len(bridges):
        return own
    weight, deviation = bridges[level]
    before = score(stream, sequence - lowest, correlation)
    return weight * (before + score(stream, sequence + lowest, correlation)) + deviation * own


@lru_cache(maxsize=256)
def _bridges(correlation: float) -> tuple[tuple[float, float], ...]:
    """Law of z halfway between two others at the distance 2^level: weight of their sum, own deviation."""
    bridges = []
    rho = correlation
    while rho > _INDEPENDENT:
        square = rho * rho
        bridges.append((rho / (1.0 + square), sqrt((1.0 - square) / (1.0 + square))))
        rho = square
    return tuple(bridges)


@lru_cache(maxsize=256)
def score_correlation(shape: str, correlation: float) -> float:
    """The correlation (0 <= c < 1) of two scores that gives their x the correlation asked for.

    uniform: 2 sin(pi c / 6), K. Pearson 1907. The others: corr(x, x') = sum b_k r^k with b_k of `_powers`
    (Mehler's expansion), solved for r.
    """
    if correlation == 0.0 or shape == "normal":
        return correlation
    if shape == "uniform":
        return 2.0 * sin(pi * correlation / 6.0)
    low, high = correlation, 1.0  # all b_k >= 0 and their sum is 1: r is no less than the correlation
    powers = _powers(shape)
    for _ in range(50):
        middle = 0.5 * (low + high)
        value = 0.0
        for power in reversed(powers):
            value = (value + power) * middle
        low, high = (middle, high) if value < correlation else (low, middle)
    return low


@cache
def _powers(shape: str) -> tuple[float, ...]:
    """b_1, b_2, ...: squared coefficients of x in normalised Hermite polynomials of z, over its variance."""
    step = 0.02
    sums = [0.0] * (_TERMS + 1)
    square = 0.0
    for k in range(-450, 451):
        z = k * step
        x = SHAPES[shape](z)
        mass = step * exp(-0.5 * z * z) / sqrt(2.0 * pi) * x
        square += mass * x
        before, polynomial = 0.0, 1.0
        for n in range(_TERMS + 1):
            sums[n] += mass * polynomial
            after = (z * polynomial - sqrt(n) * before) / sqrt(n + 1)
            before, polynomial = polynomial, after
    variance = square - sums[0] ** 2
    powers = [value * value / variance for value in sums[1:]]
    powers[-1] += 1.0 - sum(powers)  # all beyond
    return tuple(powers)
