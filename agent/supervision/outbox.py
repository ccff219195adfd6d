"""What an agent says of itself: its wrench, hand state and beacon, with their numbers and keys (PURE)."""

from __future__ import annotations

from typing import Final

from agent.common.time import NS_PER_MS, MachineClock
from agent.control.hand import Hand
from agent.control.peers.peers import Peers
from agent.fleet.model import Fleet
from agent.formation.mission_choice import MissionChoice
from agent.messages import key_expressions
from agent.messages.codec import encode
from agent.messages.sequence_numbers import SequenceNumbers
from agent.messages.types import (
    HEARD_ROUNDS,
    NO_FORCES,
    Beacon,
    Forces,
    HandState,
    Outgoing,
    Wrench,
)
from agent.supervision.beacon_schedule import BeaconSchedule
from agent.supervision.stop_latch import StopLatch


class Outbox:
    """Makes the messages of robot `robot` of `fleet`.

    Args:
        phase_ns: of its ticks.
        peers: whose hand states it echoes, and of whose silence its beacons tell.
        missions, latch: which orders it has.

    Attributes:
        keys: on which it publishes.
        overload: by how many steps it wants the rate of all to fall.
    """

    def __init__(
        self, fleet: Fleet, robot: int, phase_ns: int, peers: Peers, missions: MissionChoice, latch: StopLatch
    ) -> None:
        name, period_ns = fleet.fleet.name, fleet.period_ns
        self._robot = robot
        self._peers, self._missions, self._latch = peers, missions, latch
        self._wrenches = SequenceNumbers(period_ns, phase_ns)
        self._hands = SequenceNumbers(period_ns, phase_ns)
        self._schedule = BeaconSchedule(fleet, robot, phase_ns)
        self._key_wrench = key_expressions.wrench(name, robot)
        self._key_hand = key_expressions.hand(name, robot)
        self._key_beacon = key_expressions.beacon(name, robot)
        self._clock: tuple[int, ...] = ()
        self._period_ns, self._next_ms = period_ns, 0
        self.overload = 0
        self.keys: Final = (self._key_wrench, self._key_hand, self._key_beacon)

    def runs_by(self, clock: MachineClock) -> None:
        """The clock of the process, which its wrenches tell."""
        self._clock = tuple(clock)

    def keep_pace(self, period_ns: int) -> None:
        """From now on there is a tick in every so long, a multiple of the full rate's period."""
        self._next_ms = -(-period_ns // NS_PER_MS) if period_ns > self._period_ns else 0

    def begin(self, epoch_ns: int) -> None:
        """Counts rounds from the epoch of a mission."""
        self._hands.begin(epoch_ns)
        self._wrenches.begin(epoch_ns)

    def wrench(
        self, now_ns: int, force: float = 0.0, torque: float = 0.0, *, brake: bool = False
    ) -> Outgoing:
        """What the plant is asked for: force (N) and torque (N m), or to brake."""
        sequence = self._wrenches.next(now_ns)
        wrench = Wrench(self._robot, sequence, now_ns, force, torque, brake, self._clock)
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
    ) -> Outgoing:
        """The hand state; arguments as its fields."""
        sequence = self._hands.next(now_ns)
        heard = self._peers.heard() if (sequence + self._robot) % HEARD_ROUNDS == 0 else ()
        message = HandState(
            self._robot,
            sequence,
            now_ns,
            following,
            degree,
            *here,
            *forces,
            doubt,
            multipliers,
            heard,
            own,
            self._next_ms,
        )
        return self._key_hand, encode(message)

    def beacon(self, now_ns: int, here: Hand, doubt: float, *, following: bool) -> list[Outgoing]:
        """The beacon, when it is due."""
        if not self._schedule.is_turn(now_ns):
            return []
        message = self._schedule.timed(self._beacon(now_ns, here, doubt, following=following))
        return [] if message is None else [(self._key_beacon, encode(message))]

    def heard(self, beacon: Beacon) -> None:
        """Takes another's beacon, for what it shows of this robot's."""
        if self._schedule.is_seldom:
            self._schedule.heard(beacon, (*self._missions.mark, *self._latch.mark))

    def _beacon(self, now_ns: int, here: Hand, doubt: float, *, following: bool) -> Beacon:
        return Beacon(
            self._robot,
            self._hands.at(now_ns),
            now_ns,
            following,
            *here,
            doubt,
            *self._missions.mark,
            *self._latch.mark,
            self._peers.silent(now_ns),
            self._peers.given_up(now_ns),
            overload=self.overload,
        )
