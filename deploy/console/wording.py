"""Lists of robots, limits and errors in messages: short, and in good English."""

from __future__ import annotations

import traceback
from collections.abc import Iterable
from typing import Any, Final

from agent.control.safety_distances import speed_max
from agent.fleet.model import Fleet

NAMES_SHOWN: Final = 8
FEW: Final = 20
"""Of so many hosts or robots each has a line of its own; more are summed up, but for those where something is
wrong."""


def robots(ids: Iterable[Any]) -> str:
    """'robot 3', 'robots 1, 2 and 3', or 'robots 1, 2, 3, 4, 5, 6, 7, 8 and 37 more'."""
    shown = list(ids)
    if 1 < len(shown) <= NAMES_SHOWN:
        return f"robots {some(shown[:-1])} and {shown[-1]}"
    return f"robot{'s' * (len(shown) != 1)} {some(shown)}"


def counted(name: str, numbers: Iterable[Any]) -> str:
    """Numbered things as a subject: 'leg 2 is' or 'legs 2, 3 are'."""
    shown = list(numbers)
    return f"{name} {some(shown)} is" if len(shown) == 1 else f"{name}s {some(shown)} are"


def some(ids: Iterable[Any]) -> str:
    """The first few of a list: '1, 2, 3', or '1, 2, 3, 4, 5, 6, 7, 8 and 37 more'."""
    shown = [str(number) for number in ids]
    text = ", ".join(shown[:NAMES_SHOWN])
    return f"{text} and {len(shown) - NAMES_SHOWN} more" if len(shown) > NAMES_SHOWN else text


def clock_ahead(by_s: float) -> str:
    """What is wrong with a clock whose orders no robot believes."""
    return (
        f"set this machine's clock: it is {by_s / 3600.0:.0f} h ahead of the robots', which believe no order "
        "of it but a stop"
    )


def clock_behind(by_s: float) -> str:
    """What is wrong with a clock for which robots' certificates, and what they said, are of the future."""
    by = f"{by_s / 3600.0:.0f} h" if by_s >= 5400.0 else f"{by_s / 60.0:.0f} min"
    return f"set this machine's clock: it is {by} behind the robots'"


def error_text(error: Exception, before: str = "") -> str:
    """An exception on one line, with the place that it comes from."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({frames[-1].filename.rpartition('/')[2]}, line {frames[-1].lineno})" if frames else ""
    return " ".join(f"{before}{type(error).__name__}: {error}".split())[:300] + where


def speed_limit(fleet: Fleet) -> str:
    """What limits the speed of a fleet's robots, by the name of its field."""
    control = fleet.control
    most = speed_max(fleet)
    if most < control.max_speed_mps:
        return (
            f"the {most:.4g} m/s at which control.max_acceleration = {control.max_acceleration:.4g} can steer"
        )
    return f"control.max_speed_mps = {control.max_speed_mps:.4g}"
