"""The other robots as one robot hears them: the latest message of each, its age, and how far to trust it.

Pure. Others are heard in two ways: by the hand states of those that are listened to (one a tick: neighbours
in the formation graph, and whoever is near), and by the beacons of all (a few a second).

A robot stamps its messages and follows the mission by its own clock. So all that is about it is computed
in that clock: the own one plus its offset, as far as that is proven (`agent.control.peers.lateness`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from math import inf
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_MS, NS_PER_S
from handfast.agent.control.peers.beliefs import stood_between
from handfast.agent.control.peers.forecast import Forecast, Instants
from handfast.agent.control.peers.lateness import (
    IN_TIME_NS,
    LATE_MAX_NS,
    OUTAGE_NS,
    STOOD_KEPT_NS,
    UNSURE_NS,
    missed_at_least,
)
from handfast.agent.control.peers.peer import NEVER, Peer
from handfast.agent.control.peers.prediction import Prediction, as_it_came, coasting
from handfast.agent.control.peers.rolling import Rolls
from handfast.agent.control.peers.silent import NEVER_CAME_NS, LostVehicles, Overdue, SilentRows, Whereabouts
from handfast.agent.messages.types import (
    FUTURE_NS_MAX,
    NEIGHBOURS_MAX,
    Beacon,
    HandState,
    Lost,
    Removed,
    Rolling,
    Silent,
)

TRUST_LOST_S: Final = 0.5
"""Trust falls from 1 to 0 within this time: an edge to a robot that is given up loses its force."""
TRUST_GAINED_S: Final = 1.5
"""Trust rises from 0 to 1 within this time: the edge is back without a bump."""


class Peers:
    """The other robots, as robot `owner` hears them.

    Args:
        owner: id of the robot that listens.
        c1, c2: navigation gains (21) of all.
        period_ns: time between two hand states of one robot.
        instants: desired motion of every robot.
        decay: of a robot's constraint force, 1/s (`agent.control.peers.prediction.constraint_decay`).
        predict: False takes every message as it came, whatever its age.
        most: speed limit of all (m/s) by which they make for their places (N1), None without one.
        speeding: how fast they come to that from far, 1/s, (N2).
        starts: where the hands of all others are until they are heard, m, W.
        rolls_on: the robots whose bodies go on as they went when nothing commands them.
        beacon_ns: time between two beacons of one robot, that has something to tell.
        beacon_max_ns: longest time between two.
        horizon_s: a robot that hears nobody for so long stands.
        bound_m: how far robots let others mispredict them that do not send in every period, m, (E1).

    Attributes:
        behind_ns: how long after its time the tick begins whose messages are taken.
        stood: whether ticks before that were missed: what waited meanwhile is no older on its link than ever.
        rests: whether ticks are rare, as no mission is near: what comes waits for them, likewise.
        stood_until_ns: until then it counts that the own process stood lately.
        missed_ns: for how much of the time since an instant the own process did not run.
        predicts: whether the law is given what others do by now, or what their messages say.
        forecast: how all of them move.
        whereabouts: where those may be that are not heard; rows: what others are told of them; lost: which of
            them roll on.
        listened: the robots whose hand states are listened to.
    """

    def __init__(
        self,
        owner: int,
        c1: float,
        c2: float,
        period_ns: int,
        instants: Instants,
        *,
        decay: float = 0.0,
        predict: bool = True,
        most: float | None = None,
        speeding: float = 0.0,
        starts: Mapping[int, Vector] | None = None,
        rolls_on: Mapping[int, Rolls] | None = None,
        horizon_s: float = 0.0,
        beacon_ns: int = NS_PER_S // 5,
        beacon_max_ns: int = 0,
        bound_m: float = 0.0,
    ) -> None:
        self._owner = owner
        self._round_ns = period_ns
        self.keep_pace(period_ns)
        self.behind_ns = 0
        self.stood = self.rests = False
        self.stood_until_ns = 0
        self.missed_ns: Callable[[int], int] = _none_missed
        self.listened: Collection[int] = ()
        self._beacon_ns = beacon_ns
        self._rest_ns = max(0, beacon_max_ns - beacon_ns)
        self.predicts: Final = predict
        self.forecast: Final = Forecast(c1, c2, instants, decay, most, speeding, rolls_on)
        self._horizon_s, self._bound_m = horizon_s, bound_m
        self._began_ns = NEVER
        starts = starts or {}
        self._rolls_on = frozenset(rolls_on or ())
        self._known = {robot: self._peer(robot) for robot in starts}
        self.whereabouts: Final = Whereabouts(self.forecast, starts, horizon_s)
        self.lost: Final = LostVehicles(self._known, self.forecast)
        # Whoever is given up has been late for longer than this.
        self._overdue = Overdue(self._known, round(horizon_s * NS_PER_S))
        self.rows: Final = SilentRows(
            self._known,
            self._overdue,
            self.whereabouts,
            self.forecast,
            starts,
            horizon_s,
            is_large=self._rest_ns > 0,
        )
        self._removed: dict[int, int] = {}
        self._early: list[Peer] = []
        self._early_beacons: list[tuple[Peer, Beacon]] = []
        self._tick_ns = NEVER
        self._heard: tuple[tuple[int, int], ...] | None = ()

    def get(self, robot: int) -> Peer:
        """What is known of a robot, though it be nothing."""
        peer = self._known.get(robot)
        if peer is None:
            peer = self._known[robot] = self._peer(robot)
            self._overdue.add(peer)
        return peer

    def _peer(self, robot: int) -> Peer:
        return Peer(robot, self._period_ns, self._beacon_ns, rolls_on=robot in self._rolls_on)

    def is_seldom(self, peer: Peer) -> bool:
        """Whether the next beacon of a robot may be further away than that of one with something to tell."""
        return peer.next_ns > self._beacon_ns

    @property
    def known(self) -> Iterable[Peer]:
        """All robots that something is known of."""
        return self._known.values()

    def overdue(self, now_ns: int) -> list[Peer]:
        """Those of them that may not be heard, or not hear this one (`Overdue.at`)."""
        return self._overdue.at(now_ns)

    # ------------------------------------------------------------------ what comes

    def keep_pace(self, period_ns: int) -> None:
        """From now on the next tick is so much later."""
        self._period_ns = period_ns
        # So much is forgiven to what is in time, which is a period old at the next tick. A longer period than
        # these is that of a fleet that rests, in which nobody drives.
        drives_ns = max(self._round_ns, min(period_ns, UNSURE_NS))
        self._in_time_ns = max(0, drives_ns + IN_TIME_NS - UNSURE_NS)

    def begin(self, now_ns: int) -> None:
        """Begins the tick at `now_ns`, if it has not begun: takes what came too early for the last one."""
        if now_ns > self._tick_ns:
            if self._tick_ns == NEVER:
                self._began_ns = now_ns
            self._tick_ns = now_ns
            if self._early_beacons:
                beacons, self._early_beacons = self._early_beacons, []
                for peer, beacon in beacons:
                    if beacon.time_ns > peer.time_ns:
                        self._take_beacon(peer, beacon, now_ns)
                        self._overdue.note(peer)
            if self._early:
                early, self._early = self._early, []
                for peer in early:
                    message, peer.early = peer.early, None
                    if message is not None and message.time_ns > peer.hand_ns:
                        self._take(peer, message, now_ns)
                        self._overdue.note(peer)

    def accept(self, message: HandState, now_ns: int) -> str | None:
        """Takes a hand state at the tick `now_ns`; returns why it is refused, None when it is taken.

        Refused, with nothing changed: ``future``, ``duplicate`` and ``out_of_order`` (not newer than what is
        known). A sender that starts again counts its messages from 0 but its clock goes on: the time decides
        what is newer.

        All robots tick at once, and which of them sees which other's message of the same tick
        would be up to the scheduler. So a message of this tick waits for the next one: every
        robot works with the others' last tick, as the joint sweep assumes.
        """
        self.begin(now_ns)
        peer = self.get(message.robot)
        time_ns = message.time_ns
        clock = peer.clock
        used_ns, forgiven_ns = clock.used_ns, peer.lateness.forgiven_ns
        if self._from_future(peer, time_ns, now_ns):
            return "future"
        if time_ns <= peer.hand_ns:
            return _refuse(peer, time_ns == peer.hand_ns)
        early = now_ns <= time_ns - used_ns < now_ns + self._period_ns
        if early:
            if peer.early is not None and peer.early.time_ns >= time_ns:
                return _refuse(peer, peer.early.time_ns == time_ns)
            if peer.early is None:
                self._early.append(peer)
            peer.early = message
        echo_us = None
        for robot, delay_us in message.heard:
            if robot == self._owner:
                echo_us = delay_us
                break
        if clock.take(now_ns + self.behind_ns, time_ns, echo_us):
            self._heard = None
        peer.ahead_ns = 0
        if not early:
            waits = peer.early
            if waits is not None and waits.time_ns < time_ns:  # at a tick that is late both have come
                peer.early = None
                self._take(peer, waits, now_ns)
            self._take(peer, message, now_ns)
        if peer.lateness.forgiven_ns != forgiven_ns or clock.used_ns != used_ns:
            self._overdue.note(peer)
        return None

    def accept_beacon(self, beacon: Beacon, now_ns: int) -> str | None:
        """Takes a beacon and what it says of the silent; returns why it is refused, as `accept`.

        One of this tick waits for the next one as well: to a robot whose clock is behind, all are.
        """
        self.begin(now_ns)
        peer = self.get(beacon.robot)
        if self._from_future(peer, beacon.time_ns, now_ns):
            return "future"
        if beacon.silent:
            self._accept_silent(peer, beacon, now_ns)
        time_ns, forgiven_ns = beacon.time_ns, peer.lateness.forgiven_ns
        if time_ns > peer.beacon_ns:
            peer.beacon_ns = time_ns
            peer.mark = beacon.mission_version, beacon.mission_tag
        if time_ns > peer.direct_ns or peer.deaf:
            unheard = beacon.unheard
            peer.deaf, peer.unheard = self._owner in unheard, len(unheard)
            if unheard:
                self.rows.lacks(unheard, now_ns + beacon.next_ms * NS_PER_MS, near=peer.listened)
        if time_ns > peer.time_ns:  # else a hand state was quicker
            if time_ns - peer.clock.used_ns < now_ns:
                self._take_beacon(peer, beacon, now_ns)
            else:
                self._early_beacons.append((peer, beacon))
        if peer.deaf or peer.lateness.forgiven_ns != forgiven_ns:
            self._overdue.note(peer)
        return None

    def _accept_silent(self, sender: Peer, beacon: Beacon, now_ns: int) -> None:
        """Accept a beacon's rows about robots that its sender does not hear, where they are news here.

        Ignore rows about a robot that this one hears itself, so that nobody else can move it on our map.
        """
        for said in beacon.silent:
            if said.robot == self._owner:
                sender.knows_ns = said.time_ns - sender.clock.used_ns
                continue
            peer = self._known.get(said.robot)
            if peer is None or self._speaks(peer, now_ns):
                continue
            if said.time_ns == NEVER_CAME_NS:
                peer.never_came = True
                continue
            time_ns = said.time_ns - sender.clock.used_ns + peer.clock.used_ns
            if time_ns <= max(peer.time_ns, peer.gone_ns) or time_ns > now_ns + peer.clock.used_ns:
                continue
            peer.message = HandState.placed(
                said.robot,
                0,
                time_ns,
                said.following,
                peer.degree,
                (said.x, said.y, said.vx, said.vy),
                said.doubt,
                beacon.obeys(said.robot),
                beacon.lost_ms(said.robot),
            )
            if peer.rolls_on:
                peer.note_way(self.forecast.since_measured(peer.message))
            peer.far_until_ns = 0
            age_ns = beacon.time_ns - said.time_ns
            lately = said.following and age_ns < self._horizon_s * NS_PER_S
            way = said.x, said.y, said.to_x, said.to_y, said.doubt
            stood = None if lately else stood_between(*way)
            peer.belief = stood and self.forecast.may_have_rolled(stood, peer.message)
            peer.time_ns = time_ns

    def _speaks(self, peer: Peer, now_ns: int) -> bool:
        """Return True if a robot itself has been heard within the prediction horizon."""
        if not peer.here or peer.direct_ns == NEVER:
            return False
        return peer.direct_late_ns(now_ns) < self._horizon_s * NS_PER_S

    def silent(self, now_ns: int) -> tuple[Silent, ...]:
        """What a beacon tells of robots that are not heard."""
        return self.rows.at(now_ns, was_there=self.was_there, missed_ns=self.missed_ns)

    def rolling(self, silent: Iterable[Silent]) -> Iterator[Rolling]:
        """How the bodies of these go on, as far as it is known."""
        for said in silent:
            message = self.get(said.robot).message
            if message is not None and message.obeys:
                yield Rolling(said.robot, *message.obeys[0])

    def lost_of(self, silent: Iterable[Silent]) -> Iterator[Lost]:
        """Which of these have said that their plants are lost."""
        for said in silent:
            message = self.get(said.robot).message
            if message is not None and message.lost_ms:
                yield Lost(said.robot, message.lost_ms)

    def given_up(self, now_ns: int) -> tuple[int, ...]:
        """Robots from which nothing has come, now or since the start, for so long that they are given up."""
        until_ns = now_ns - round(self._horizon_s * NS_PER_S)
        began_ns = self._began_ns + self._rest_ns
        found = []
        for peer in self._overdue.at(now_ns):
            since_ns = max(peer.direct_ns - peer.clock.used_ns, began_ns)
            patient_ns = since_ns + peer.lateness.forgiven_ns
            if patient_ns < until_ns and patient_ns + self.missed_ns(since_ns) < until_ns:
                found.append(peer.robot)
        return tuple(found)

    @property
    def loses(self) -> bool:
        """Whether messages are lost all the time of one that is listened to."""
        listened = (peer for robot in self.listened if (peer := self._known.get(robot)) is not None)
        return any(peer.listened and peer.lateness.loses for peer in listened)

    @property
    def unknown(self) -> list[int]:
        """Robots that may have driven before this one was there: nobody who was has told of them yet."""
        if self.was_there:
            return []
        new = (peer for peer in self._known.values() if peer.message is None)
        return [peer.robot for peer in new if not (peer.is_gone or peer.never_came)]

    @property
    def was_there(self) -> bool:
        """Whether it has listened since the drive began."""
        return NEVER < self._began_ns <= self.forecast.epoch_ns

    def _note_beacon(self, peer: Peer, beacon: Beacon, now_ns: int) -> None:
        """Update the estimates of a sender's latency by a beacon, and of when its next message is due."""
        since_ns = beacon.time_ns - peer.hand_ns
        expected_ns = peer.next_ns
        peer.next_ns = max(self._beacon_ns, beacon.next_ms * NS_PER_MS)
        self._forgive(peer, beacon, now_ns)
        if peer.hand_next_ns and since_ns <= peer.hand_next_ns + OUTAGE_NS:  # of two one says how late it is
            self._note_promised(peer, beacon, now_ns, expected_ns)
        elif since_ns <= OUTAGE_NS:
            hands_come = since_ns <= self._beacon_ns  # they say how late it is, while it is listened to
            promises = self.is_seldom(peer) or expected_ns > self._beacon_ns
            if (promises and not (hands_come and peer.listened)) or (peer.lateness.heeds and not hands_come):
                self._expect_beacon(peer)
        else:
            age_ns = now_ns + peer.clock.used_ns - beacon.time_ns
            gap_ns = None if peer.direct_ns == NEVER else beacon.time_ns - peer.direct_ns
            self._note(peer, beacon, now_ns, age_ns, gap_ns, expected_ns)
            if peer.next_ns != expected_ns or (peer.listened and self.is_seldom(peer)):
                self._expect_beacon(peer)

    def _take_beacon(self, peer: Peer, beacon: Beacon, now_ns: int) -> None:
        """Take the place and motion of a robot from its beacon, the newest message that it has sent."""
        self._note_beacon(peer, beacon, now_ns)
        time_ns, before = beacon.time_ns, peer.message
        since_ns = time_ns - peer.hand_ns
        if time_ns > peer.direct_ns:
            peer.direct_ns = time_ns
        peer.far_until_ns = 0
        place = beacon.place
        if self._rest_ns and before is not None and peer.listened and since_ns <= OUTAGE_NS:
            place = self._moving(before, beacon, peer.hand_ns)
        peer.message = HandState.placed(
            beacon.robot,
            beacon.sequence,
            time_ns,
            beacon.following,
            peer.degree,
            place,
            beacon.doubt,
            beacon.obeys(beacon.robot),
            beacon.lost_ms(beacon.robot),
        )
        if peer.rolls_on:
            peer.note_way(self.forecast.since_measured(peer.message))
        if peer.hand_next_ns and before is not None and since_ns <= peer.hand_next_ns:
            peer.message = self.forecast.forces_of(before, peer.message)
        peer.time_ns = time_ns
        peer.belief = None
        peer.here = peer.token
        if peer.gone_ns >= time_ns:  # it is there, though its clock be behind the operator's
            peer.gone_ns = time_ns - 1

    def _moving(self, before: HandState, beacon: Beacon, hand_ns: int) -> tuple[float, float, float, float]:
        """Where a robot is by a beacon of a large fleet, and how it moves: by its hand state `before`, the
        last word from it. What the beacon tells is a mean velocity, for those from which it is far."""
        if before.time_ns == hand_ns and before.following and beacon.following:
            predicted = self.forecast.following(before, beacon.time_ns)
            if predicted is not None:
                return beacon.x, beacon.y, *predicted.velocity
        return beacon.place

    def _forgive(self, peer: Peer, message: HandState | Beacon, now_ns: int) -> None:
        """Decides by the newest message how much is forgiven its link at most.

        A machine that has too much to do makes messages late and its processes stand, again and again. The
        next time that a robot is silent which stood lately, it may have braked; and who stood himself brakes
        too late for it. Neither has time in which it would be predicted as driving on, but for the period
        that the next message takes in time: else, at 4 Hz and less, nobody would be heard at any tick, and to
        work out where all of them may stand has such a machine stand again. Who says that it stands is not
        silent: of a fleet that stands for such a machine, what is late is as late as ever.
        """
        if message.stood_ms * NS_PER_MS >= IN_TIME_NS:
            peer.stood_until_ns = message.time_ns + STOOD_KEPT_NS
        stood = message.time_ns < peer.stood_until_ns or now_ns < self.stood_until_ns
        late_max_ns = self._in_time_ns if stood and message.following else LATE_MAX_NS
        peer.lateness.most_ns += late_max_ns - peer.late_max_ns  # beside what it promised
        peer.late_max_ns = late_max_ns

    def _expect_beacon(self, peer: Peer) -> None:
        """The next that comes of it is a beacon, as late as it said; of one that is listened to something
        else must come before."""
        next_ns = self._beacon_ns if peer.listened else peer.next_ns
        peer.lateness.most_ns = peer.late_max_ns + 2 * (next_ns - self._beacon_ns)
        peer.lateness.expect(next_ns)

    def _from_future(self, peer: Peer, time_ns: int, now_ns: int) -> bool:
        # A clock that was behind and has been set must not be refused for what it was.
        now_ns += self.behind_ns
        if time_ns > now_ns + FUTURE_NS_MAX and time_ns > now_ns + peer.clock.used_ns + FUTURE_NS_MAX:
            peer.ahead_ns = time_ns - now_ns
            return True
        return False

    def _take(self, peer: Peer, message: HandState, now_ns: int) -> None:
        """Makes `message` the latest hand state of its sender; it is newer than the one before."""
        # The message before it said how much later it would come.
        time_ns, period_ns = message.time_ns, peer.hand_next_ns or self._round_ns
        gap_ns = None
        if peer.sequence != NEVER:
            gap_ns = time_ns - peer.hand_ns
            # No more can be missing than there was time for, whatever the numbers say: a mission
            # sets them to its rounds, and a sender that starts again begins at 0. Rounds without a message
            # are numbered as well: only what was promised is missed.
            gap = message.sequence - peer.sequence - 1
            if gap > 0:
                between = (gap_ns + period_ns // 2) // period_ns - 1
                if peer.hand_next_ns:
                    between = missed_at_least(gap_ns, peer.hand_next_ns)
                peer.lost += max(0, min(gap, between))
        peer.received += 1
        age_ns = now_ns + peer.clock.used_ns - time_ns
        if age_ns > 2 * max(period_ns, self._period_ns):
            peer.delayed += 1
        self._forgive(peer, message, now_ns)
        promised_ns = message.next_ms * NS_PER_MS  # what it promised is not late
        peer.lateness.most_ns = min(max(peer.late_max_ns, promised_ns), LATE_MAX_NS)
        if message.next_ms or peer.hand_next_ns:
            self._note_promised(peer, message, now_ns, peer.next_ns)
            peer.hand_next_ns = message.next_ms * NS_PER_MS
            peer.off_m = self._bound_m if peer.hand_next_ns else 0.0
            if peer.beacon_ns == NEVER and self._rest_ns:  # whose ticks are rare, its beacons are as well
                peer.next_ns = max(self._beacon_ns, peer.hand_next_ns)
            self._expect_promised(peer)
        else:
            self._note(peer, message, now_ns, age_ns, gap_ns, period_ns)
        if not peer.listened and self.is_seldom(peer):  # it was on its way when it was ignored: the last one
            self._expect_beacon(peer)
        peer.hand_ns = time_ns
        peer.sequence = message.sequence
        peer.degree = message.degree
        peer.copy = None
        for robot, value in message.multipliers:
            if robot == self._owner:
                peer.copy = value
                break
        if time_ns > peer.direct_ns:
            peer.direct_ns = time_ns
        if time_ns >= peer.time_ns:  # of one tick it says more than a beacon
            peer.time_ns = time_ns
            peer.message = message
            if peer.rolls_on:
                peer.note_way(self.forecast.since_measured(message))
            peer.belief = None
            peer.far_until_ns = 0
            peer.here = peer.token
            if peer.gone_ns >= time_ns:  # it is there, though its clock be behind the operator's
                peer.gone_ns = time_ns - 1
        elif peer.hand_next_ns and peer.message is not None:  # a beacon was quicker, which has no forces
            peer.message = self.forecast.forces_of(message, peer.message)

    def _note(
        self,
        peer: Peer,
        message: HandState | Beacon,
        now_ns: int,
        age_ns: int,
        gap_ns: int | None,
        period_ns: int,
    ) -> None:
        """Has a message counted where it says something: most come in time, and have nothing to say."""
        lateness = peer.lateness
        if lateness.heeds or age_ns > IN_TIME_NS or gap_ns is None or 2 * gap_ns > 3 * period_ns:
            age = None if self.stood or self.rests else age_ns
            lateness.take(now_ns, age, _missing(peer, message, gap_ns), period_ns)

    def _note_promised(self, peer: Peer, message: HandState | Beacon, now_ns: int, beacon_ns: int) -> None:
        """Has a message counted before which no hand state was due for a while.

        A beacon was due within `beacon_ns`: of the two the one that is due first says how late they are.
        """
        gap_ns = message.time_ns - peer.direct_ns
        due_ns = min(peer.hand_next_ns or self._round_ns, beacon_ns)
        waited = self.stood or self.rests
        age_ns = None if waited else now_ns + peer.clock.used_ns - message.time_ns
        missing_ns = _missing(peer, message, gap_ns if gap_ns > 0 else None)
        peer.lateness.take_promised(now_ns, age_ns, missing_ns, due_ns, self._beacon_ns)
        self._expect_promised(peer)

    def _expect_promised(self, peer: Peer) -> None:
        hand_ns = peer.hand_next_ns or self._round_ns
        peer.lateness.expect_promised(self._round_ns, min(hand_ns, peer.next_ns), hand_ns)

    def present(self, robot: int, here: bool) -> None:
        """Takes a change of presence: the connection to a robot's agent came (`here`) or went."""
        peer = self.get(robot)
        peer.token = here
        if not here:
            peer.here = False
            self._overdue.note(peer)

    def remove(self, removed: Iterable[Removed]) -> None:
        """Takes which bodies have been carried off, and when: each row once, for missions repeat them."""
        for robot, time_ns in removed:
            if robot != self._owner and time_ns > self._removed.get(robot, NEVER):
                self._removed[robot] = time_ns
                peer = self.get(robot)
                peer.gone_ns = max(peer.gone_ns, time_ns)

    def speaks_another_version(self, robot: int, what: str) -> None:
        """A message of a robot was refused for its version; `what` it and this program speak."""
        self.get(robot).other_version = what

    def take_copy(self, robot: int) -> float | None:
        """Its copy of the shared multiplier, if one has come since the last call.

        Both ends of an edge hold a copy of lambda; averaging keeps lambda_ij = lambda_ji, (31), when messages
        are lost.
        """
        peer = self._known.get(robot)
        if peer is None:
            return None
        copy, peer.copy = peer.copy, None
        return copy

    def listen(self, robots: Collection[int], now_ns: int) -> None:
        """The hand states of these robots are listened to from now on, and of no others."""
        self.listened = robots
        for peer in self._known.values():
            was, peer.listened = peer.listened, peer.robot in robots
            if not peer.listened or was:
                continue
            peer.sequence = NEVER  # some that were still on their way may have come since it was ignored
            if self.is_seldom(peer):
                # What is known of it may be old by the interval of its beacons; what comes now is not.
                age_ns = max(0, now_ns + peer.clock.used_ns - peer.time_ns) + peer.lateness.delay_ns
                peer.lateness.forgiven_ns = min(peer.lateness.forgiven_ns, age_ns)
                self._overdue.note(peer)

    def ignore(self, robot: int) -> None:
        """Its hand states are not listened to any more: those that did not come are not lost, and beacons,
        which are rarer, have to do."""
        peer = self._known.get(robot)
        if peer is not None:
            peer.sequence, peer.hand_next_ns, peer.off_m = NEVER, 0, 0.0
            peer.listened = False
            if peer.lateness.heeds or self.is_seldom(peer):
                self._expect_beacon(peer)
                self._overdue.note(peer)

    # ------------------------------------------------------------------ what is known

    def heard(self) -> tuple[tuple[int, int], ...]:
        """What to echo: ``(robot, least apparent delay of its hand states in us)``, where it is known."""
        if self._heard is None:
            known = [peer for peer in self._known.values() if peer.clock.least_us is not None]
            if len(known) > NEIGHBOURS_MAX:  # a message has room for no more: those that were heard last
                known = sorted(known, key=_by_hand, reverse=True)[:NEIGHBOURS_MAX]
            self._heard = tuple(sorted((peer.robot, peer.clock.least_us or 0) for peer in known))
        return self._heard

    def set_trust(self, peer: Peer, trust: float) -> None:
        """Trusts a robot so much (0..1) at once, as the one that trusts does not drive."""
        peer.trust = trust

    def update_trust(self, peer: Peer, wanted: bool, period_s: float) -> float:
        """Moves the trust in a robot (0..1) on by one tick, up if `wanted`, and returns it."""
        if wanted:
            peer.trust = min(1.0, peer.trust + period_s / TRUST_GAINED_S)
        else:
            peer.trust = max(0.0, peer.trust - period_s / TRUST_LOST_S)
        return peer.trust

    def predict(self, peer: Peer, time_ns: int) -> Prediction:
        """As `carry`; without prediction the state is that of the message. For the law."""
        assert peer.message is not None
        return self.carry(peer, time_ns) if self.predicts else as_it_came(peer.message)

    def carry(self, peer: Peer, time_ns: int) -> Prediction:
        """A robot that has been heard, carried forward to `time_ns` of the own clock. To keep away from it.

        One whose clock is found to be ahead is further along its way, for it follows by its own. One that
        is ahead of that time is taken as it is.

        One to whose agent there is no connection is taken to brake, as its plant does where that has ended or
        is frozen. What keeps away from it does not go by this (`Peer.is_heard`): it may only be cut off.
        """
        message = peer.message
        assert message is not None
        then_ns = time_ns + peer.clock.used_ns
        found = None
        if message.following and peer.here:
            slowly = peer.slowly if time_ns < peer.slowly_until_ns else inf
            found = self.forecast.following(message, then_ns, slowly=slowly)
        return coasting(message, max(0, then_ns - message.time_ns) * 1e-9) if found is None else found


def _none_missed(since_ns: int) -> int:
    return 0


def _by_hand(peer: Peer) -> int:
    return peer.hand_ns


def _missing(peer: Peer, message: HandState | Beacon, gap_ns: int | None) -> int | None:
    """The gap before a message, as far as its link may have made it; None where that says nothing.

    A process that stood has said nothing, and its body has braked. Whoever took that for a bad link would
    predict it as one that drives on, the next time that it stands. Nor is one missed that has said that it
    does not know where its body is: after a while it says nothing more.
    """
    before = peer.message
    is_lost = before is not None and before.doubt > 0.0 and not before.following
    return None if message.stood_ms or is_lost else gap_ns


def _refuse(peer: Peer, same: bool) -> str:
    peer.duplicated += same
    return "duplicate" if same else "out_of_order"
