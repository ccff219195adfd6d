"""When a robot says where it is: at its turn, and seldom while that is no news to anybody (PURE).

In a small fleet it does so at every turn. In a large one that would be most of what everybody hears, and
grow with the fleet. There others carry a robot forward at the velocity that it told (dead reckoning, as in
IEEE 1278.1), and its next beacon comes when it is elsewhere by more than they allow for (U2), has something
else to tell, such as that it lacks an order; then once more, in case that was lost; and
after `Fleet.beacon_rounds_max`, or `WAY_M`, at the latest. Each beacon says until when the next one comes.
The velocity that is told is the mean one at which the law takes the robot on. One that is held up does not go
where the law would have it: where that was wrong, and the velocity that it had at the last beacon was nearer,
it tells the velocity that it has.
What happens to all at once they tell in turn, and again each at its own times. That it has an order is no
news, as all hear that; and what others do by what it told last it knows (`agent.control.right_of_way`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from math import hypot
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_MS, NS_PER_S
from handfast.agent.control.peers.beliefs import said_doubt
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import ORDERS_HZ, ORDERS_ROBOTS
from handfast.agent.messages.trickle_timer import TrickleTimer
from handfast.agent.messages.types import SILENT_MAX, Beacon, Silent

SURE_M: Final = 0.03
"""A place is told again that is off by so much more than its age makes up for: measurements scatter."""
WAY_M: Final = 1.2
"""When it has gone so far it says it at the latest: it may have come to a stand on any of it."""
HURRIES_HZ: Final = 10
"""So many times a second all robots of a fleet together hurry for what can wait for the next beacon: that one
stands, whom it does not hear, what it knows of those. What a fleet adds to its own trouble is bounded."""
APART: Final = (0.7548776662466927, 0.5698402909980532)
"""Their multiples spread evenly over the unit square, however many there are (Roberts' R2 sequence)."""
GROWTH: Final = 2
GROWTH_SURE: Final = 64
"""So many times as long as the one before is the interval after a beacon that says again what another has
said: as in RFC 6206 where links lose messages, else the longest at once. One that is lost is said again
anyway, and of a crowd that comes together these were most of what each heard."""
AGAIN_SURE_NS: Final = NS_PER_S
"""So much later it says once more where it is, or that it lacks an order, where links lose nothing; what it
tells meanwhile takes its place. A fleet that sets out at once would else say most things twice."""
ONWARD: Final = 0.75
"""For so much of the time to the next beacon is the mean velocity told: what others allow for grows with its
age, and is least at first."""
RELAY_NS: Final = NS_PER_S
"""A robot that others do not hear is told of again after so long at the latest."""

_Marks = tuple[int, int, int, int]
Onward = Callable[[Beacon, int], Vector | None]
"""(where a robot is, time ns) -> mean velocity (m/s) at which the law takes it on for so long; None without
a place."""


class BeaconSchedule:
    """Of robot `robot` of `fleet`; robots take turns, so that their beacons do not come all at once.

    Args:
        phase_ns: of its ticks.
        onward: where it goes; None: others carry it forward at the velocity that it has.

    Attributes:
        is_seldom: whether there are turns at which nothing is said.
        minds: while no mission is near, the robots of which it is news whether they hear each other and this
            one: of all others that are not there yet, in a fleet that starts, everybody would tell everybody.
            None once a mission is near: then of all.
        tick_ns: time between two ticks.
        loses: whether messages are lost on links all the time.
        level: by how many steps the others want the rate to fall: who wants no more has no news.
        stands: whether all stand for an overloaded machine. Nobody then drives into one that others do not
            hear: they are told of it when the next beacon is due.
    """

    def __init__(self, fleet: Fleet, robot: int, phase_ns: int, onward: Onward | None = None) -> None:
        self._onward = onward
        self._own: Vector = 0.0, 0.0
        self._by_law: Vector = 0.0, 0.0
        """Velocities of the last beacon: that which it had, and that by the law; one of them was told."""
        self._robot, self._phase_ns, self._period_ns = robot, phase_ns, fleet.period_ns
        self._rounds = fleet.beacon_rounds
        least_ns, most_ns = self._rounds * fleet.period_ns, fleet.beacon_rounds_max * fleet.period_ns
        shares = robot * APART[0] % 1.0 or 1.0, robot * APART[1] % 1.0 or 1.0
        self._timer = TrickleTimer(least_ns, most_ns, shares)
        self.is_seldom: Final = fleet.is_large
        self.minds: Collection[int] | None = None
        self.level = 0
        self.loses = False
        self.stands = False
        self.tick_ns = fleet.period_ns
        # Others for each, else all that hurried once for the same reason do so again in one tick; and each
        # waits for its share of the first pause at the start, when as many miss each other at once.
        self._pause_ns: Final = round((0.5 + shares[1]) * len(fleet.robots) * NS_PER_S / HURRIES_HZ)
        self._first_pause_ns: Final = round(shares[0] * self._pause_ns)
        self._hurried_ns, self._is_missed = 0, False
        all_s = len(fleet.robots) / ORDERS_HZ * max(1.0, len(fleet.robots) / ORDERS_ROBOTS) ** 2
        all_ns = min(round(all_s * NS_PER_S), most_ns) // least_ns * least_ns
        self._again_ns: Final = all_ns
        self._orders_pause_ns: Final = round(shares[0] * all_ns / least_ns) * least_ns
        self._lacks_ns: int | None = None
        """Since when it lacks an order that another has."""
        self._ahead: set[int] = set()
        """Those that have told since it spoke last that they have one which it had not."""
        self._turn: int | None = None
        self._said: Beacon | None = None
        self._rows: dict[int, Silent] = {}
        """What was said last of each silent robot: of many a beacon tells of some in turn."""
        self._heard: dict[int, tuple[_Marks, bool]] = {}

    def is_turn(self, now_ns: int) -> bool:
        """Whether this is the robot's turn, or the first tick after it; asked in every tick."""
        turn, past = divmod((now_ns - self._phase_ns) // self._period_ns + self._robot, self._rounds)
        before, self._turn = self._turn, turn
        return not past if before is None else turn != before

    def timed(
        self,
        beacon: Beacon,
        completed: Callable[[Beacon], Beacon] | None = None,
        near: Callable[[], Collection[int]] | None = None,
    ) -> Beacon | None:
        """What is to be said at a turn: this, with until when the next one comes, or nothing.

        Args:
            completed: adds to a beacon what it tells of robots that are not heard. In a fleet in trouble
                that is most of what a tick takes: so it is asked only where it may be said.
            near: of these robots it is news what `completed` told: of those that are far away everybody
                tells with the next beacon, else one that is late has them all hurry. None: of all.
        """
        timer, now_ns, said = self._timer, beacon.time_ns, self._said
        if said is None:
            self._hurried_ns = now_ns - self._pause_ns + self._first_pause_ns
        hurries = now_ns - self._hurried_ns >= self._pause_ns
        if completed is not None and (said is None or hurries or not self.is_seldom):
            beacon, completed = completed(beacon), None
        if not self.is_seldom:
            return beacon
        self._shorten_pause(beacon, hurries=hurries, near=near)
        if not timer.is_due(now_ns, max(self.tick_ns, timer.least_ns)):
            return None
        return self._scheduled(beacon if completed is None else completed(beacon))

    def _shorten_pause(
        self, beacon: Beacon, *, hurries: bool, near: Callable[[], Collection[int]] | None
    ) -> None:
        """Have the next beacon come sooner if there is something to tell."""
        timer, said = self._timer, self._said
        if said is None:
            timer.changed(self._again_ns)
        elif beacon.overload > max(said.overload, self.level):
            timer.changed()
        elif _is_off(beacon, said):
            timer.changed(0 if self.loses else AGAIN_SURE_NS)
        elif hurries and self._has_news(beacon, said, None if near is None else near()):
            self._hurried_ns, self._is_missed = beacon.time_ns, False
            timer.changed()
        if self._ahead and self._shows_what_it_lacks(beacon):
            timer.changed(self._again_ns if self.loses else max(self._again_ns, AGAIN_SURE_NS))

    def _scheduled(self, beacon: Beacon) -> Beacon:
        """Return a beacon that is sent now, with until when the next one comes."""
        timer, now_ns = self._timer, beacon.time_ns
        relays = not self.stands and any(now_ns - row.time_ns < RELAY_NS for row in beacon.silent)
        most_ns = RELAY_NS if relays else timer.most_ns
        beacon = self._with_velocity(beacon, most_ns)
        speed = hypot(beacon.vx, beacon.vy)
        if speed * most_ns > WAY_M * NS_PER_S:
            most_ns = round(WAY_M / speed * NS_PER_S) // timer.least_ns * timer.least_ns
        growth = GROWTH if self.loses else GROWTH_SURE
        next_ns = max(self.tick_ns, timer.said(now_ns, most_ns=most_ns, growth=growth))
        self._said = beacon
        self._ahead.clear()
        self._lacks_ns = None
        if len(beacon.silent) < SILENT_MAX:
            self._rows.clear()
        self._rows.update((row.robot, row) for row in beacon.silent)
        return beacon if next_ns <= timer.least_ns else beacon._replace(next_ms=next_ns // NS_PER_MS)

    def _with_velocity(self, beacon: Beacon, next_ns: int) -> Beacon:
        """A beacon with the velocity at which others are to carry it forward; after it the next one comes
        within `next_ns`."""
        by_law = None
        if self._onward is not None and beacon.following:
            by_law = self._onward(beacon, round(ONWARD * next_ns))
        if by_law is None:
            by_law = beacon.vx, beacon.vy
        said, own, before = self._said, self._own, self._by_law
        self._own, self._by_law = (beacon.vx, beacon.vy), by_law
        if said is not None and said.following:
            age_s = (beacon.time_ns - said.time_ns) / NS_PER_S
            off = _off(beacon, said, before)
            if off > said_doubt(age_s) + SURE_M and off > _off(beacon, said, own):
                return beacon
        return beacon._replace(vx=by_law[0], vy=by_law[1])

    def _shows_what_it_lacks(self, beacon: Beacon) -> bool:
        """Whether it lacks an order that another has, and it is its turn to say so.

        What one has all may lack, and all would say so at once. Who hears that one is lacked tells it, so the
        first is enough.
        """
        own = _marks(beacon)
        self._ahead = {robot for robot in self._ahead if _has_more(self._heard[robot][0], own)}
        if not self._ahead:
            self._lacks_ns = None
            return False
        if self._lacks_ns is None:
            self._lacks_ns = beacon.time_ns
        return beacon.time_ns - self._lacks_ns >= self._orders_pause_ns

    def _has_news(self, beacon: Beacon, said: Beacon, near: Collection[int] | None) -> bool:
        """Whether others do not know all that `beacon` tells, who have heard `said`."""
        # By an order all stand, who all have it.
        stands = said.following and not beacon.following and _marks(beacon) == _marks(said)
        if self._is_missed or stands or self._tells_news(beacon, near):
            return True  # that it begins to follow all would say at once, and is seen by where it goes
        minds = self.minds
        if minds is None:
            return beacon.unheard != said.unheard or beacon.overload != said.overload
        return not set(beacon.unheard).symmetric_difference(said.unheard).isdisjoint(minds)

    def _tells_news(self, beacon: Beacon, near: Collection[int] | None) -> bool:
        """Whether it tells something new of a silent robot."""
        rows = self._rows
        return any(
            (said := rows.get(row.robot)) is None
            or row.following is not said.following
            or _is_elsewhere(row, said)
            for row in beacon.silent
            if near is None or row.robot in near
        )

    def is_news(self, beacon: Beacon) -> bool:
        """Whether another's beacon tells other orders than its last one, or of this robot something else: of
        most that come `heard` need not be told."""
        return (_marks(beacon), self._robot in beacon.unheard) != self._heard.get(beacon.robot)

    def heard(self, beacon: Beacon, own: _Marks) -> None:
        """Takes another's beacon: it may have an order that this robot lacks, or not hear it any more. Of
        what the other lacks nothing is said here: it is told (`agent.supervision.orders`).

        Args:
            own: which mission, stop and resume this robot has acknowledged.
        """
        told = _marks(beacon), self._robot in beacon.unheard
        before = self._heard.get(beacon.robot)
        if told != before:
            self._heard[beacon.robot] = told
            if _has_more(told[0], own):
                self._ahead.add(beacon.robot)
            if told[1] and (self.minds is None or beacon.robot in self.minds):
                self._is_missed = True


def _marks(beacon: Beacon) -> _Marks:
    return beacon.mission_version, beacon.mission_tag, beacon.stop_version, beacon.resume_version


def _has_more(told: _Marks, own: _Marks) -> bool:
    """Whether one that tells the first of these has an order which one that has the second lacks."""
    return told[:2] > own[:2] or told[2] > own[2] or told[3] > own[3]


def _is_off(beacon: Beacon, said: Beacon) -> bool:
    """Whether others look for it where it is not, who have heard `said`. Whether it follows those near it see
    from its hand states; the others from where it is."""
    return abs(beacon.doubt - said.doubt) > SURE_M or _is_elsewhere(beacon, said)


def _is_elsewhere(now: Beacon | Silent, said: Beacon | Silent) -> bool:
    """Whether a robot is not where it was said to be going; others go by what was said."""
    age_s = (now.time_ns - said.time_ns) / NS_PER_S
    velocity = (said.vx, said.vy) if said.following else (0.0, 0.0)
    return _off(now, said, velocity) > said_doubt(age_s) + SURE_M


def _off(now: Beacon | Silent, said: Beacon | Silent, velocity: Vector) -> float:
    """How far a robot is from where it would be if it had gone on at a velocity since it `said` where it was,
    m."""
    age_s = (now.time_ns - said.time_ns) / NS_PER_S
    return hypot(now.x - said.x - age_s * velocity[0], now.y - said.y - age_s * velocity[1])
