"""A history keeps every row, or every second, fourth, ...: never more than its limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.deploy.view.history import BYTES_MAX, History


def rows_of(history: History, width: int) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    return np.frombuffer(history.content(), dtype="<f4").reshape(-1, width + 1)


@given(st.integers(1, 5), st.integers(2, 40), st.integers(0, 400))
def test_every_row_that_is_kept_is_that_of_its_place(width: int, most: int, offered: int) -> None:
    """Row k of those that are kept is row k x stride of those that were offered, and none is missing."""
    bytes_max = most * 4 * (width + 1)
    history = History(width, bytes_max)
    for number in range(offered):
        history.add(number / 8, np.arange(width, dtype=float) + number)
        rows = rows_of(history, width)
        assert len(history.content()) <= bytes_max
        assert len(rows) == len(history) == number // history.stride + 1
        assert history.stride == 1 or 2 * len(rows) >= most  # no more is left out than must be
        numbers = np.arange(len(rows)) * history.stride
        assert (rows[:, 0] == numbers / 8).all()
        assert (rows[:, 1:] == np.arange(width) + numbers[:, None]).all()


def test_one_that_was_cleared_is_as_new() -> None:
    history = History(2, 4 * 3 * 4)
    for number in range(41):
        history.add(number, np.zeros(2))
    assert history.stride > 1
    history.clear()
    assert (len(history), history.stride, history.content()) == (0, 1, b"")
    history.add(7.0, np.ones(2))
    history.add(8.0, np.ones(2))
    assert rows_of(history, 2).tolist() == [[7, 1, 1], [8, 1, 1]]
    history.add(9.0, np.ones(2))
    history.add(10.0, np.ones(2))
    history.add(11.0, np.ones(2))
    assert rows_of(history, 2)[:, 0].tolist() == [7, 9, 11]


def test_it_takes_no_memory_before_it_is_needed() -> None:
    """A large fleet has wide rows; its server does not begin with all that they may take."""
    history = History(800)
    for number in range(3000):
        history.add(number, np.full(800, number))
    assert len(history.content()) == 3000 * 801 * 4 < BYTES_MAX
    assert rows_of(history, 800)[2999].tolist() == pytest.approx([2999] * 801)
