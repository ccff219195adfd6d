"""Numbers as ``metrics.json`` writes them."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray


def number(value: float | None) -> float | None:
    """A float, rounded to a micro-unit, so that the last bits of a platform's sine do not show; NaN: None."""
    if value is None or not isfinite(value):
        return None
    return round(float(value), 6) + 0.0  # + 0.0 turns -0.0 into 0.0


def largest(values: NDArray[Any]) -> float | None:
    """The greatest of those that are finite."""
    finite = values[np.isfinite(values)]
    return number(float(finite.max())) if finite.size else None


def percentile(values: NDArray[Any], percent: float) -> float | None:
    """The percentile (`percent` 0..100) of values, rounded; None without any."""
    return number(float(percentiles(values, (percent,))[0])) if values.size else None


def percentiles(values: NDArray[Any], percents: Sequence[float]) -> NDArray[np.float64]:
    """Percentiles (p,) of values, at least one: those of `numpy.percentile`, to the bit, without its detour
    through masked arrays, whose module alone takes as long as thousands of these."""
    at = np.array(percents) / 100.0 * (values.size - 1)
    below = np.floor(at).astype(np.intp)
    above = np.minimum(below + 1, values.size - 1)
    ordered = np.partition(values, np.concatenate([below, above]).tolist())
    low, high, share = ordered[below], ordered[above], at - below
    span = high - low
    return np.where(share >= 0.5, high - span * (1.0 - share), low + span * share)


def mean(values: NDArray[Any]) -> float | None:
    """The mean of values, rounded; None without any."""
    return number(float(values.mean())) if values.size else None
