"""Ways out for a robot that is held away from its place: round what blocks it, and out of a wrong rest point
(PURE).

A one-sided constraint or a half plane of the safety filter only pushes back, so a robot that makes straight
for its place can come to rest in front of a wall, of a robot that is dead, or of another one that does
likewise: the pull and the push cancel. One that has been blocked so for a while goes round: its wanted
velocity is turned along what blocks it, always the same way round. That ends when it has turned back as far
as it has turned away and the direct way is free: Pledge's algorithm (Abelson and diSessa, "Turtle Geometry",
1981), which gets out of traps. Round another robot, which may go away itself, or one that stands and is all
that it has met, it ends as soon as the direct way is free: its place goes on meanwhile, and who has
overtaken it would turn a whole circle more. Robots are passed as seen from the formation, which moves with
them; what stands still, as seen from the ground. See (D1) to (D3) of docs/theory.md.

It begins on the side to which its place is nearer. Where neither is, it keeps to the right: so do others, and
two that meet pass each other.

The law's own forces may be in balance beside the place, too: two neighbours in each other's places are held
apart by the edge between them, a folded triangle by its three. One that has been at rest so for a while lets
go of its edges, makes for its place by navigation and safety filter alone, and takes hold again where it is
near. All that are caught together do so, each by its own error. See (D4).
"""

from __future__ import annotations

from math import atan2, cos, hypot, inf, remainder, sin, sqrt, tau
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector

PATIENCE_S: Final = 0.8
"""A robot is blocked after so long by what stands still for good."""
PATIENCE_WITH_ROBOTS_S: Final = 4.0
"""By other robots: in a crowd, ways open as all move on, and going round in it keeps others from theirs."""
PATIENCE_LOOSE_S: Final = 1.0
"""By other robots, once it has let go of its edges: what it meets is whom it is to exchange places with."""
STALLED: Final = 0.3
"""It stalls below this share of the velocity that it wants."""
SPEED_MIN: Final = 0.08
"""m/s: a robot that wants to go slower is about there."""
AGAINST: Final = 0.1
"""What opposes a direction by less than this (cosine) does not block it."""
BESIDE: Final = 0.7
"""A robot further than this (sine) on the right is passed on the left."""
LEAVING: Final = 0.5
"""Who drives at most 60 degrees from straight away from something is leaving it (cosine)."""
LEAVES: Final = 0.6
"""So it drives, to leave it."""
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
HELD_S: Final = 8.0
"""After so long without getting on it is said what holds it."""
FORGETS: Final = 4.0
"""And so many times sooner it is forgotten when it gets on."""
CAUGHT_S: Final = 5.0
"""A robot is caught in a wrong rest point after so long."""
PULLS: Final = 0.7
"""Edges hold a robot when they take this share of what drives it to its place."""
PARTNERS: Final = 0.1
"""Who takes this share of that is one of those with whom it is caught."""
LOOSE_S: Final = 20.0
"""It takes its edges back after so long without having come near its place, and the next time after twice as
long, and so on."""
LET_GO_S: Final = 0.5
TAKE_HOLD_S: Final = 1.5
"""How long it takes until its edges are gone, and until they are back."""


class Blocker(NamedTuple):
    """What is near: unit vector away from it (W), its name, and whether it stands still for good.

    within: it is nearer than it may be, to where only driving away leads on.
    body: it is one robot, which alone is no trap.
    """

    nx: float
    ny: float
    name: str
    fixed: bool
    within: bool = False
    body: bool = False


class Hold(NamedTuple):
    """All that kept a robot's hand from what it wanted at a tick.

    blockers: what it was kept away from.
    waits: lanes that it has to keep in or out of: nobody counts with it anywhere else.
    pull: force of its own edges, m/s^2, W.
    robots: those at the other ends of its edges, with the force of each.
    astray: of its neighbours those that are off their places; only looked at while it `is_loose`.
    limits: names of what else the safety filter changed its command for.
    """

    blockers: list[Blocker]
    waits: list[Blocker]
    pull: Vector
    robots: list[tuple[int, Vector]]
    astray: frozenset[int]
    limits: tuple[str, ...]


NOTHING: Final = Hold([], [], (0.0, 0.0), [], frozenset(), ())


