"""Percentiles are numpy's, to the bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handfast.deploy.analysis.rounding import percentiles

PERCENTS = (0, 1, 5, 50, 95, 99, 99.9, 100)
floats = st.floats(-1e12, 1e12)


@given(st.lists(floats, min_size=1, max_size=50), st.lists(st.floats(0, 100), min_size=1, max_size=5))
def test_percentiles_of_floats(values: list[float], percents: list[float]) -> None:
    found = np.array(values)
    for each in (PERCENTS, percents):
        assert percentiles(found, each).tolist() == np.percentile(found, each).tolist()


@given(st.lists(st.integers(-(2**40), 2**40), min_size=1, max_size=50))
def test_percentiles_of_integers(values: list[int]) -> None:
    found = np.array(values, dtype=np.int64)
    assert percentiles(found, PERCENTS).tolist() == np.percentile(found, PERCENTS).tolist()
    assert found.tolist() == values, "they stay as they are"
