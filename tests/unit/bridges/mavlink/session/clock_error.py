"""How well a `BootClock` knows the vehicle's time, which only tests ask."""

from __future__ import annotations

from handfast.bridges.mavlink.session.boot_clock import BootClock


def error_ns(clock: BootClock) -> int | None:
    """How far off a wall time that the clock gives may be, ns; None before the first exchange."""
    if clock._low_ns is None or clock._high_ns is None:
        return None
    return (clock._high_ns - clock._low_ns + 1) // 2
