"""Versions of orders, as far as operators have to agree on them (PURE)."""

from __future__ import annotations

from typing import Final

AHEAD_US_MAX: Final = 24 * 3600 * 1_000_000
"""Versions are us of operators' clocks, which differ by less than a day. A robot that tells of a later order
lies, and must not push versions so far that no order can have a greater one."""
