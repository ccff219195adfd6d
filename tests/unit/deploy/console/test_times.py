"""Points in time as people type them."""

from __future__ import annotations

import time
from datetime import datetime

import pytest

from handfast.deploy.console.times import point_in_time

NOW_S = datetime(2026, 11, 20, 14, 30, 15).timestamp()


def at(*fields: int) -> float:
    return datetime(*fields).timestamp()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("10 min", NOW_S - 600),
        ("10min ago", NOW_S - 600),
        ("45s", NOW_S - 45),
        ("2 h", NOW_S - 7200),
        ("1d", NOW_S - 86_400),
        ("today", at(2026, 11, 20)),
        ("yesterday", at(2026, 11, 19)),
        ("13:05", at(2026, 11, 20, 13, 5)),
        ("13:05:07", at(2026, 11, 20, 13, 5, 7)),
        ("2026-11-01", at(2026, 11, 1)),
        ("2026-11-01 08:00", at(2026, 11, 1, 8)),
        (" 2026-11-01T08:00:30 ", at(2026, 11, 1, 8, 0, 30)),
    ],
)
def test_what_is_meant(text: str, meant: float) -> None:
    assert point_in_time(text, NOW_S) == meant


@pytest.mark.parametrize(
    "text", ["", "10", "soon", "-5 min", "25:00", "2026-13-01", "10 parsecs", "9" * 99 + "s"]
)
def test_what_is_no_time_is_told_with_what_would_be(text: str) -> None:
    with pytest.raises(ValueError, match=r'must be such as "10 min"'):
        point_in_time(text, time.time())
