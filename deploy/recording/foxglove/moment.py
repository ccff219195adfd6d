"""A fleet at one moment, made of the newest that its plants and agents say (PURE).

Lengths in m, W; times in ns, those of reception unless said otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import atan2, cos, hypot, inf, sin
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import PlanError, plan_of
from handfast.agent.formation.reference import Reference
from handfast.agent.messages.codec import newer
from handfast.agent.messages.types import Beacon, HandState, Mission, PlantState, Removed, Silent
from handfast.agent.supervision.state_machine import REST_SPEED

SILENT_NS: Final = 2 * NS_PER_S
"""A body of which nothing has come for so long is not heard."""
_STALE_NS: Final = NS_PER_S
"""A plant that is silent for so much longer than its agent does not say where the body is."""
_AHEAD_NS: Final = 250_000_000
"""What is older than the newest by more was not measured at one time with it: a clock is off, or it is
silent."""
_BELIEVED_NS: Final = 5 * NS_PER_S
"""What a beacon says of others holds for so long: where they are many, each beacon names some of them."""

HOLDS: Final = 0.05
"""An edge that is off by a smaller share of its distance holds."""
_AT_PLACE: Final = 0.25
"""Who is nearer to its place than this share of the shortest edge is there."""


class Body(NamedTuple):
    """One body as it was said to be last.

    Attributes:
        x, y, heading: of its frame R, rad.
        hand: its hand point.
        velocity: of its hand point, m/s.
        speed: along its heading, m/s; where no plant is heard, that of its hand point.
        time_ns: wall clock at which this held, by the robot's clock.
        received_ns: when it came.
    """

    robot: int
    x: float
    y: float
    heading: float
    hand: Vector
    velocity: Vector
    speed: float
    time_ns: int
    received_ns: int


class Link(NamedTuple):
    """One edge: its robots, i < j, and the distance of their hand points, as it is and as it is wanted.

    `counts` is false while a change of mission brings it or takes it away."""

    i: int
    j: int
    distance: float
    wanted: float
    counts: bool


class Moment(NamedTuple):
    """The fleet at one moment. Hand points are carried on to one time.

    Attributes:
        bodies: of every robot of which anything is known, in the fleet file's order.
        hands: of those that are on the field.
        links: all edges of which both ends are known.
        reference: the formation's reference point; None without a trajectory.
        places: where the hand points of members are to be, seen from `reference`.
        place_errors: how far they are from there.
        at_place: who is nearer to its place is there.
        nearest: how far the nearest other hand point is.
        least: the least of these, and its two robots; None where no two are known of which one is heard.
        close: pairs that are closer than the safe distance.
        believed: of robots that are not heard, the way on which others believe them to be.
    """

    bodies: list[Body]
    hands: dict[int, Vector]
    links: list[Link]
    reference: Vector | None
    places: dict[int, Vector]
    place_errors: dict[int, float]
    at_place: float
    nearest: dict[int, float]
    least: tuple[float, int, int] | None
    close: dict[tuple[int, int], float]
    believed: dict[int, Silent]


class Latest:
    """The newest of what is said of every body and of the formation.

    Attributes:
        safe_m: `formation.safe_distance_m`.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet, self._geometry = fleet, resolve(fleet)
        self._reference = Reference(fleet, self._geometry)
        self._refused: Mission | None = None
        self._ids = fleet.ids
        self._offset = {robot.id: robot.hand_offset_m for robot in fleet.robots}
        self.safe_m: Final[float] = fleet.formation.safe_distance_m
        self._bodies: dict[int, tuple[int, PlantState]] = {}
        self._truths: dict[int, tuple[int, PlantState]] = {}
        self._hands: dict[int, tuple[int, HandState | Beacon]] = {}
        self._headings: dict[int, float] = {}
        """Of robots of which only the agent is heard: where they drove to last."""
        self._believed: dict[int, tuple[int, Silent]] = {}

    def take_plant(self, now_ns: int, state: PlantState) -> None:
        """Takes a measured pose, if it may be used."""
        if state.healthy:
            self._bodies[state.robot] = now_ns, state

    def take_truth(self, now_ns: int, state: PlantState) -> None:
        """Takes where a simulated body really is; it counts instead of what is measured with noise."""
        self._truths[state.robot] = now_ns, state

    def take_hand(self, now_ns: int, hand: HandState | Beacon) -> None:
        """Takes where an agent says its hand point is. With a beacon, where it believes others to be."""
        self._hands[hand.robot] = now_ns, hand
        if type(hand) is Beacon:
            for row in hand.silent:
                known = self._believed.get(row.robot)
                if known is None or row.time_ns >= known[1].time_ns or now_ns - known[0] > _BELIEVED_NS:
                    self._believed[row.robot] = now_ns, row

    def take_mission(self, mission: Mission) -> bool:
        """Takes a mission: from its time on the formation is its own. Whether it is a new one; one that
        cannot be driven is left out."""
        plan = self._reference.plan
        if plan is not None and not newer(mission, plan.mission):
            return False
        content = mission._replace(time_ns=0)  # agents relay it for as long as they drive
        if content == self._refused:
            return False
        try:
            self._reference.take(plan_of(mission, self._fleet, self._geometry))
        except PlanError:
            self._refused = content
            return False
        return True

    def at(self, now_ns: int) -> Moment:
        """The fleet at the time of reception `now_ns`."""
        bodies = [body for robot in self._ids if (body := self._body(robot)) is not None]
        removed = self._removed()
        field = [body for body in bodies if body.time_ns > removed.get(body.robot, -1)]
        hands = at_once(field)
        heard = {body.robot for body in field if now_ns - body.received_ns <= SILENT_NS}
        nearest, least, close = _distances(hands, heard, self.safe_m)
        links = self._links(now_ns, hands)
        reference, places, errors = self._places(now_ns, hands)
        believed = {
            robot: row
            for robot, (told_ns, row) in self._believed.items()
            if robot not in heard
            and robot in self._offset
            and now_ns - told_ns <= _BELIEVED_NS
            and row.time_ns >= removed.get(robot, 0)
        }
        shortest = min((link.wanted for link in links), default=4.0 * self.safe_m)
        return Moment(
            bodies, hands, links, reference, places, errors, _AT_PLACE * shortest, nearest, least, close,
            believed,
        )  # fmt: skip

    def _removed(self) -> dict[int, int]:
        """Robots whose bodies somebody has carried off, and when; who is heard again is there."""
        plan = self._reference.plan
        rows: Iterable[Removed] = plan.mission.removed if plan is not None else ()
        return dict(rows)

    def _body(self, robot: int) -> Body | None:
        body, truth, hand = self._bodies.get(robot), self._truths.get(robot), self._hands.get(robot)
        if truth is not None and (body is None or body[0] - truth[0] <= _STALE_NS):
            body = truth
        offset = self._offset[robot]
        if hand is None or (body is not None and hand[0] - body[0] <= _STALE_NS):
            if body is None:
                return None
            received_ns, state = body
            c, s = cos(state.heading), sin(state.heading)
            self._headings[robot] = state.heading
            across = offset * state.yaw_rate
            return Body(
                robot, state.x, state.y, state.heading,
                (state.x + offset * c, state.y + offset * s),
                (state.speed * c - across * s, state.speed * s + across * c),
                state.speed, state.time_ns, received_ns,
            )  # fmt: skip
        received_ns, said = hand
        x, y, vx, vy = said.place
        speed = hypot(vx, vy)
        heading = atan2(vy, vx) if speed > REST_SPEED else self._headings.get(robot, 0.0)
        self._headings[robot] = heading
        place = x - offset * cos(heading), y - offset * sin(heading)
        return Body(robot, *place, heading, (x, y), (vx, vy), speed, said.time_ns, received_ns)

    def _links(self, now_ns: int, hands: Mapping[int, Vector]) -> list[Link]:
        links = []
        for robot, (x, y) in hands.items():
            for other, wanted, weight, _, _ in self._reference.edges(robot, now_ns):
                there = hands.get(other) if robot < other else None
                if there is not None:
                    distance = hypot(x - there[0], y - there[1])
                    links.append(Link(robot, other, distance, wanted, weight >= 1.0))
        return links

    def _places(
        self, now_ns: int, hands: Mapping[int, Vector]
    ) -> tuple[Vector | None, dict[int, Vector], dict[int, float]]:
        reference = self._reference.active(now_ns).reference(now_ns)[:2]
        places: dict[int, Vector] = {}
        errors = {}
        for robot in self._ids:
            place = self._reference.motion(robot, now_ns)
            if place is None:
                continue
            x, y = place[:2]
            places[robot] = x - reference[0], y - reference[1]
            if robot in hands:
                errors[robot] = hypot(hands[robot][0] - x, hands[robot][1] - y)
        return reference, places, errors