class Detour:
    """The ways out of one robot.

    Args:
        period_s: see below.
        rate: c_2 of (21), 1/s: how fast the velocity follows the one that is wanted.
        bound: whether it has edges that it can let go of.

    Attributes:
        period_s: of a tick.
        round: name of what it goes round, "" on the direct way.
        fixed: whether it is on its way round something that stands still for good: there it has to turn
            sharply, at corners that nothing but their own clearance leads it round.
        stalls: whether it does not get on: only then, and on a detour, it has to know what holds it.
        grip: 0..1, how far it holds on to its edges.
        held: what holds it and what it does about it, in words; "" when it is free.
    """

    def __init__(self, period_s: float, rate: float, *, bound: bool = True) -> None:
        self.period_s, self._rate, self._bound = period_s, rate, bound
        self._blocked_s = self._free_s = self._round_s = 0.0
        self._side = self._angle = self._steered = self._lost = 0.0
        self._patience_s = ROUND_S
        self._since_s = KEEPS_S
        self._held_s = self._shut_s = self._caught_s = self._loose_s = 0.0
        self._shut = ""
        self._met: set[str] = set()
        self._may_be_trap = False
        self._loose_max_s = LOOSE_S
        self._loose = False
        self._partners: frozenset[int] = frozenset()
        self._trap = ""
        self.fixed = self.stalls = False
        self.grip = 1.0
        self.round = self.held = ""

    def reset(self) -> None:
        """Ends all: the robot does not drive."""
        self._arrive()
        self._loose_max_s, self.grip = LOOSE_S, 1.0

    @property
    def is_loose(self) -> bool:
        """Whether it makes for its place without its edges."""
        return self._loose

    @property
    def looks(self) -> bool:
        """Whether it has to be told what holds it."""
        return self.stalls or self._loose or bool(self.round)

    def velocity(
        self, wanted: Vector, own: Vector, hold: Hold, place: Vector = (0.0, 0.0), most: float = inf
    ) -> Vector | None:
        """The velocity to aim at instead of `wanted` for one tick, None for `wanted` itself; m/s, W.

        Args:
            own: the hand's velocity.
            hold: what held it, of the last tick; only looked at while it `looks`.
            place: velocity of its place.
            most: as seen from its place it may go so fast, m/s: slower than it wants is no being held up.
        """
        x, y = wanted[0] - place[0], wanted[1] - place[1]
        speed = hypot(x, y)
        if self.grip < 1.0 and not self._loose:
            self.grip = min(1.0, self.grip + self.period_s / TAKE_HOLD_S)
        if speed < SPEED_MIN:
            if self._loose and hold.astray & self._partners and self._loose_s < self._loose_max_s:
                # Their edges would draw it off its place again, and next time them off theirs.
                self._loose_s += self.period_s
                self.free()
            elif self.looks or self._held_s:
                self._arrive()
            return None
        vx, vy = own[0] - place[0], own[1] - place[1]
        self.stalls = vx * x + vy * y < STALLED * speed * min(speed, most)
        if not self.round:
            self._since_s += self.period_s
            if not self.stalls:
                self._blocked_s = 0.0
        if self.looks or self._held_s:
            stands = hypot(*own) < SPEED_MIN or hypot(vx, vy) < SPEED_MIN
            self._name(hold, x / speed, y / speed, stands=stands)
            rests = hypot(vx, vy) < STALLED * min(speed, most)
            self._let_go(hold, x / speed, y / speed, speed, rests=rests)
            return self._detour(wanted, own, hold, place)
        return None

    def _arrive(self) -> None:
        """The robot is at its place: it takes hold, and goes round nothing."""
        self.free()
        self._caught_s = self._loose_s = 0.0
        self._loose = False

    def free(self) -> None:
        """Nothing is in its way."""
        self._blocked_s, self._since_s, self._held_s = 0.0, KEEPS_S, 0.0
        self.fixed = self.stalls = False
        self._shut_s, self._shut = 0.0, ""
        self.round = self.held = ""

    # ------------------------------------------------------------------ what holds it

    def _name(self, hold: Hold, ux: float, uy: float, *, stands: bool) -> None:
        """Says what holds a robot that does not get on in the direction (ux, uy), and `stands` maybe."""
        if self._loose:
            self.held = f"on its way out of {self._trap}"
        elif self.round:
            if not stands:
                self._shut_s, self._shut = 0.0, ""
            self._shut_s += self.period_s
            if self._shut_s >= HELD_S and not self._shut:
                self._shut = " and ".join(sorted({each.name for each in (*hold.blockers, *hold.waits)}))
            self.held = f"shut in by {self._shut}" if self._shut else f"on its way round {self.round}"
        if self._loose or self.round:
            return
        if not self.stalls:
            self._held_s = max(0.0, self._held_s - FORGETS * self.period_s)
            if self._held_s == 0.0:
                self.held = ""
            return
        self._held_s = min(HELD_S, self._held_s + self.period_s)
        if self._held_s < HELD_S:
            return
        blocker = _against((ux, uy), [*hold.blockers, *hold.waits])
        if self._caught_s >= CAUGHT_S:
            self.held = f"caught in {self._trap}"
        elif blocker is not None:
            self.held = f"held up by {blocker.name}"
        elif hold.limits:
            self.held = f"held back by its limit of {' and '.join(hold.limits)}"
        else:
            self.held = ""

    def _let_go(self, hold: Hold, ux: float, uy: float, speed: float, *, rests: bool) -> None:
        """Lets go of the edges of a robot that they keep from getting on, until it has come near its place.

        Args:
            ux, uy, speed: direction to its place, and how fast it would go there.
            rests: whether it is at rest in the formation.
        """
        period_s = self.period_s
        if self._loose:
            self._loose_s += period_s
            self.grip = max(0.0, self.grip - period_s / LET_GO_S)
            if self._loose_s > self._loose_max_s:
                self._loose, self._loose_s, self._caught_s = False, 0.0, 0.0
                self._loose_max_s *= 2.0
            return
        least = -PULLS * self._rate * speed
        if not self.stalls or hold.pull[0] * ux + hold.pull[1] * uy > least:
            self._caught_s = max(0.0, self._caught_s - period_s)
            return
        self._partners = frozenset(
            robot for robot, (fx, fy) in hold.robots if fx * ux + fy * uy < PARTNERS * least
        )
        self._caught_s = min(CAUGHT_S, self._caught_s + period_s)
        if self._caught_s >= CAUGHT_S:
            what = "a wrong rest point with" if rests else "the pull of"
            robots = ", ".join(map(str, sorted(self._partners)))
            self._trap = f"{what} robot{'s' * (len(self._partners) > 1)} {robots}"
            self._loose, self._loose_s = self._bound, 0.0

    # ------------------------------------------------------------------ the way round

    def _detour(self, wanted: Vector, own: Vector, hold: Hold, place: Vector) -> Vector | None:
        """As `velocity`, of a robot that does not get on or is on a detour."""
        blockers = hold.blockers
        if not self.round:
            first = self._blocking(wanted, own, blockers, place)
            if first is None:
                self._blocked_s = 0.0
                return None
            self._blocked_s += self.period_s
            with_robots_s = PATIENCE_LOOSE_S if self._loose else PATIENCE_WITH_ROBOTS_S
            if self._blocked_s < (PATIENCE_S if first.fixed else with_robots_s):
                return None
            self._begin(_heading(wanted, (0.0, 0.0) if first.fixed else place), first)
        if not self.fixed and any(blocker.fixed for blocker in blockers):
            self.fixed = True
        frame = (0.0, 0.0) if self.fixed else place
        speed = hypot(wanted[0] - frame[0], wanted[1] - frame[1])
        heading = _heading(wanted, frame)
        ahead = [each for each in blockers if each.fixed] if self.fixed else blockers
        x, y = self._follow(heading, _against(heading, ahead), blockers)
        return (frame[0] + speed * x, frame[1] + speed * y) if self.round else None

    def _blocking(
        self, wanted: Vector, own: Vector, blockers: list[Blocker], place: Vector
    ) -> Blocker | None:
        """What keeps it from getting on: what stands still as seen from the ground, robots from its place."""
        for fixed, (px, py) in ((True, (0.0, 0.0)), (False, place)):
            x, y = wanted[0] - px, wanted[1] - py
            square = x * x + y * y
            if square > 0.0 and (own[0] - px) * x + (own[1] - py) * y < STALLED * square:
                found = _against(
                    _heading(wanted, (px, py)), [each for each in blockers if each.fixed is fixed]
                )
                if found is not None:
                    return found
        return None

    def _begin(self, heading: Vector, first: Blocker) -> None:
        self.round = first.name
        if self._since_s >= KEEPS_S:
            self._round_s, self._patience_s = 0.0, ROUND_S
        if self._since_s >= KEEPS_S or not first.fixed:
            self._side = _side(heading, first)
        self._free_s = self._angle = self._steered = self._lost = 0.0
        self.fixed = self._may_be_trap = False
        self._met.clear()

    def _follow(self, heading: Vector, first: Blocker | None, blockers: list[Blocker]) -> Vector:
        """Direction along what blocks it; ends the detour where the direct way is free for good.

        Turns are counted along what stands still alone: robots that are met on the way round it move, and how
        often they were gone round says nothing of the way out.
        """
        side, period_s = self._side, self.period_s
        self._round_s += period_s
        if self._round_s > self._patience_s:
            side = -side
            self._round_s, self._angle = 0.0, 0.0
            self._patience_s *= 2.0
        if first is not None:
            if first.name != self.round and not self.fixed:
                side = _side(heading, first)  # of whom it meets now
            self.round = first.name
        self._side = side
        followed = [each for each in blockers if each.fixed] if self.fixed else blockers
        for each in followed:
            self._met.add(each.name)
            self._may_be_trap |= not each.body or len(self._met) > 1
        angle = self._along(heading, self._angle, followed)
        if followed:
            self._lost = 0.0
        if angle is None:
            # What it follows falls back behind a corner: round it, and back to the direct way.
            angle = self._angle + side * TURN * period_s
            self._lost += TURN * period_s
        if side * angle > 0.0:
            angle = 0.0
        self._angle = angle
        free = first is None and (angle == 0.0 or not (self.fixed and self._may_be_trap))
        self._free_s = self._free_s + period_s if free else 0.0
        if self._free_s >= FREE_S or self._lost > tau:  # a whole turn without anything: there is no corner
            self._blocked_s, self._since_s = 0.0, 0.0
            self.round, self.held, self.fixed = "", "", False
        if len(followed) < len(blockers):
            passing = self._along(heading, angle, blockers)
            angle = angle if passing is None else passing
        most = STEER * period_s
        self._steered += max(-most, min(most, angle - self._steered))
        return _turned(heading, self._steered)

    def _along(self, heading: Vector, angle: float, blockers: list[Blocker]) -> float | None:
        """The angle from `heading`, near `angle`, at which nothing opposes any more; None where nothing does.

        Where there is no way round on this side `angle` stays: to turn on and on is no way either.
        """
        blocker = _against(_turned(heading, angle), blockers)
        if blocker is None:
            return None
        side, turned = self._side, angle
        for _ in blockers:
            lean, across = (LEAVES, sqrt(1.0 - LEAVES * LEAVES)) if blocker.within else (-HUG, 1.0)
            along = (
                -side * across * blocker.ny + lean * blocker.nx,
                side * across * blocker.nx + lean * blocker.ny,
            )
            turned = self._unwrapped(heading, along, turned)
            blocker = _against(_turned(heading, turned), blockers)
            if blocker is None:
                return turned
        return angle

    def _unwrapped(self, heading: Vector, along: Vector, near: float) -> float:
        """Angle from `heading` to `along`, counter-clockwise, of those the one nearest to `near`."""
        across = heading[0] * along[1] - heading[1] * along[0]
        angle = atan2(across, heading[0] * along[0] + heading[1] * along[1])
        return near + remainder(angle - near, tau)


