"""Robots that are not heard, and where those that hear each other believe them to be: from beacons (PURE)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import hypot, inf
from typing import Any, Final, NamedTuple

from handfast.agent.common.time import NS_PER_MS, NS_PER_S
from handfast.agent.messages.types import SILENT_MAX, Beacon, Removed, Silent
from handfast.deploy.console.wording import FEW, robots

SILENT_NS: Final = 2 * NS_PER_S
"""Who has sent no beacon for so long after the next one was due is not heard."""
SHOWN_M: Final = 0.05
"""Ways and doubts that are smaller are left out of words."""
KEPT_NS: Final = 5 * NS_PER_S
"""What a beacon says of others holds for so long: where they are many, each beacon names some of them."""


class SilentBody(NamedTuple):
    """A robot that is not heard.

    Attributes:
        robot: its number.
        silent_s: for how long; None where nobody has heard it since the drive began.
        x, y, to_x, to_y: ends of the straight way on which its hand is believed to be, m (W).
        doubt_m: how far it may be to either side of that.
        told_by: the robots that do not hear it; empty where nobody says so.
        heard: whether who collects this hears it all the same.
    """

    robot: int
    silent_s: float | None
    x: float
    y: float
    to_x: float
    to_y: float
    doubt_m: float
    told_by: tuple[int, ...]
    heard: bool

    @property
    def how_long(self) -> str:
        """For how long it has not been heard, in words."""
        if self.silent_s is None:
            return "since the drive began"
        return "for less than 1 s" if self.silent_s < 1.0 else f"for {self.silent_s:.0f} s"

    @property
    def where(self) -> str:
        """Where it is believed to be, in words."""
        text = f"at ({self.x:.2f}, {self.y:.2f})"
        if hypot(self.to_x - self.x, self.to_y - self.y) > SHOWN_M:
            text = f"between ({self.x:.2f}, {self.y:.2f}) and ({self.to_x:.2f}, {self.to_y:.2f})"
        return text + (f", give or take {self.doubt_m:.2f} m" if self.doubt_m > SHOWN_M else "")

    def __str__(self) -> str:
        by = ""
        if self.told_by:
            by = f" (not by {robots(self.told_by)})"
        return f"robot {self.robot} {self.how_long}{by}, believed {self.where}"

    @property
    def row(self) -> dict[str, Any]:
        """As JSON values."""
        return {**self._asdict(), "told_by": list(self.told_by)}


class SilentBodies:
    """What the beacons of a fleet say of robots that are not heard."""

    def __init__(self) -> None:
        self._newest: dict[int, Beacon] = {}
        self._rows: dict[tuple[int, int], tuple[int, Silent]] = {}
        """By sender and robot: the last row, and when it was sent."""

    def hear(self, beacon: Beacon) -> None:
        """Takes a beacon; an old one is ignored."""
        known = self._newest.get(beacon.robot)
        if known is not None and beacon.time_ns <= known.time_ns:
            return
        self._newest[beacon.robot] = beacon
        if len(beacon.silent) < SILENT_MAX:  # they are all that it knows of
            self.forget(beacon.robot)
        for row in beacon.silent:
            self._rows[beacon.robot, row.robot] = beacon.time_ns, row

    def forget(self, robot: int) -> None:
        """What a robot said of others does not hold any more."""
        for sender, other in list(self._rows):
            if sender == robot:
                del self._rows[sender, other]

    @property
    def senders(self) -> int:
        """How many robots have sent a beacon."""
        return len(self._newest)

    def bodies(self, removed: Iterable[Removed] = ()) -> list[SilentBody]:
        """All robots that somebody who is heard does not hear, in the order of their numbers.

        Args:
            removed: whose bodies somebody has carried off the field.
        """
        if not self._newest:
            return []
        now_ns = max(beacon.time_ns for beacon in self._newest.values())
        heard = {
            robot
            for robot, each in self._newest.items()
            if now_ns - each.time_ns <= SILENT_NS + each.next_ms * NS_PER_MS
        }
        deaf: dict[int, list[int]] = {}
        for sender in sorted(heard):
            for robot in self._newest[sender].unheard:
                deaf.setdefault(robot, []).append(sender)
        told: dict[int, list[tuple[int, int, Silent]]] = {}
        for (sender, robot), (said_ns, row) in self._rows.items():
            if sender in heard and said_ns > self._newest[sender].time_ns - KEPT_NS:
                # By the sender's own clock, which stamped both.
                told.setdefault(robot, []).append((said_ns - row.time_ns, sender, row))
        gone = {
            each.robot
            for each in removed
            if each.robot not in self._newest or self._newest[each.robot].time_ns <= each.time_ns
        }
        found = []
        for robot in sorted({*deaf, *(told.keys() - heard), *(self._newest.keys() - heard)} - gone):
            age_ns: int | None
            if robot in told:
                age_ns, _, row = min(told[robot], key=lambda each: each[:2])
                age_ns = age_ns if row.time_ns else None
                way = row.x, row.y, row.to_x, row.to_y, row.doubt
            elif robot in self._newest:
                own = self._newest[robot]
                age_ns, way = now_ns - own.time_ns, (own.x, own.y, own.x, own.y, own.doubt)
            else:
                continue  # it was never heard: nothing is known but what the fleet file says
            by = tuple(deaf.get(robot, ()))
            silent_s = None if age_ns is None else age_ns / NS_PER_S
            found.append(SilentBody(robot, silent_s, *way, by, robot in heard))
        return found


def in_words(bodies: Iterable[SilentBody], each_max: int = FEW) -> list[str]:
    """Lines for people: each robot that nobody hears, or one for all if they are more than `each_max`; and
    all at once those that only some do not hear."""
    bodies = list(bodies)
    unheard = [body for body in bodies if not body.heard]
    lines = [f"not heard: {body}" for body in unheard]
    if len(unheard) > each_max:
        longest = max(unheard, key=lambda body: inf if body.silent_s is None else body.silent_s)
        most = longest.how_long.replace("for ", "for up to ")
        lines = [f"not heard: {robots([body.robot for body in unheard])} {most}"]
    partly = [body for body in bodies if body.heard]
    if partly:
        lines.append(f"not heard by all others: {robots([body.robot for body in partly])}")
    return lines


def bodies_of(beacons: Mapping[int, Iterable[Beacon]], removed: Iterable[Removed] = ()) -> list[SilentBody]:
    """The silent by the beacons of each robot, in their order; `removed` as for `SilentBodies.bodies`."""
    heard = SilentBodies()
    for each in beacons.values():
        for beacon in each:
            heard.hear(beacon)
    return heard.bodies(removed)
