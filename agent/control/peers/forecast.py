"""Where the other robots go from a message on, if they do as they are to (PURE).

One step of it is in `agent.control.peers.prediction`, exact for a pull whose direction does not change.
Longer ways are made of such steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from math import ceil, exp, hypot, inf
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_MS, NS_PER_S
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.beliefs import Belief, Lane, own_doubt, rolled_on, stood_on
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.prediction import (
    Prediction,
    Transition,
    coasting,
    following,
    slowed,
    transition,
    unforced,
)
from handfast.agent.control.peers.rolling import (
    ROLL_ERROR,
    Rolls,
    arc_of,
    begin_of,
    is_somewhere_on,
    moves,
    rolled,
)
from handfast.agent.formation.reference import Instant, Reference
from handfast.agent.formation.trajectory import Sample
from handfast.agent.messages.types import HandState

DRIVEN_MAX: Final = 1.0
"""m: so far from its last word, and no further than it drives in a second, is a robot looked for that
somebody else drove."""
STEP_S: Final = 0.1
"""Between two places of the way on which a robot is looked for."""
LANE_STEP_S: Final = 0.5
LANE_STEPS_MAX: Final = 120
"""The way to its place is followed in so many such steps at most;"""
AT_PLACE: Final = 0.1
"""m: nearer than this it is there."""

_STEPS_KEPT: Final = 256
"""By age: few are asked for in a tick, and the same ones in the next."""

Instants = Callable[[int], Instant]
"""Wall time ns -> the desired motion of all: `agent.formation.reference.Reference.instant`."""


class _Step:
    """A `Transition` that is kept: in C a tuple of floats in a dictionary is seven objects, this is one."""

    __slots__ = ("of",)

    def __init__(self, of: Transition) -> None:
        self.of: Final[Transition] = of


class Course:
    """Where the way of a robot begins: at a message, and what its desired motion was then.

    Attributes:
        message: the robot's.
        time_ns: of the message, or the epoch if that is later; ns, by the robot's clock.
        motion: the desired motion at that time, if it had a place (`had_place`): m, m/s, m/s^2, W.
    """

    __slots__ = "had_place", "message", "motion", "time_ns"

    def __init__(self, message: HandState, time_ns: int, motion: Sample, *, had_place: bool = True) -> None:
        self.message: Final = message
        self.time_ns: Final = time_ns
        self.motion: Final[Sample] = motion  # without None in it, in C no object for each float
        self.had_place: Final = had_place


class Forecast:
    """How the robots of a fleet move.

    Args:
        c1, c2: navigation gains (21) of all.
        instants: desired motion of every robot.

    Attributes:
        decay: of a robot's constraint force, 1/s (`agent.control.peers.prediction.constraint_decay`).
        most: speed limit of all (m/s) by which they make for their places (N1), None without one.
        speeding: how fast they come to that from far, 1/s, (N2).
        epoch_ns: a message from before is of a robot that stands until then.
    """

    def __init__(
        self,
        c1: float,
        c2: float,
        instants: Instants,
        decay: float,
        most: float | None,
        speeding: float = 0.0,
        rolls_on: Mapping[int, Rolls] | None = None,
    ) -> None:
        self._c1, self._c2, self._instants = c1, c2, instants
        self.decay, self.most, self.speeding = decay, most, speeding
        self._rolls_on = rolls_on or {}
        self.epoch_ns = 0
        self._steps: dict[int, _Step] = {}
        self._free_steps: dict[int, _Step] = {}
        """By age, ns: of `decay`, and without any."""
        self._steps_decay = decay

    def following(
        self, message: HandState, then_ns: int, instants: Instants | None = None, *, slowly: float = inf
    ) -> Prediction | None:
        """A robot at a time of its own clock if it follows its reference, None for one without a place.

        Args:
            instants: the reference that it follows, unless that of this forecast.
            slowly: as seen from its place it goes no faster than this, m/s.
        """
        if instants is None:
            instants = self._instants
        robot, at = message.robot, instants(then_ns)
        if robot not in at.offsets:
            return None
        then = at.motion(robot)
        since_ns = message.time_ns if message.time_ns > self.epoch_ns else self.epoch_ns
        if since_ns >= then_ns:
            return self._carried(message, then, then, 0, slowly)
        before = instants(since_ns)
        since = before.motion(robot) if robot in before.offsets else then
        return self._carried(message, since, then, then_ns - since_ns, slowly)

    def course(self, message: HandState) -> Course:
        """Where the way of a robot begins that is asked for at many times, by `on`: what belongs to its
        message is looked up once."""
        since_ns = max(message.time_ns, self.epoch_ns)
        at = self._instants(since_ns)
        if message.robot not in at.offsets:
            return Course(message, since_ns, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), had_place=False)
        return Course(message, since_ns, at.motion(message.robot))

    def on(self, course: Course, then_ns: int, at: Instant) -> Prediction:
        """As `following`, of one that has a place in `at`, the desired motion of all at `then_ns` (ns)."""
        then = at.motion(course.message.robot)
        if course.time_ns >= then_ns:
            return self._carried(course.message, then, then, 0, inf)
        since = course.motion if course.had_place else then
        return self._carried(course.message, since, then, then_ns - course.time_ns, inf)

    def _carried(
        self, message: HandState, since: Sample, then: Sample, age_ns: int, slowly: float
    ) -> Prediction:
        """As `following`, of one whose desired motion is `then`, and was `since` as long ago. One that has a
        place only since its message is taken to have come to it as it is there now: since is then."""
        age, decay = age_ns * 1e-9, self.decay
        step = self._step(age_ns, decay)
        found = following(
            message, then, since, age, self._c1, self._c2, decay, self.most, self.speeding, step
        )
        return (
            found
            if slowly == inf or age * NS_PER_S <= UNSURE_NS
            else slowed(found, message, then, since, age, slowly)
        )

    def _step(self, age_ns: int, decay: float) -> Transition:
        """`transition` of the gains and this decay over an age; nothing hashes four floats for it."""
        if decay == 0.0:
            steps = self._free_steps
        else:
            steps = self._steps
            if decay != self._steps_decay:
                steps.clear()
                self._steps_decay = decay
        known = steps.get(age_ns)
        if known is None:
            if len(steps) >= _STEPS_KEPT:
                steps.clear()
            known = steps[age_ns] = _Step(transition(self._c1, self._c2, decay, age_ns * 1e-9))
        return known.of

    def forces_of(self, before: HandState, message: HandState) -> HandState:
        """A message that says only where a robot is, with the forces that are left of its one before."""
        if not (before.following and message.following) or message.time_ns <= before.time_ns:
            return message
        left = exp(-self.decay * (message.time_ns - before.time_ns) * 1e-9)
        return message._replace(
            navigation_x=before.navigation_x,
            navigation_y=before.navigation_y,
            constraint_x=left * before.constraint_x,
            constraint_y=left * before.constraint_y,
            correction_x=left * before.correction_x,
            correction_y=left * before.correction_y,
        )

    def stood(self, message: HandState, until: float) -> Belief:
        """Where a robot may stand that has not been heard since a message, and drove on for `until` s at
        most.

        One that stood then may have been about to drive; whoever has its body may drive it on, as long as it
        was not seen to stand.
        """
        rolls = self._rolls_on.get(message.robot)
        doubt = own_doubt(message.doubt, rolls=rolls is not None and not message.following)
        if not message.following:
            doubt += min(DRIVEN_MAX, hypot(message.vx, message.vy))
        points = [(0.0, message.x, message.y)]
        onward = islice(self._onward(message, STEP_S, self._instants), ceil(until / STEP_S))
        points += [((k + 1) * STEP_S, x, y) for k, (x, y) in enumerate(onward)]
        return self.may_have_rolled(stood_on(points, doubt), message)

    def may_have_rolled(self, belief: Belief, message: HandState) -> Belief:
        """The belief (m, W) by the last message of a robot, whose body may have gone on as nothing commands
        it: on its arc as well, or on that alone if it says so (`rolling.is_somewhere_on`)."""
        rolls = self._rolls_on.get(message.robot)
        if rolls is not None and is_somewhere_on(message):
            return stood_on(arc_of(message, rolls), ROLL_ERROR)
        if rolls is None or not moves(message.vx, message.vy):
            return belief
        return rolled_on(belief, arc_of(message, rolls), ROLL_ERROR)

    def since_measured(self, message: HandState) -> HandState:
        """A message of one whose plant is lost, as it was when its body was measured last; any other as it
        is."""
        rolls = self._rolls_on.get(message.robot)
        if rolls is None or not message.lost_ms or not is_somewhere_on(message):
            return message
        x, y = begin_of(message, rolls)
        at = rolled(x, y, message.obeys[0], rolls.reach, 0.0)
        time_ns = message.time_ns - message.lost_ms * NS_PER_MS
        return message._replace(time_ns=time_ns, x=x, y=y, vx=at.vx, vy=at.vy, doubt=0.0, lost_ms=0)

    def rolling(self, message: HandState, age: float) -> Hand | None:
        """Where the hand of a robot is, so many seconds after its message, that nothing commands since then;
        None for one that stands by then, or brakes as others do."""
        rolls = self._rolls_on.get(message.robot)
        if rolls is None or not message.obeys or age > rolls.for_s or is_somewhere_on(message):
            return None
        return rolled(message.x, message.y, message.obeys[0], rolls.reach, age)

    def rolling_on(self, message: HandState, age: float, step_s: float) -> list[Vector]:
        """Where it is from then on, every `step_s`, until it rests; empty where `rolling` gives None."""
        rolls, found = self._rolls_on.get(message.robot), self.rolling(message, age)
        if rolls is None or found is None:
            return []
        ages = (min(age + k * step_s, rolls.for_s) for k in range(2 + ceil((rolls.for_s - age) / step_s)))
        return [rolled(message.x, message.y, message.obeys[0], rolls.reach, each)[:2] for each in ages]

    def rests_off(self, last: HandState, message: HandState) -> float:
        """How far from where `last` has it a robot comes to rest by `message`, m, if nothing commands it from
        then on; inf where only one of them says that it rolls."""
        rolls = self._rolls_on.get(message.robot)
        if rolls is None or not (last.obeys and message.obeys):
            return inf
        age = (message.time_ns - last.time_ns) / NS_PER_S
        then = rolled(last.x, last.y, last.obeys[0], rolls.reach, age + rolls.for_s)
        now = rolled(message.x, message.y, message.obeys[0], rolls.reach, rolls.for_s)
        return hypot(now.x - then.x, now.y - then.y)

    def lane(self, message: HandState, reference: Reference) -> Lane:
        """The way of a robot from its message on, to the end of the mission, if it follows `reference` and
        nothing turns it aside."""
        robot, time_ns = message.robot, max(message.time_ns, self.epoch_ns)
        points = [(message.x, message.y)]
        if reference.motion(robot, time_ns) is None:
            return Lane(points)
        step_ns = round(LANE_STEP_S * NS_PER_S)
        message = message._replace(time_ns=time_ns)
        for point in islice(self._onward(message, LANE_STEP_S, reference.instant), LANE_STEPS_MAX):
            points.append(point)
            time_ns += step_ns
            place = reference.motion(robot, time_ns)
            if place is None:
                return Lane(points)
            left = hypot(place[0] - point[0], place[1] - point[1])
            if time_ns > reference.settled_ns and left < AT_PLACE:
                break
        return Lane(points + reference.way(robot, time_ns))

    def _onward(self, message: HandState, step_s: float, instants: Instants) -> Iterator[Vector]:
        """Where a robot is every `step_s` after a message, if it follows from then on; one without a place
        brakes."""
        step_ns, robot = round(step_s * NS_PER_S), message.robot
        then_ns = message.time_ns + step_ns
        found = self.following(message, then_ns, instants) or coasting(message, step_s)
        yield found.position
        place = *found.position, *found.velocity
        before = instants(then_ns)
        while True:  # each step as `following` has it: tens of them for each robot that may have stopped
            before_ns, then_ns = then_ns, then_ns + step_ns
            at = instants(then_ns)
            if robot not in at.offsets:
                braking = coasting(HandState.placed(robot, 0, before_ns, True, 0, place), step_s)
                place = *braking.position, *braking.velocity
            else:
                since_ns = before_ns
                if before_ns < self.epoch_ns:
                    since_ns = min(self.epoch_ns, then_ns)
                    before = instants(since_ns)
                then = at.motion(robot)
                since = before.motion(robot) if robot in before.offsets else then
                age, step = (then_ns - since_ns) * 1e-9, self._step(then_ns - since_ns, 0.0)
                place = unforced(place, then, since, age, self._c1, self._c2, self.most, self.speeding, step)
            before = at
            yield place[0], place[1]