def _heading(wanted: Vector, frame: Vector) -> Vector:
    """Direction of a velocity as seen from a frame that moves."""
    x, y = wanted[0] - frame[0], wanted[1] - frame[1]
    speed = hypot(x, y)
    return (x / speed, y / speed) if speed > 0.0 else (1.0, 0.0)


def _turned(heading: Vector, angle: float) -> Vector:
    c, s = cos(angle), sin(angle)
    return c * heading[0] - s * heading[1], s * heading[0] + c * heading[1]


def _side(heading: Vector, blocker: Blocker) -> float:
    """1 to pass it on the right, -1 on the left.

    What stands still is passed on the side to which the place is nearer. Robots keep to the right even where
    the left is a little nearer: two that take mirrored ways would go on beside each other for ever.
    """
    leftwards = blocker.ny * heading[0] - blocker.nx * heading[1]
    return -1.0 if leftwards > (AGAINST if blocker.fixed else BESIDE) else 1.0


def _against(heading: Vector, blockers: list[Blocker]) -> Blocker | None:
    """What opposes a direction most, None when nothing does."""
    most, found = 0.0, None
    for blocker in blockers:
        along = blocker.nx * heading[0] + blocker.ny * heading[1] + AGAINST
        if blocker.within:
            along -= AGAINST + LEAVING
        if along < most:
            most, found = along, blocker
    return found
