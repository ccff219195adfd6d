"""A picture of a fleet in words: for a line now and then, or what stands above a table."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from handfast.agent.supervision.state_machine import State
from handfast.deploy.console.wording import NAMES_SHOWN, some
from handfast.deploy.drive.watch import Picture, RobotPicture

REASONS_MAX: Final = 3
"""Robots that are released, lag, or are silent, of which more is said than their numbers."""
PARTS_MAX: Final = 4
"""Of many robots in one state so many numbers, or ranges of numbers, are named: there are several states."""
_LAST_NAME: Final = re.compile(r"robot \d+$")
FAULTS_MAX: Final = 4
"""Faults that are named; of more only the number is said."""


def summary(picture: Picture) -> str:
    """One line of all `parts`."""
    return ", ".join(parts(picture))


def clock_words(about: RobotPicture) -> str:
    """What is wrong with another's clock in a robot's eyes, "" for nothing."""
    if about.clock is None:
        return ""
    robot, ahead_s = about.clock
    return f"clock of robot {robot} {abs(ahead_s) * 1e3:.0f} ms {'ahead' if ahead_s > 0 else 'behind'}"


def packed(texts: Iterable[str], width: int) -> list[str]:
    """Texts on as few lines as have room for them, none of them broken that fits a line by itself."""
    lines: list[str] = []
    for text in texts:
        if lines and len(lines[-1]) + 2 + len(text) < width:
            lines[-1] += f", {text}"
        else:
            lines[-1:] = [*(f"{line}," for line in lines[-1:]), text]
    return lines


def parts(picture: Picture) -> list[str]:
    """Worst edge, closest pair, oldest message, how many robots are in which state, and what is wrong."""
    found: list[str] = []
    if picture.worst is not None:
        found.append("worst edge {:.3f} m off ({}-{})".format(*picture.worst))
    if picture.nearest is not None:
        found.append("closest {:.3f} m ({}-{})".format(*picture.nearest))
    if picture.oldest_ms is not None:
        found.append(f"oldest message {picture.oldest_ms:.0f} ms")
    states: dict[str, list[int]] = {}
    for robot, about in picture.robots.items():
        states.setdefault(about.state or "silent", []).append(robot)
    for state, robots in states.items():
        if state == State.RELEASED.value and len(robots) <= REASONS_MAX:
            shown = ", ".join(f"{robot} ({picture.robots[robot].reason})" for robot in robots)
        elif len(states) == 1:
            heard_s = min(
                (about.silent_s for about in picture.robots.values() if about.silent_s), default=None
            )
            found.append(f"all {state}" + (f" (nothing heard for {heard_s:.0f} s)" if heard_s else ""))
            continue
        elif len(robots) > NAMES_SHOWN:
            shown = f"{len(robots)} ({some(robots, PARTS_MAX)})"
        else:
            shown = some(robots)
        found.append(f"{state}: {shown}")
    if picture.lagging:
        found.append(f"off place: {_lags(picture)}")
    # Both of a pair see it: the one whose clock is behind says it.
    ahead = {robot: about for robot, about in picture.robots.items() if about.clock and about.clock[1] > 0.0}
    if ahead:
        robot, about = max(ahead.items(), key=lambda item: item[1].clock[1] if item[1].clock else 0.0)
        found.append(f"{clock_words(about)} of robot {robot}'s")
    return found


def _lags(picture: Picture) -> str:
    """Who lags, how far each is from its place, and what it says of that; of many only the numbers."""
    robots = {robot: picture.robots[robot] for robot in picture.lagging}
    silent = {f"robot {body.robot}": body.how_long for body in picture.silent}

    def why(about: RobotPicture) -> str:
        named = _LAST_NAME.search(about.reason)
        how_long = silent.get(named[0]) if named else None
        return about.reason + (f", silent {how_long}" if how_long else "")

    if len(robots) > REASONS_MAX:
        most_m = max(about.off_m or 0.0 for about in robots.values())
        return f"{some(sorted(robots))} by up to {most_m:.2f} m"
    return ", ".join(
        f"{robot} by {about.off_m:.2f} m" + (f" ({why(about)})" if about.reason else "")
        for robot, about in robots.items()
    )


def faults_line(picture: Picture) -> str:
    """The faults that hold now on one line, empty without any."""
    if not picture.faults:
        return ""
    more = len(picture.faults) - FAULTS_MAX
    named = "; ".join(picture.faults[:FAULTS_MAX])
    return f"faults: {named}" + (f"; and {more} more" if more > 0 else "")
