"""How a rover steers, by what its outputs do (SERVOn_FUNCTION), and which of them to read to know (PURE).

The law asks for turns at a standstill. A vehicle with a throttle on each side can (skid steering), and so can
one with the mixer of an omnidirectional frame (FRAME_TYPE above 0); one that steers by its front wheels, or
by a rudder, cannot.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

GROUND_STEERING: Final = 26
THROTTLE: Final = 70
THROTTLE_LEFT: Final = 73
THROTTLE_RIGHT: Final = 74
OUTPUTS: Final = 16
FRAME_TYPE: Final = "FRAME_TYPE"


def function(output: int) -> str:
    """The parameter that says what an output does."""
    return f"SERVO{output}_FUNCTION"


USUAL: Final = function(1), function(3)
"""Where ArduPilot has throttle left and right by custom, and steering and throttle by default."""
ALL: Final = tuple(function(output) for output in range(1, OUTPUTS + 1))
_FURTHER: Final = (
    (function(2), function(4)),
    tuple(function(output) for output in range(5, OUTPUTS + 1)),
)
"""What is read when the usual ones do not settle it, the likelier ones first: each read costs the link."""

Values = Mapping[str, float | None]
"""Of parameters by name; None: not told, missing: not read."""


def _with(values: Values, wanted: int) -> str:
    """The first parameter of an output that does this, "" none."""
    return next((name for name in ALL if values.get(name) == wanted), "")


def turns_on_the_spot(values: Values) -> bool:
    """Whether the vehicle is known to turn at a standstill."""
    sides = _with(values, THROTTLE_LEFT) and _with(values, THROTTLE_RIGHT)
    return bool(sides) or (values.get(FRAME_TYPE) or 0.0) > 0.0


def to_read(values: Values) -> tuple[str, ...]:
    """The parameters to read next, () when it is settled, or cannot be.

    One with steering and throttle is settled: with those of both sides besides, ArduPilot does not arm it. Of
    a vehicle that tells none of the usual ones nothing more is asked, nor while those are still to come.
    """
    told = [values.get(name) for name in USUAL if name in values]
    if len(told) < len(USUAL) or not any(value is not None for value in told):
        return ()
    if turns_on_the_spot(values):
        return ()
    if FRAME_TYPE not in values:
        return (FRAME_TYPE,)
    if trouble(values):
        return ()
    return next((names for names in _FURTHER if not all(name in values for name in names)), ())


def trouble(values: Values) -> str:
    """Why it cannot turn at a standstill, "" while nothing says so."""
    ahead = _with(values, GROUND_STEERING)
    if turns_on_the_spot(values) or not ahead or not _with(values, THROTTLE):
        return ""
    return f"it steers by its front wheels ({ahead} {GROUND_STEERING})"
