"""Versions of orders, as far as all have to agree on them (PURE)."""

from __future__ import annotations

from typing import Final

AHEAD_US_MAX: Final = 24 * 3600 * 1_000_000
"""Versions are us of operators' clocks, which differ by less than a day. A robot that tells of a later order
lies, and must not push versions so far that no order can have a greater one; nor must an operator whose clock
is wrong."""


def can_be(version: int, now_ns: int) -> bool:
    """Whether an order of that version can have been given by now, wall clock."""
    return version <= now_ns // 1_000 + AHEAD_US_MAX