def at_once(bodies: Iterable[Body]) -> dict[int, Vector]:
    """Hand points at the time of the newest: each goes on as it was until then, if that is not long."""
    bodies = list(bodies)
    newest_ns = max((body.time_ns for body in bodies), default=0)
    hands = {}
    for body in bodies:
        late_ns = newest_ns - body.time_ns
        on_s = late_ns / NS_PER_S if late_ns <= _AHEAD_NS else 0.0
        hands[body.robot] = body.hand[0] + on_s * body.velocity[0], body.hand[1] + on_s * body.velocity[1]
    return hands


def _distances(
    hands: Mapping[int, Vector], heard: set[int], safe_m: float
) -> tuple[dict[int, float], tuple[float, int, int] | None, dict[tuple[int, int], float]]:
    """How far the nearest other is from each; the least of all, and its pair; and all pairs closer than safe.

    Two that are both silent do not count: where they were need not hold any more."""
    order = sorted(hands.items(), key=_x)
    nearest: dict[int, float] = {}
    least: tuple[float, int, int] | None = None
    close: dict[tuple[int, int], float] = {}
    for at, (robot, (x, y)) in enumerate(order):
        is_heard = robot in heard
        best = inf
        for others in (
            order[at + 1 :],
            reversed(order[:at]),
        ):  # eastward, westward, until all are farther off
            for other, (ox, oy) in others:
                away = abs(ox - x)
                if away >= best and away >= safe_m:
                    break
                if not is_heard and other not in heard:
                    continue
                distance = hypot(away, oy - y)
                if distance < best:
                    best = distance
                if distance < safe_m:
                    close[min(robot, other), max(robot, other)] = distance
                if least is None or distance < least[0]:
                    least = distance, min(robot, other), max(robot, other)
        if best < inf:
            nearest[robot] = best
    return nearest, least, close


def _x(item: tuple[int, Vector]) -> float:
    return item[1][0]
