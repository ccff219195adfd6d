"""Detours: the way out where a robot's place lies straight behind what it must keep away from (PURE).

A one-sided constraint only pushes back, so a robot that makes straight for its place can come to rest in
front of a wall, or of another robot that does likewise: the pull and the push cancel. One that has been
blocked so for a while goes round: its wanted velocity is turned along what blocks it, always the same way
round. That ends when it has turned back as far as it has turned away and the direct way is free: Pledge's
algorithm (Abelson and diSessa, "Turtle Geometry", 1981), which gets out of traps. Round another robot, which
may go away itself, it ends as soon as the direct way is free. See (D1) to (D3) of docs/theory.md.

It begins on the side to which its place is nearer. Where neither is, it keeps to the right: so do others, and
two that meet pass each other.
"""

from __future__ import annotations

from math import atan2, cos, hypot, remainder, sin, tau
from typing import Final, NamedTuple

from agent.common.quantities import Vector

PATIENCE_S: Final = 0.8
"""A robot is blocked after so long by what stands still for good."""
PATIENCE_WITH_ROBOTS_S: Final = 4.0
"""By other robots: in a crowd, ways open as all move on, and going round in it keeps others from theirs."""
STALLED: Final = 0.3
"""It stalls below this share of the velocity that it wants."""
SPEED_MIN: Final = 0.08
"""m/s: a robot that wants to go slower is about there."""
AGAINST: Final = 0.1
"""What opposes a direction by less than this (cosine) does not block it."""
FREE_S: Final = 0.4
"""The direct way has to be free for so long before it is taken."""
ROUND_S: Final = 20.0
"""After so long on one side it tries the other, and then the first one for twice as long, and so on."""
KEEPS_S: Final = 20.0
"""Held up again so soon after, it keeps the side: changing it would lead from one arm of a comb to the next
and back."""
TURN: Final = 1.5
"""rad/s: how fast it turns round a corner that it has lost."""
STEER: Final = 3.0
"""rad/s: how fast the direction that is asked for turns; a body cannot turn at once, and would swing."""
HUG: Final = 0.05
"""How much it leans against what it follows; less than `AGAINST`."""


class Blocker(NamedTuple):
    """What is near: unit vector away from it (W), its name, and whether it stands still for good."""

    nx: float
    ny: float
    name: str
    fixed: bool


class Detour:
    """The detours of one robot.

    Attributes:
        round: name of what it goes round, "" on the direct way.
        fixed: whether it is on its way round something that stands still for good: there it has to turn
            sharply, at corners that nothing but their own clearance leads it round.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._blocked_s = self._free_s = self._round_s = 0.0
        self._side = self._angle = self._steered = 0.0
        self.fixed = False
        self._patience_s = ROUND_S
        self._since_s = KEEPS_S
        self.round = ""

    def reset(self) -> None:
        """Ends any detour: the robot does not drive, or is at its place."""
        self._blocked_s, self._since_s = 0.0, KEEPS_S
        self.round, self.fixed = "", False

    def velocity(self, wanted: Vector, own: Vector, blockers: list[Blocker]) -> Vector | None:
        """The velocity to aim at instead of `wanted` for one tick, None for `wanted` itself; m/s, W.

        Args:
            own: the hand's velocity.
            blockers: all that the robot is being kept away from.
        """
        speed = hypot(*wanted)
        if speed < SPEED_MIN:
            self.reset()
            return None
        heading = wanted[0] / speed, wanted[1] / speed
        first = _against(heading, blockers)
        if not self.round:
            self._since_s += self._period_s
            stalls = own[0] * heading[0] + own[1] * heading[1] < STALLED * speed
            self._blocked_s = self._blocked_s + self._period_s if first is not None and stalls else 0.0
            if first is None or self._blocked_s < (PATIENCE_S if first.fixed else PATIENCE_WITH_ROBOTS_S):
                return None
            self._begin(heading, first)
        x, y = self._follow(heading, first, blockers)
        return (speed * x, speed * y) if self.round else None

    def _begin(self, heading: Vector, first: Blocker) -> None:
        self.round = first.name
        if self._since_s >= KEEPS_S:
            # Side 1 passes what blocks it on the right. Straight in front neither side is nearer.
            leftwards = first.ny * heading[0] - first.nx * heading[1]
            self._side = -1.0 if leftwards > AGAINST else 1.0
            self._round_s, self._patience_s = 0.0, ROUND_S
        self._free_s = self._angle = self._steered = 0.0
        self.fixed = False

    def _follow(self, heading: Vector, first: Blocker | None, blockers: list[Blocker]) -> Vector:
        """Direction along what blocks it; ends the detour where the direct way is free for good."""
        side, period_s = self._side, self._period_s
        self._round_s += period_s
        if self._round_s > self._patience_s:
            self._side = side = -side
            self._round_s, self._angle = 0.0, 0.0
            self._patience_s *= 2.0
        if first is not None:
            self.round = first.name
        self.fixed |= any(blocker.fixed for blocker in blockers)
        turned = _turned(heading, self._angle)
        blocker = _against(turned, blockers)
        if blocker is None:
            # What it follows falls back behind a corner: round it, and back to the direct way.
            angle = self._angle + side * TURN * period_s
        else:
            angle = self._angle
            for _ in blockers:
                along = -side * blocker.ny - HUG * blocker.nx, side * blocker.nx - HUG * blocker.ny
                angle = self._unwrapped(heading, along, angle)
                blocker = _against(_turned(heading, angle), blockers)
                if blocker is None:
                    break
            else:  # no way round on this side: to turn on and on is no way either
                angle = self._angle
        if side * angle > 0.0:
            angle = 0.0
        self._angle = angle
        free = first is None and (angle == 0.0 or not self.fixed)
        self._free_s = self._free_s + period_s if free else 0.0
        if self._free_s >= FREE_S:
            self.reset()
            self._since_s = 0.0
        most = STEER * period_s
        self._steered += max(-most, min(most, angle - self._steered))
        return _turned(heading, self._steered)

    def _unwrapped(self, heading: Vector, along: Vector, near: float) -> float:
        """Angle from `heading` to `along`, counter-clockwise, of those the one nearest to `near`."""
        across = heading[0] * along[1] - heading[1] * along[0]
        angle = atan2(across, heading[0] * along[0] + heading[1] * along[1])
        return near + remainder(angle - near, tau)


def _turned(heading: Vector, angle: float) -> Vector:
    c, s = cos(angle), sin(angle)
    return c * heading[0] - s * heading[1], s * heading[0] + c * heading[1]


def _against(heading: Vector, blockers: list[Blocker]) -> Blocker | None:
    """What opposes a direction most, None when nothing does."""
    most, found = -AGAINST, None
    for blocker in blockers:
        along = blocker.nx * heading[0] + blocker.ny * heading[1]
        if along < most:
            most, found = along, blocker
    return found
