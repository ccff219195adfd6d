"""Versions of orders, as far as all have to agree on them (PURE)."""

from __future__ import annotations

from typing import Final

from handfast.agent.messages.types import Mission, Resume, Stop

AHEAD_US_MAX: Final = 24 * 3600 * 1_000_000
"""Versions are us of operators' clocks, which differ by less than a day. A robot that tells of a later order
lies, and must not push versions so far that no order can have a greater one; nor must an operator whose clock
is wrong."""


def can_be(version: int, now_ns: int) -> bool:
    """Whether an order of that version can have been given by now, wall clock."""
    return version <= now_ns // 1_000 + AHEAD_US_MAX


def least_believed(version: int, now_ns: int) -> int:
    """The least version as which who hears a stop at `now_ns` or later takes it."""
    return version if can_be(version, now_ns) else now_ns // 1_000


def as_believed(order: Mission | Resume | Stop, now_ns: int) -> Mission | Resume | Stop | None:
    """An order as who hears it at `now_ns`, wall clock, takes it: a stop that cannot have been given by now
    is one that is given now, anything else of the kind is none."""
    if can_be(order.version, now_ns):
        return order
    return order._replace(version=now_ns // 1_000) if isinstance(order, Stop) else None
