"""What an agent says of itself: its wrench, hand state and beacon, with their numbers and keys (PURE)."""

from __future__ import annotations

from typing import Final

from handfast.agent.common.models import new
from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_MS, NS_PER_S, MachineClock
from handfast.agent.control.event_trigger import EventTrigger
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.peers import Peers
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.mission_plan import MissionChoice
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import Mark, encode
from handfast.agent.messages.trickle_timer import SequenceNumbers
from handfast.agent.messages.types import (
    HEARD_ROUNDS,
    NO_FORCES,
    Beacon,
    Forces,
    HandState,
    Outgoing,
    Setpoint,
    Wrench,
)
from handfast.agent.supervision.beacon_schedule import BeaconSchedule
from handfast.agent.supervision.orders import StopLatch


class Outbox:
    """Makes the messages of robot `robot` of `fleet`.

    Args:
        phase_ns: of its ticks.
        peers: whose hand states it echoes, and of whose silence its beacons tell.
        missions, latch: which orders it has.
        event: which hand states are sent; None: all.

    Attributes:
        keys: on which it publishes.
        overload: by how many steps it wants the rate of all to fall; others_overload: the most that others
            want.
        stood_ms: for how much of the last seconds its process did not run.
        told_mark: of the mission that its beacon told last.
    """

    def __init__(
        self,
        fleet: Fleet,
        robot: int,
        phase_ns: int,
        peers: Peers,
        missions: MissionChoice,
        latch: StopLatch,
        event: EventTrigger | None = None,
    ) -> None:
        name, period_ns = fleet.fleet.name, fleet.period_ns
        self._robot, self._period_ns, self._phase_ns = robot, period_ns, phase_ns
        self._peers, self._missions, self._latch = peers, missions, latch
        self._event = event
        self._wrenches = SequenceNumbers(period_ns, phase_ns)
        self._hands = SequenceNumbers(period_ns, phase_ns)
        self._schedule = BeaconSchedule(fleet, robot, phase_ns, self._onward)
        self._key_wrench = key_expressions.wrench(name, robot)
        self._key_hand = key_expressions.hand(name, robot)
        self._key_beacon = key_expressions.beacon(name, robot)
        self._clock: tuple[int, ...] = ()
        self._step = 0
        self._period_ns, self._next_ms = period_ns, 0
        self.overload = self.others_overload = self.stood_ms = 0
        self.told_mark: Mark = 0, 0
        self.keys: Final = (self._key_wrench, self._key_hand, self._key_beacon)

    def runs_by(self, clock: MachineClock) -> None:
        """The clock of the process, which its wrenches tell."""
        self._clock = tuple(clock)

    def keep_pace(self, period_ns: int, promise_ns: int = 0) -> None:
        """From now on there is a tick in every so long, a multiple of the full rate's period.

        Args:
            promise_ns: within so long the next hand state comes, where that is longer.
        """
        self._step = (period_ns // self._period_ns).bit_length() - 1
        next_ns = max(period_ns, promise_ns)
        self._next_ms = -(-next_ns // NS_PER_MS) if next_ns > self._period_ns else 0
        self._schedule.tick_ns, self._schedule.stands = period_ns, promise_ns > 0

    def begin(self, epoch_ns: int) -> None:
        """Counts rounds from the epoch of a mission."""
        self._hands.begin(epoch_ns)
        self._wrenches.begin(epoch_ns)

    def wrench(
        self, now_ns: int, force: float = 0.0, torque: float = 0.0, *, brake: bool = False
    ) -> Outgoing:
        """What the plant is asked for: force (N) and torque (N m), or to brake."""
        sequence = self._wrenches.next(now_ns)
        wrench = new(Wrench, (self._robot, sequence, now_ns, force, torque, brake, self._clock, self._step))
        return self._key_wrench, encode(wrench)

    def hand(
        self,
        now_ns: int,
        here: Hand,
        doubt: float,
        *,
        following: bool,
        degree: int = 0,
        forces: Forces = NO_FORCES,
        multipliers: tuple[tuple[int, float], ...] = (),
        own: tuple[float, ...] = (),
        obeys: tuple[Setpoint, ...] = (),
        lost_ms: int = 0,
    ) -> list[Outgoing]:
        """The hand state, where one is to be sent; arguments as its fields."""
        sequence, event = self._hands.next(now_ns), self._event
        heard: tuple[tuple[int, int], ...] = ()
        if event is None:
            if (sequence + self._robot) % HEARD_ROUNDS == 0:
                heard = self._peers.heard()
        else:
            event.hears(self._peers.heard())
        x, y, vx, vy = here  # one by one: in C that makes no list of them
        nx, ny, cx, cy, dx, dy = forces
        values = (
            self._robot, sequence, now_ns, following, degree, x, y, vx, vy, nx, ny, cx, cy, dx, dy, doubt,
            multipliers, heard, own, self._next_ms, self.stood_ms, obeys, lost_ms,
        )  # fmt: skip
        message = new(HandState, values)
        if event is not None:
            round_ns = (now_ns - self._phase_ns) // self._period_ns * self._period_ns
            next_ms = event.next_ms(message, round_ns)
            if next_ms is None:
                return []
            next_ms = max(next_ms, self._next_ms)
            message = message._replace(heard=event.echo(self._peers.heard(), round_ns), next_ms=next_ms)
        return [(self._key_hand, encode(message))]

    def beacon(
        self,
        now_ns: int,
        here: Hand,
        doubt: float,
        *,
        following: bool,
        obeys: tuple[Setpoint, ...] = (),
        lost_ms: int = 0,
    ) -> list[Outgoing]:
        """The beacon, when it is due."""
        if not self._schedule.is_turn(now_ns):
            return []
        if self._schedule.is_seldom:
            self._schedule.minds = None if self._peers.rows.are_told(now_ns) else self._peers.listened
            self._schedule.level = self.others_overload
            self._schedule.loses = self._peers.loses
        message = self._schedule.timed(
            self._beacon(now_ns, here, doubt, following=following, obeys=obeys, lost_ms=lost_ms),
            self._with_silent,
            lambda: self._peers.rows.near,
        )
        if message is None:
            return []
        self.told_mark = message.mission_version, message.mission_tag
        return [(self._key_beacon, encode(message))]

    def heard(self, beacon: Beacon) -> None:
        """Takes another's beacon, for what it shows of this robot's."""
        if self._schedule.is_seldom and self._schedule.is_news(beacon):
            self._schedule.heard(beacon, (*self._missions.mark, *self._latch.mark))

    def _beacon(
        self,
        now_ns: int,
        here: Hand,
        doubt: float,
        *,
        following: bool,
        obeys: tuple[Setpoint, ...],
        lost_ms: int,
    ) -> Beacon:
        return Beacon(
            self._robot,
            self._hands.at(now_ns),
            now_ns,
            following,
            *here,
            doubt,
            *self._missions.mark,
            *self._latch.mark,
            (),
            (),
            overload=self.overload,
            stood_ms=self.stood_ms,
            rolling=tuple((self._robot, *each) for each in obeys),
            lost=((self._robot, lost_ms),) if lost_ms else (),
        )

    def _onward(self, here: Beacon, for_ns: int) -> Vector | None:
        """Mean velocity, m/s, at which the law takes the robot on from where it is."""
        place = HandState.placed(self._robot, 0, here.time_ns, True, 0, here.place, here.doubt)
        then = self._peers.forecast.following(place, here.time_ns + for_ns)
        if then is None:
            return None
        for_s = for_ns / NS_PER_S
        return (then.position[0] - here.x) / for_s, (then.position[1] - here.y) / for_s

    def _with_silent(self, beacon: Beacon) -> Beacon:
        """A beacon with what it tells of robots that are not heard."""
        peers, now_ns = self._peers, beacon.time_ns
        silent = peers.silent(now_ns)
        if silent:
            rolling, lost = (*beacon.rolling, *peers.rolling(silent)), (*beacon.lost, *peers.lost_of(silent))
            beacon = beacon._replace(rolling=rolling, lost=lost)
        return beacon._replace(silent=silent, unheard=peers.given_up(now_ns))
