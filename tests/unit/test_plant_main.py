"""`python -m plant --pose`: where a body stands that starts again."""

from __future__ import annotations

import argparse

import pytest

from plant.__main__ import place


def test_three_numbers_to_the_last_bit() -> None:
    x, y, heading = -1.0 / 3.0, 2.0 / 3.0, 7.1
    assert place(f"{x!r},{y!r},{heading!r}") == (x, y, heading)


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "a,b,c", "nan,0,0", "0,inf,0", "0,0,1e16", "1;2;3"])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=r"^must be X,Y,HEADING in m, m and rad, such as"):
        place(text)
