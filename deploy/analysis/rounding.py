"""Numbers as ``metrics.json`` writes them."""

from __future__ import annotations

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
    return number(float(np.percentile(values, percent))) if values.size else None


def mean(values: NDArray[Any]) -> float | None:
    """The mean of values, rounded; None without any."""
    return number(float(values.mean())) if values.size else None
